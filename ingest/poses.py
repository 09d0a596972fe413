"""What belongs to each frame of an import: angle, time, lasers. From a step, or from a CSV."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from ..schemas.errors import InputError

_COLUMNS = ("angle_deg", "t_ns", "laser", "laser_on")
_YES, _NO = {"1", "true", "yes", "on"}, {"0", "false", "no", "off"}
_NOMINAL_STEP_NS = 1_000_000_000
#: A hundred turns: what is beyond is a mistake in the unit.
_MOST_DEG = 36_000.0


@dataclass(frozen=True)
class Pose:
    """One image and what is known of it; ``t_ns`` None: nominal times are given later."""

    path: Path
    angle_deg: float
    lasers_on: tuple[int, ...]
    t_ns: int | None = None


def poses_by_step(
    images: Sequence[Path],
    *,
    step_deg: float,
    start_deg: float = 0.0,
    laser: int = 0,
    background: str | None = None,
) -> list[Pose]:
    """Poses of images in order: the i-th lit one is at ``start_deg + i step_deg``.

    ``background`` is a name pattern of laser-off frames. As many as lit ones: each belongs to the lit
    one of the same place in the order, and comes before it. Just one: it comes first, for all.

    Raises
    ------
    InputError
        The step is not finite, or the number of laser-off frames fits neither rule.
    """
    if not (math.isfinite(step_deg) and math.isfinite(start_deg)):
        raise InputError(f"--step-deg {step_deg} and --start-deg {start_deg} must be finite")
    if not abs(start_deg) + abs(step_deg) * len(images) <= _MOST_DEG:
        raise InputError(
            f"--step-deg {step_deg:g} over {len(images)} images leaves {_MOST_DEG:g} degrees",
            hint="angles are in degrees, not in steps of a motor",
        )
    dark = [p for p in images if background is not None and fnmatch(p.name, background)]
    lit = [p for p in images if background is None or not fnmatch(p.name, background)]
    if background is not None and len(dark) not in (1, len(lit)):
        raise InputError(
            f"{len(dark)} laser-off frames fit {background!r}, beside {len(lit)} lit ones",
            hint="one for the whole scan, or one for each lit frame",
        )
    if not lit:
        raise InputError(f"every image fits the laser-off pattern {background!r}")
    out = [Pose(dark[0], start_deg, ())] if len(dark) == 1 and len(lit) != 1 else []
    for i, path in enumerate(lit):
        angle = start_deg + i * step_deg
        if len(dark) == len(lit):
            out.append(Pose(dark[i], angle, ()))
        out.append(Pose(path, angle, (laser,)))
    return out


def poses_from_csv(images: Sequence[Path], table: Path) -> list[Pose]:
    """Poses from a CSV with the columns file, angle_deg and, optionally, t_ns, laser, laser_on.

    ``file`` is a name or a path ending; ``laser`` a number, or several as ``0;1``; ``laser_on = 0``
    makes a laser-off frame. Frames are in the order of ``t_ns`` where it is given, else in that of
    ``images``; the order of rows does not matter.

    Raises
    ------
    InputError
        A row is malformed, an image has no row or two, or a row has no image.
    """
    rows = _read_rows(table)
    names: dict[str, list[Path]] = {}
    for path in images:
        names.setdefault(path.name, []).append(path)
    out: list[Pose] = []
    used: dict[Path, int] = {}
    for line, row in rows:
        path = _image_of(row["file"], names, where=f"{table}, line {line}")
        if path in used:
            raise InputError(f"{table}, line {line}: {row['file']} stands already in line {used[path]}")
        used[path] = line
        out.append(_pose(path, row, where=f"{table}, line {line}"))
    missing = [p.name for p in images if p not in used]
    if missing:
        raise InputError(
            f"{table}: no row for {_first_of(missing)}",
            hint="add the missing rows, or leave these images out",
        )
    _check_times(table, rows, out)
    # A CSV made by `ls` has frame10 before frame2: the images' own order is what people mean.
    place = {path: i for i, path in enumerate(images)}
    out.sort(key=lambda p: (p.t_ns or 0, place[p.path]))
    if not any(p.lasers_on for p in out):
        raise InputError(f"{table}: every frame is a laser-off frame")
    return out


def poses_of_frames(video: Path, count: int, table: Path, *, remark: str = "") -> list[Pose]:
    """Poses of the ``count`` frames of a video, from a CSV with the columns frame, angle_deg and,
    optionally, t_ns, laser, laser_on.

    ``frame`` counts from 0; the order of rows does not matter. ``remark`` is what is known of a number
    of frames that is less than it should be.

    Raises
    ------
    InputError
        A row is malformed, a frame has no row or two, or a row is of no frame.
    """
    rows = _read_rows(table, key="frame")
    if len(rows) != count:
        raise InputError(
            f"{table}: has {len(rows)} rows, {video} has {count} frames"
            + (f": {remark}" if remark else ""),
            hint="one row a frame, counted from 0",
        )
    found: dict[int, int] = {}
    out: list[Pose] = []
    for line, row in rows:
        where = f"{table}, line {line}"
        frame = _whole(row["frame"], count)
        if frame is None:
            raise InputError(
                f"{where}: frame is {row['frame'][:40]!r}, expected a number from 0 to {count - 1}"
            )
        if frame in found:
            raise InputError(f"{where}: frame {frame} stands already in line {found[frame]}")
        found[frame] = line
        out.append(_pose(video, row, where=where))
    _check_times(table, rows, out)
    if not any(p.lasers_on for p in out):
        raise InputError(f"{table}: every frame is a laser-off frame")
    return [pose for _, pose in sorted(zip(found, out, strict=True), key=lambda pair: pair[0])]


def _first_of(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")


def _check_times(table: Path, rows: Sequence[tuple[int, Any]], poses: Sequence[Pose]) -> None:
    timed = [p.t_ns is not None for p in poses]
    if any(timed) and not all(timed):
        line = rows[timed.index(False)][0]
        raise InputError(f"{table}, line {line}: t_ns is empty, but other rows have it")


def with_times(poses: Sequence[Pose], start_ns: int) -> list[tuple[int, Pose]]:
    """(t_ns, pose) of every pose: its own time, or nominal times a second apart from ``start_ns``."""
    return [
        (start_ns + i * _NOMINAL_STEP_NS if p.t_ns is None else p.t_ns, p) for i, p in enumerate(poses)
    ]


def _read_rows(table: Path, *, key: str = "file") -> list[tuple[int, dict[str, str]]]:
    try:
        with table.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            header = [name.strip() for name in reader.fieldnames or []]
            reader.fieldnames = header
            unknown = [n for n in header if n not in (key, *_COLUMNS)]
            lacking = [n for n in (key, "angle_deg") if n not in header]
            if unknown or lacking or len(set(header)) < len(header):
                raise InputError(
                    f"{table}, line 1: columns are {header}, expected {key}, angle_deg and, "
                    "optionally, t_ns, laser, laser_on; each once",
                    hint="separate cells by commas; the first line names the columns",
                )
            rows = [
                (reader.line_num, _stripped(row, f"{table}, line {reader.line_num}")) for row in reader
            ]
    except OSError as error:
        raise InputError(f"{table}: cannot be read ({error.strerror})") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{table}: is no CSV in UTF-8 ({error})") from error
    if not rows:
        raise InputError(f"{table}: has no rows")
    return rows


def _stripped(row: dict[str | None, Any], where: str) -> dict[str, str]:
    """The cells of a row; the reader puts those beyond the last column under None."""
    if None in row:
        raise InputError(
            f"{where}: more cells than columns", hint="write decimals with a point: 12.5, not 12,5"
        )
    return {str(k): (v or "").strip() for k, v in row.items()}


def _image_of(name: str, names: dict[str, list[Path]], *, where: str) -> Path:
    # Spreadsheets on other systems write backslashes; a folder that is named must be the right one.
    parts = [p for p in name.replace("\\", "/").split("/") if p not in ("", ".", "..")]
    ending = "/" + "/".join(parts)
    found = [
        p for p in names.get(parts[-1] if parts else "", []) if p.absolute().as_posix().endswith(ending)
    ]
    if len(found) != 1:
        what = "no image" if not found else f"{len(found)} images"
        raise InputError(f"{where}: {what} named {name!r}", hint="names must be those of the images")
    return found[0]


def _pose(path: Path, row: dict[str, str], *, where: str) -> Pose:
    try:
        angle = float(row["angle_deg"])
    except ValueError:
        angle = math.nan
    if not abs(angle) <= _MOST_DEG:
        raise InputError(
            f"{where}: angle_deg is {row['angle_deg'][:40]!r}, expected a number of degrees "
            f"within {_MOST_DEG:g}"
        )
    t_ns = None
    if row.get("t_ns"):
        t_ns = _whole(row["t_ns"], 2**63)
        if t_ns is None:
            raise InputError(f"{where}: t_ns is {row['t_ns'][:40]!r}, expected whole nanoseconds")
    return Pose(path, angle, _lasers(row, where), t_ns)


def _lasers(row: dict[str, str], where: str) -> tuple[int, ...]:
    on = (row.get("laser_on") or "1").lower()
    if on not in _YES | _NO:
        raise InputError(f"{where}: laser_on is {row['laser_on']!r}, expected 1 or 0")
    if on in _NO:
        return ()
    numbers = [_whole(p.strip(), 256) for p in (row.get("laser") or "0").split(";")]
    if None in numbers:
        raise InputError(
            f"{where}: laser is {row['laser'][:40]!r}, expected a number from 0 to 255, or 0;1"
        )
    return tuple(sorted({n for n in numbers if n is not None}))


def _whole(text: str, limit: int) -> int | None:
    """A whole number below ``limit`` in plain digits, or None."""
    if not (text.isascii() and text.isdigit() and len(text) <= len(str(limit))):
        return None
    return int(text) if int(text) < limit else None
