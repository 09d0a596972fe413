"""An exported file appears whole or not at all, and every refusal says what to do."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa
import pytest

from turnscan.schemas.errors import (
    ConflictError,
    DamageError,
    NotFoundError,
    StorageError,
    UsageError,
)
from turnscan.store.export import check_format, export_points, supported_formats

from .clouds import ALL, MESHES, cloud, info, read_ply


def run(code: str, *words: object) -> subprocess.CompletedProcess[str]:
    """Run ``code`` in a process of its own; what it writes to stderr is a failure."""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done


def test_these_are_all_formats() -> None:
    assert tuple(supported_formats()) == ALL


@pytest.mark.parametrize("suffix", ALL)
def test_an_existing_file_is_kept_unless_overwritten(tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"cloud{suffix}"
    out.write_text("mine")
    batches = [cloud(400)]
    with pytest.raises(ConflictError, match="exists already") as caught:
        export_points(batches, out, info(batches))
    assert caught.value.hint == "--overwrite replaces it"
    assert out.read_text() == "mine"
    export_points(batches, out, info(batches), overwrite=True)
    assert out.stat().st_size > 1000
    assert list(tmp_path.iterdir()) == [out]


def test_an_upper_case_suffix_is_the_same_format(tmp_path: Path) -> None:
    batches = [cloud(4)]
    export_points(batches, tmp_path / "CLOUD.PLY", info(batches))
    assert len(read_ply(tmp_path / "CLOUD.PLY")[0]) == 4


@pytest.mark.parametrize("name", ["cloud.xyz", "cloud", "cloud.ply.gz"])
def test_an_unknown_suffix_lists_the_known_ones(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError, match="cannot export to") as caught:
        export_points([], tmp_path / name, info([]))
    assert caught.value.hint == "there are: " + " ".join(ALL)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_missing_or_in_the_way_is_named(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="none: no such folder") as caught:
        export_points([], tmp_path / "none" / "cloud.ply", info([]))
    assert caught.value.hint == f"mkdir -p {tmp_path / 'none'}"
    (tmp_path / "cloud.ply").mkdir()
    with pytest.raises(ConflictError, match="is a folder"):
        export_points([], tmp_path / "cloud.ply", info([]), overwrite=True)


@pytest.mark.parametrize("suffix", ALL)
def test_damage_on_the_way_leaves_the_old_file(tmp_path: Path, suffix: str) -> None:
    out = tmp_path / f"cloud{suffix}"
    out.write_text("mine")

    def broken() -> Iterator[pa.RecordBatch]:
        yield cloud(400)
        raise DamageError("k-1.parquet: damaged table: a page")

    with pytest.raises(DamageError, match=r"k-1\.parquet"):
        export_points(broken(), out, info([cloud(800)]), overwrite=True)
    assert out.read_text() == "mine"
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize("suffix", ALL)
def test_other_points_than_announced_are_damage(tmp_path: Path, suffix: str) -> None:
    batches = [cloud(400)]
    with pytest.raises(DamageError, match="the tables hold 400 points, their manifests say 401"):
        export_points(batches, tmp_path / f"cloud{suffix}", info(batches, rows=401))
    assert list(tmp_path.iterdir()) == []


def test_a_folder_without_permission_is_named(tmp_path: Path) -> None:
    # Nobody may make files there, not even root.
    with pytest.raises(StorageError, match=r"/proc/cloud\.ply: "):
        export_points([], Path("/proc/cloud.ply"), info([]))


FULL = """
import json, resource, signal, sys
from pathlib import Path
from turnscan.schemas.errors import StorageError
from turnscan.store.export import export_points
from tests.store.export.clouds import cloud, info
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
batches = [cloud(2000), cloud(1000, scan=1)]
for name, limit in json.loads(sys.argv[2]):
    out = Path(sys.argv[1]) / name
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    try:
        export_points(batches, out, info(batches))
        said = "no error"
    except StorageError as error:
        said = f"{error.message} | {error.hint}"
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    print(json.dumps([name, limit, said]))
"""


def test_a_full_disk_leaves_nothing_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Full at the start, half way, and at the very last byte, where a short write raises nothing."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    batches = [cloud(2000), cloud(1000, scan=1)]
    cases = []
    for suffix in ALL:
        whole = tmp_path / f"whole{suffix}"
        export_points(batches, whole, info(batches))
        size = whole.stat().st_size
        whole.unlink()
        cases += [(f"cut{suffix}", limit) for limit in (100, size // 2, size - 1)]
    lines = run(FULL, tmp_path, json.dumps(cases)).stdout.splitlines()
    assert len(lines) == 3 * len(ALL)
    for line in lines:
        name, limit, said = json.loads(line)
        assert said.startswith(f"{tmp_path / name}: the disk is full"), (name, limit, said)
        assert "free some space" in said
    assert list(tmp_path.iterdir()) == []


BLOCKED = """
import json, sys
from pathlib import Path
blocked = sys.argv[2].split()
for name in blocked:
    sys.modules[name] = None
from turnscan.schemas.errors import ExtraMissingError
from turnscan.store.export import export_points
from tests.store.export.clouds import ALL, cloud, info
batches = [cloud(400)]
said = {}
for suffix in ALL:
    try:
        export_points(batches, Path(sys.argv[1]) / f"cloud{suffix}", info(batches))
        said[suffix] = "ok"
    except ExtraMissingError as error:
        said[suffix] = f"{error.message} | {error.hint}"
print(json.dumps(said))
"""


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    said = json.loads(run(BLOCKED, tmp_path, "laspy pye57 trimesh").stdout)
    for suffix, module, extra in (
        (".las", "laspy", "las"),
        (".laz", "laspy", "las"),
        (".e57", "pye57", "e57"),
        *((s, "trimesh", "mesh") for s in MESHES),
    ):
        assert said.pop(suffix) == (
            f"{suffix} needs {module}, which is not installed | pip install 'turnscan[{extra}]'"
        )
    assert said == dict.fromkeys((".ply", ".csv", ".parquet", ".pcd"), "ok")
    assert {p.suffix for p in tmp_path.iterdir()} == set(said)


def test_las_needs_no_lazrs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    said = json.loads(run(BLOCKED, tmp_path, "lazrs").stdout)
    assert said[".laz"].startswith(".laz needs lazrs, which is not installed")
    assert said[".las"] == "ok"


def test_formats_say_their_extra() -> None:
    said = supported_formats()
    assert said[".e57"].endswith("(extra: e57)")
    assert "extra" not in said[".ply"]
    assert check_format(Path("a.LAZ")) == ".laz"


MEMORY = """
import resource, sys
import pyarrow as pa
from pathlib import Path
from turnscan.store.export import export_points
from tests.store.export.clouds import cloud, info
out, count = Path(sys.argv[1]), int(sys.argv[2])
one = cloud(65536)
def batches(n):
    for _ in range(n):
        yield one.take(pa.array(range(65536)))
export_points(batches(2), out, info([one] * 2))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
export_points(batches(count), out, info([one] * count), overwrite=True)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024, out.stat().st_size)
"""


SLOW = (pytest.param(s, marks=pytest.mark.slow) for s in (".csv", ".parquet", ".pcd", ".las", ".laz"))


@pytest.mark.parametrize("suffix", [".ply", *SLOW])
def test_memory_does_not_grow_with_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[3]))
    rows = 24 * 65536
    grown, size = map(int, run(MEMORY, tmp_path / f"cloud{suffix}", 24).stdout.split())
    assert size > rows * 10
    assert grown < 0.25 * rows * 49, f"{grown} bytes more for {rows} points of 49 bytes"
