"""Derived tables: published whole or not at all, whoever is killed and whatever is full."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from turnscan.process.pipeline import derive
from turnscan.schemas.errors import (
    DamageError,
)
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive
from turnscan.store.repair import repair
from turnscan.store.verify import verify

from .scans import flip, import_scan


def test_same_key_same_bytes(lab: Archive) -> None:
    made = {m.kind: m for m in lab.derivations()}
    before = {k: (lab.root / m.path).read_bytes() for k, m in made.items()}
    shutil.rmtree(lab.root / "derived")
    list(derive(Archive.open(lab.root), lab.scans(), BUILT_IN["default"]))
    for kind, manifest in made.items():
        assert (lab.root / manifest.path).read_bytes() == before[kind]


def test_parquet_is_as_the_format_says(lab: Archive) -> None:
    import pyarrow.parquet as pq

    from turnscan.schemas.tables import POINTS

    manifest = next(m for m in lab.derivations() if m.kind == "points")
    with pq.ParquetFile(lab.root / manifest.path, page_checksum_verification=True) as file:
        assert file.schema_arrow.equals(POINTS.arrow_schema(), check_metadata=False)
        group = file.metadata.row_group(0)
        assert {group.column(i).compression for i in range(group.num_columns)} == {"ZSTD"}
        names = file.schema_arrow.names
        assert "BYTE_STREAM_SPLIT" in group.column(names.index("x_mm")).encodings
        assert group.column(0).has_column_index
        assert file.metadata.metadata[b"turnscan.key"].decode() == manifest.key
        table = file.read()
    order = table["frame"].to_numpy().astype(np.int64) * 65536 + table["row"].to_numpy()
    assert (np.diff(order) >= 0).all()


def test_a_flipped_page_is_reported_when_read(lab: Archive) -> None:
    manifest = next(m for m in lab.derivations() if m.kind == "points")
    path = lab.root / manifest.path
    good = path.read_bytes()
    whole = [b.to_pydict() for b in lab.read(manifest)]
    reported = 0
    places = range(4, manifest.bytes, 23)
    for at in places:
        flip(path, at)
        try:
            # What no checksum covers (page heads) may flip, but never a value that is given out.
            assert repr([b.to_pydict() for b in lab.read(manifest)]) == repr(whole)
        except DamageError as error:
            assert f"{path.name}: " in str(error)
            reported += 1
        assert verify(lab), "the digest of the whole file finds every flip"
        path.write_bytes(good)
    assert reported > 0.6 * len(places)


def test_cut_or_missing_tables_are_reported(lab: Archive) -> None:
    manifest = next(m for m in lab.derivations() if m.kind == "points")
    path = lab.root / manifest.path
    path.write_bytes(path.read_bytes()[:-5])
    for reading in (lambda: list(lab.read(manifest)), lambda: lab.points().collect()):
        with pytest.raises(DamageError, match="bytes, its manifest says"):
            reading()
    path.unlink()
    with pytest.raises(DamageError, match="is missing"):
        list(lab.read(manifest))
    (outcome,) = derive(lab, lab.scans(), BUILT_IN["default"])
    assert outcome.error is not None or outcome.derived == ("points",)


def test_a_table_that_was_deleted_is_derived_again(lab: Archive) -> None:
    shutil.rmtree(lab.root / "derived" / "points")
    (outcome,) = derive(lab, lab.scans(), BUILT_IN["default"])
    assert outcome.error is None
    assert outcome.derived == ("points",)
    assert verify(lab) == []


KILLED = """
import os, signal, sys
from pathlib import Path
from turnscan.store import Archive
from turnscan.store.bytes import LocalFolder
from turnscan.process.pipeline import derive
from turnscan.schemas.recipe import BUILT_IN
count = int(sys.argv[2])
link = os.link
def counted(*a, **k):
    global count
    count -= 1
    if count == 0 and sys.argv[3] == "before": os.kill(os.getpid(), signal.SIGKILL)
    link(*a, **k)
    if count == 0: os.kill(os.getpid(), signal.SIGKILL)
os.link = counted
archive = Archive.open(sys.argv[1])
list(derive(archive, archive.scans(), BUILT_IN["paper"]))
"""


@pytest.mark.parametrize("when", ["before", "after"])
@pytest.mark.parametrize("publish", [1, 2, 3, 4])
def test_a_killed_process_leaves_nothing_half_published(lab: Archive, publish: int, when: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(lab.root), str(publish), when], check=False
    )
    assert done.returncode == -9
    archive = Archive.open(lab.root)
    archive.points(recipe="default").collect()
    (outcome,) = derive(archive, archive.scans(), BUILT_IN["paper"])
    assert outcome.error is None
    repair(archive)
    assert os.listdir(archive.root / "staging") == []
    assert verify(archive) == []
    assert archive.points(recipe="paper").collect().height > 0


TWO = """
import sys
from turnscan.store import Archive
from turnscan.process.pipeline import derive
from turnscan.schemas.recipe import BUILT_IN
archive = Archive.open(sys.argv[1])
print("ready", flush=True)
sys.stdin.readline()
for o in derive(archive, archive.scans(), BUILT_IN["paper"]):
    assert o.error is None, o.error
"""


def test_two_processes_deriving_the_same_key_both_succeed(lab: Archive) -> None:
    pair = [
        subprocess.Popen(
            [sys.executable, "-c", TWO, str(lab.root)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    for p in pair:
        assert p.stdout is not None
        assert p.stdout.readline() == "ready\n"
    for p in pair:
        p.communicate("go\n", timeout=60)
        assert p.returncode == 0
    archive = Archive.open(lab.root)
    assert len([m for m in archive.derivations() if m.recipe == BUILT_IN["paper"].recipe_id()]) == 2
    assert verify(archive) == []


def test_workers_do_not_change_the_result(lab: Archive, source: Path, tmp_path: Path) -> None:
    import_scan(lab, source, step=12.0)
    shutil.copytree(lab.root, tmp_path / "copy")
    copy = Archive.open(tmp_path / "copy")
    one = list(derive(lab, lab.scans(), BUILT_IN["paper"], workers=1))
    two = list(derive(copy, copy.scans(), BUILT_IN["paper"], workers=2))
    assert [(o.scan, o.derived, o.points) for o in one] == [(o.scan, o.derived, o.points) for o in two]
    a = {m.key: m.sha256 for m in lab.derivations()}
    assert a == {m.key: m.sha256 for m in copy.derivations()}


FULL = """
import resource, signal, sys
from turnscan.store import Archive
from turnscan.process.pipeline import derive
from turnscan.schemas.recipe import BUILT_IN
archive = Archive.open(sys.argv[1])
archive.scans()
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
for o in derive(archive, archive.scans(), BUILT_IN["paper"]):
    print(type(o.error).__name__, o.error, o.error.hint)
"""


def test_a_full_disk_publishes_nothing_and_says_so(lab: Archive) -> None:
    before = sorted(p for p in (lab.root / "derived").rglob("*") if p.is_file())
    said = subprocess.run(
        [sys.executable, "-c", FULL, str(lab.root)], capture_output=True, text=True, check=True
    ).stdout
    assert "StorageError" in said
    assert "the disk is full" in said
    assert "free some space" in said
    assert sorted(p for p in (lab.root / "derived").rglob("*") if p.is_file()) == before
    assert os.listdir(lab.root / "staging") == []
    (outcome,) = derive(lab, lab.scans(), BUILT_IN["paper"])
    assert outcome.error is None


def test_a_killed_worker_is_said_and_results_come_in_order() -> None:
    from turnscan.process.workers import in_processes
    from turnscan.schemas.errors import InputError

    with pytest.raises(InputError, match="a worker process was killed"):
        list(in_processes(2, os._exit, [(3,), (3,)]))
    assert list(in_processes(2, pow, [(i, 2) for i in range(9)])) == [i * i for i in range(9)]


STOPPED = """
import sys
from turnscan.process.workers import in_processes
import time
print("ready", flush=True)
list(in_processes(2, time.sleep, [(30,)] * 8))
"""


def test_an_interrupt_ends_all_workers_at_once() -> None:
    import signal
    import time

    process = subprocess.Popen(
        [sys.executable, "-c", STOPPED],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    time.sleep(2.0)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=20)
    assert process.returncode != 0
    assert said.count("Traceback") <= 1, said
