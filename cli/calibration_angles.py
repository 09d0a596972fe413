"""What `turnscan calibrate axis` looks at: images or frames of a scan, each with its nominal angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from ..schemas.errors import UsageError
from .calibrating_geometry import read_inputs
from .calibration_inputs import Picture
from .places import open_archive

if TYPE_CHECKING:
    from ..schemas.quality import LeftOut


@dataclass(frozen=True)
class Turned:
    """Pictures that have pixels, their angles as the controller counts them, and what is left out."""

    pictures: tuple[Picture, ...]
    angles_rad: tuple[float, ...]
    left_out: tuple[LeftOut, ...]


def check_angles(
    images: Sequence[str] | None,
    scans: Sequence[str] | None,
    step_deg: float | None,
    table: Path | None,
) -> None:
    """Refuse, before any work, words that leave an angle open or give it twice.

    Raises
    ------
    UsageError
        Images and scans were both named, or angles are missing, or given twice.
    """
    if scans and images:
        raise UsageError(
            "images and --scan exclude each other", hint="their angles are not counted from one zero"
        )
    if scans and (step_deg is not None or table is not None):
        raise UsageError(
            "--step-deg and --angles do not go with --scan", hint="a scan's log holds its angles"
        )
    if not scans and (step_deg is None) == (table is None):
        raise UsageError(
            "give either --step-deg or --angles",
            hint="angles are never guessed; --scan takes them from a scan's log",
        )


def read_turned(
    images: Sequence[str] | None,
    scans: Sequence[str] | None,
    every: int,
    *,
    step_deg: float | None,
    start_deg: float,
    table: Path | None,
) -> Turned:
    """Images with angles from a step or a table, or a scan's frames with the angles of its log.

    Raises
    ------
    UsageError
        Nothing was named, or the words contradict each other (:func:`check_angles`).
    InputError
        The table does not fit the images, or a path does not exist.
    """
    check_angles(images, scans, step_deg, table)
    if scans:
        return _from_scans(scans, every)
    found, unused = read_inputs(list(images or []), None, 1)
    angles = _of_images(images or [], step_deg, start_deg, table)
    good = [i for i, p in enumerate(found) if p.image is not None]
    return Turned(
        tuple(found[i] for i in good), tuple(math.radians(angles[i]) for i in good), tuple(unused)
    )


def _of_images(
    images: Sequence[str], step_deg: float | None, start_deg: float, table: Path | None
) -> list[float]:
    """The angle in degrees of every image, in the images' own order."""
    from ..ingest.image_sources import find_images
    from ..ingest.poses import poses_by_step, poses_from_csv

    paths, _ = find_images(list(images))
    if table is not None:
        poses = poses_from_csv(paths, table)
    else:
        assert step_deg is not None
        poses = poses_by_step(paths, step_deg=step_deg, start_deg=start_deg)
    given = {p.path: p.angle_deg for p in poses}
    return [given[path] for path in paths]


def _from_scans(scans: Sequence[str], every: int) -> Turned:
    """Every ``every``-th frame of the scans, with the angle that the log has for it."""
    from ..process.pairing import place_frames
    from ..schemas.events import TurntableAngle
    from ..schemas.quality import LeftOut
    from ..store.log_reader import LogFrame

    pictures, angles, unused = [], [], []
    archive = open_archive()
    for word in scans:
        scan = archive.scan(word).scan
        late: list[int] = []
        why = "its log has no turntable angle for it"
        items = archive.log(scan).items()
        told = (item for item in items if isinstance(item, (TurntableAngle, LogFrame)))
        for i, placed in enumerate(place_frames(told, late)):
            if i % every:
                continue
            name = f"{scan} frame {placed.item.frame}"
            if placed.angle_rad is None:
                unused.append(LeftOut(what=name, why=why))
                continue
            pictures.append(Picture(name, None, placed.item.decode()))
            angles.append(placed.angle_rad)
        unused += [LeftOut(what=f"{scan} frame {n}", why=why) for n in late]
    return Turned(tuple(pictures), tuple(angles), tuple(unused))
