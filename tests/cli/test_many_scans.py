"""A hundred scans: what is done already is known without looking at it."""

from __future__ import annotations

import resource
from pathlib import Path

import pytest
from console import Console, every_file, write_frames

from turnscan.ingest.image_import import ImportPlan, import_images
from turnscan.ingest.poses import poses_by_step
from turnscan.process.pipeline import derive
from turnscan.schemas.calibration import parse_calibration
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive

pytestmark = pytest.mark.slow

SCANS = 100


@pytest.fixture
def hundred(tmp_path: Path, tiny_files: Path) -> Console:
    archive = Archive.init(tmp_path / "lab")
    calibration = parse_calibration((tiny_files / "cal.json").read_bytes(), where="cal.json")
    (image,) = write_frames(tmp_path / "photos", 1).iterdir()
    for i in range(SCANS):
        poses = poses_by_step([image], step_deg=1, start_deg=i)
        import_images(archive, ImportPlan(poses, rig="r1", calibration=calibration))
    assert all(o.derived for o in derive(archive, archive.scans(), BUILT_IN["default"]))
    return Console(tmp_path, archive.root)


def test_nothing_to_do_for_a_hundred_scans_takes_no_second(hundred: Console) -> None:
    assert hundred.archive is not None
    before = every_file(hundred.archive)
    begin = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = hundred("process")
    end = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = end.ru_utime + end.ru_stime - begin.ru_utime - begin.ru_stime
    print(f"second process of {SCANS} scans: {seconds:.2f} s CPU, target 1")
    assert done.stderr == f"nothing to do: {SCANS} scans up to date\n"
    assert every_file(hundred.archive) == before
    assert seconds < 3
