"""The console script as users run it, and two archives to run it on: a real scan and a tiny one."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

HERE = Path(__file__).parent
# console.py stands here; real.py, with the numbers of the real scan, beside the tests of process, and
# simulated_rig.py beside those of calibration.
PROCESS = HERE.parent / "process"
sys.path[:0] = [str(HERE), str(PROCESS), str(PROCESS / "calibrate")]

from console import Console, Inside, write_frames, write_json  # noqa: E402
from real import SRV, srv_angle_deg  # noqa: E402
from rig_files import write_rig  # noqa: E402

from turnscan.ingest.image_sources import natural_key  # noqa: E402


@pytest.fixture(autouse=True)
def _log_of_its_own() -> Iterator[None]:
    """A command that is called in this process sets up the program's log: undo that."""
    yield
    log = logging.getLogger("turnscan")
    for handler in log.handlers[:]:
        log.removeHandler(handler)
        handler.close()
    log.propagate = True
    log.setLevel(logging.NOTSET)


@pytest.fixture
def console(tmp_path: Path) -> Console:
    """The command, run in a folder of its own."""
    return Console(tmp_path)


@pytest.fixture
def lab(tmp_path: Path) -> Console:
    """A console with an archive and a rig file of a small simulated rig."""
    console = Inside(tmp_path)
    console("init", "lab")
    console.archive = tmp_path / "lab"
    write_rig(tmp_path)
    return console


@pytest.fixture(scope="session")
def srv_files(test_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with cal.json and angles.csv of the real turntable scan."""
    folder = tmp_path_factory.mktemp("srv-files")
    write_json(folder / "cal.json", SRV.plain())
    images = sorted((test_data / "srv_turntable" / "scan").glob("*.jpg"), key=natural_key)
    assert len(images) == 80
    rows = [f"{p.name},{srv_angle_deg(p.name)}" for p in images]
    (folder / "angles.csv").write_text("\n".join(["file,angle_deg", *rows]) + "\n")
    return folder


@pytest.fixture(scope="session")
def tiny_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with cal.json and photos/, three frames of 64 x 48."""
    folder = tmp_path_factory.mktemp("tiny-files")
    write_frames(folder / "photos", 3)
    write_json(folder / "cal.json", TINY)
    return folder


@pytest.fixture(scope="session")
def tiny_lab(tiny_files: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive with the tiny scan, labelled first and processed; to be copied before a change."""
    run = Inside(tmp_path_factory.mktemp("tiny"))
    run("init", "lab")
    run.archive = run.cwd / "lab"
    run(
        *("import", "images", tiny_files / "photos", "--step-deg", "10"),
        *("--calibration", tiny_files / "cal.json", "--label", "first", "--tag", "owner=lab2"),
    )
    run("process")
    return run.archive


TINY = {
    "format": "turnscan.calibration",
    "version": 1,
    "rig": "r1",
    "camera": {
        "width_px": 64,
        "height_px": 48,
        "fx_px": 300.0,
        "fy_px": 300.0,
        "cx_px": 32.0,
        "cy_px": 24.0,
        "distortion": [-0.1, 0.0, 0.0, 0.0, 0.0],
    },
    "lasers": [{"laser": 0, "normal": [0.6, 0.0, 0.8], "distance_mm": 150.0}],
    "turntable": {"point_mm": [0, 0, 180], "direction": [0, -1, 0]},
}
