"""Point tables to files that other programs read: one format a module, chosen by the suffix."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ...schemas.errors import (
    ConflictError,
    DamageError,
    ExtraMissingError,
    NotFoundError,
    UsageError,
)
from ..bytes import fsync_file, fsync_folder, storage_error

if TYPE_CHECKING:
    import pyarrow as pa

    from ...schemas.calibration import Calibration


@dataclass(frozen=True)
class Viewpoint:
    """Where the camera of a scan was: its centre in turntable space, which the angle turns about z."""

    centre_mm: tuple[float, float, float]
    turn_sign: int

    @classmethod
    def of(cls, calibration: Calibration) -> Viewpoint:
        """The viewpoint under ``calibration``."""
        axis = calibration.axis_or_fail()
        x, y, z = (
            -sum(a * p for a, p in zip(direction, axis.point_mm, strict=True))
            for direction in axis.camera_from_turntable()
        )
        return cls((x, y, z), axis.turn_sign())


@dataclass(frozen=True)
class ExportInfo:
    """What an exported file says of itself.

    ``calibrations`` and ``keys`` are one a scan, in the order of ``scans``. ``rows`` is the number of
    points that will come. ``viewpoints``, one a scan, make the triangles of
    a mesh face the scanner; without them they follow the order of frames.
    """

    scans: Sequence[str]
    recipe: str
    calibrations: Sequence[str]
    keys: Sequence[str]
    software: str
    rows: int
    viewpoints: Sequence[Viewpoint] = ()

    def lines(self) -> list[str]:
        """The same in words, a line each, for headers and comments."""
        return [
            self.software,
            *(f"scan {s}" for s in self.scans),
            f"recipe {self.recipe}",
            *(f"calibration {c}" for c in dict.fromkeys(self.calibrations)),
            *(f"key {k}" for k in self.keys),
            *(self._origins() if len(self.scans) > 1 else ()),
        ]

    def _origins(self) -> list[str]:
        """Which calibration and key belong to which of several scans."""
        of_each = zip(self.scans, self.calibrations, self.keys, strict=True)
        return [f"{s} was made with calibration {c}, key {k}" for s, c, k in of_each]

    def short(self) -> str:
        """The same in one line of ASCII for small headers; of several scans the first, and how many."""
        more = f" +{len(self.scans) - 1}" if len(self.scans) > 1 else ""
        text = f"turnscan; {self.recipe}; {self.calibrations[0]}; k-{self.keys[0][:12]}{more}"
        return text.encode("ascii", "backslashreplace").decode()


@dataclass(frozen=True)
class _Format:
    module: str
    extra: str | None
    needs: tuple[str, ...]
    words: str


#: Suffix -> who writes it. Batches hold the POINTS columns and ``scan_index`` (uint16).
_FORMATS = {
    ".ply": _Format("ply", None, (), "binary PLY, mm, all attributes"),
    ".csv": _Format("text", None, (), "CSV, mm"),
    ".parquet": _Format("parquet", None, (), "Parquet, mm, with units in the metadata"),
    ".pcd": _Format("pcd", None, (), "binary PCD 0.7, mm, all attributes"),
    ".las": _Format("las", "las", ("laspy",), "LAS 1.4, m"),
    ".laz": _Format("las", "las", ("laspy", "lazrs"), "compressed LAS 1.4, m"),
    ".e57": _Format("e57", "e57", ("pye57",), "E57, m"),
    ".glb": _Format("mesh", "mesh", ("trimesh",), "glTF mesh of the sweep, m, +Y up"),
    ".stl": _Format("mesh", "mesh", ("trimesh",), "STL mesh of the sweep, mm"),
    ".obj": _Format("mesh", "mesh", ("trimesh",), "OBJ mesh of the sweep, mm"),
}

Writer = Callable[[Iterable["pa.RecordBatch"], Path, ExportInfo, str], None]


def supported_formats() -> dict[str, str]:
    """Suffix -> what it is, and which extra it needs."""
    return {s: f.words + (f" (extra: {f.extra})" if f.extra else "") for s, f in _FORMATS.items()}


def check_format(out: Path) -> str:
    """The suffix of ``out`` if it can be written here and now.

    Raises
    ------
    UsageError
        Nobody writes that suffix.
    ExtraMissingError
        It needs an extra that is not installed.
    """
    suffix = out.suffix.lower()
    if suffix not in _FORMATS:
        raise UsageError(
            f"{out}: cannot export to {suffix or 'a file without suffix'!r}",
            hint=f"there are: {' '.join(_FORMATS)}",
        )
    chosen = _FORMATS[suffix]
    for name in chosen.needs:
        try:
            import_module(name)
        except ImportError as error:
            raise ExtraMissingError(
                f"{suffix} needs {name}, which is not installed",
                hint=f"pip install 'turnscan[{chosen.extra}]'",
            ) from error
    return suffix


def export_points(
    batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, *, overwrite: bool = False
) -> None:
    """Write points to ``out`` in the format of its suffix; it appears whole or not at all.

    Raises
    ------
    ConflictError
        ``out`` exists and ``overwrite`` is False, or it is a folder.
    NotFoundError
        The folder of ``out`` does not exist.
    DamageError
        Not ``info.rows`` points came.
    StorageError
        The file system refuses; nothing is left behind.
    """
    suffix = check_format(out)
    if out.is_dir():
        raise ConflictError(f"{out} is a folder", hint="give the name of a file")
    if out.exists() and not overwrite:
        raise ConflictError(f"{out} exists already", hint="--overwrite replaces it")
    if not out.parent.is_dir():
        raise NotFoundError(f"{out.parent}: no such folder", hint=f"mkdir -p {out.parent}")
    module: Any = import_module(f".{_FORMATS[suffix].module}", __name__)
    write: Writer = module.write
    aside = out.with_name(f".{out.stem}-{uuid.uuid4().hex[:8]}{suffix}")
    try:
        write(_counted(batches, info.rows, out), aside, info, suffix)
        fsync_file(aside)
        aside.replace(out)
        fsync_folder(out.absolute().parent)
    except OSError as error:
        raise storage_error(error, out) from error
    finally:
        aside.unlink(missing_ok=True)


def _counted(batches: Iterable[pa.RecordBatch], rows: int, out: Path) -> Iterator[pa.RecordBatch]:
    """``batches``, which must add up to the ``rows`` that headers have announced."""
    seen = 0
    for batch in batches:
        seen += batch.num_rows
        yield batch
    if seen != rows:
        raise DamageError(
            f"{out}: the tables hold {seen} points, their manifests say {rows}",
            hint="turnscan verify lists what is damaged",
        )
