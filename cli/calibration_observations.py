"""Files of observations: what `calibrate camera`, `plane`, `axis` save and `refine` reads."""

from __future__ import annotations

import csv
import io
import math
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..schemas.errors import InputError, StorageError, UsageError
from .output import current_session

if TYPE_CHECKING:
    from ..schemas.observations import Observations, SeenAt

ObservationsOption = Annotated[
    Path | None,
    typer.Option(
        "--observations", metavar="FILE", help="Save what was used, for turnscan calibrate refine."
    ),
]
_COLUMNS = ("u_px", "v_px")


def write_observations(seen: Observations, out: Path) -> None:
    """The document as JSON; the file appears whole or not at all.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    staged = out.with_name(f".{out.name}.{uuid.uuid4().hex[:8]}")
    try:
        # Thousands of stripe points: a line each would make the file three times as large.
        staged.write_text(seen.model_dump_json(exclude_none=True) + "\n")
        staged.replace(out)
    except OSError as error:
        staged.unlink(missing_ok=True)
        raise StorageError(f"cannot write {out}: {error.strerror}") from error
    current_session().say(f"wrote the observations to {out}")


def read_observations(path: Path) -> Observations:
    """The observations in a file.

    Raises
    ------
    InputError
        There is no such file; DocumentError if it holds something else.
    """
    from ..schemas.observations import parse_observations

    return parse_observations(read_bytes(path), where=str(path))


def read_bytes(path: Path) -> bytes:
    """A file's bytes, or an InputError that names it."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}", hint="check the path") from error


def parse_reference(word: str, option: str) -> tuple[Path, float, float]:
    """``FILE.csv:VALUE:SD`` as path, value and sd, both mm.

    Raises
    ------
    UsageError
        It is not of this form, or a number is not positive.
    """
    rest, one, sd = word.rpartition(":")
    path, two, value = rest.rpartition(":")
    try:
        numbers = float(value), float(sd)
    except ValueError:
        numbers = math.nan, math.nan
    if not one or not two or not path or not all(math.isfinite(n) and n > 0 for n in numbers):
        raise UsageError(
            f"{option} {word!r}: expected FILE.csv:MM:SD_MM", hint="such as wall.csv:7000:1.5"
        )
    return Path(path), *numbers


def read_stripe_points(path: Path) -> list[SeenAt]:
    """Stripe points of a CSV with columns u_px, v_px, and laser, angle_deg, sigma_px as far as known.

    Without them: laser 0, angle 0, 0.2 px. One stripe is made of each laser, angle and ``end``, in the
    order of the file. A column along_v that is 1 or true marks horizontal stripes.

    Raises
    ------
    InputError
        The file cannot be read, has other columns, or a line is not made of numbers.
    """
    from ..schemas.observations import SeenAt, SeenStripe

    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: not text", hint="turnscan query ... --csv writes such files"
        ) from error
    reader = csv.DictReader(io.StringIO(text))
    names = reader.fieldnames or ()
    missing = [c for c in _COLUMNS if c not in names]
    if missing:
        raise InputError(
            f"{path}: has no column {missing[0]}; there are: {', '.join(names) or 'none'}",
            hint="columns u_px, v_px, and laser, angle_deg, sigma_px as far as known",
        )
    groups: dict[tuple[int, float, bool, str], list[tuple[float, float, float]]] = {}
    for number, row in enumerate(reader, 2):
        try:
            laser = int(row.get("laser") or 0)
            angle = float(row.get("angle_deg") or 0.0)
            values = float(row["u_px"]), float(row["v_px"]), float(row.get("sigma_px") or 0.2)
            along = (row.get("along_v") or "").strip().lower() in ("1", "true")
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{path}, line {number}: not numbers: {dict(row)}", hint="correct the line"
            ) from error
        if not all(map(math.isfinite, (angle, *values))) or values[2] <= 0 or not 0 <= laser <= 255:
            raise InputError(
                f"{path}, line {number}: a number is out of range: {dict(row)}", hint="correct the line"
            )
        groups.setdefault((laser, angle, along, row.get("end") or ""), []).append(values)
    if not groups:
        raise InputError(
            f"{path}: holds no stripe points", hint="a line for each stripe point, below the names"
        )
    return [
        SeenAt(
            angle_rad=math.radians(angle),
            stripe=SeenStripe(
                laser=laser,
                points_px=tuple((u, v) for u, v, _ in points),
                sigma_px=tuple(s for _, _, s in points),
                along_v=along,
            ),
        )
        for (laser, angle, along, _), points in groups.items()
    ]
