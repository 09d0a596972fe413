"""What `calibrate` commands saw, kept for a joint adjustment: points of boards, stripes, references.

Pixels are (u, v) with centres at integers, as in the frames (not undistorted); lengths in mm, angles in
rad. One file holds what one command used, after it left out what contradicted the rest.
"""

from __future__ import annotations

from typing import Annotated, Final, Literal, Self

from pydantic import Field, model_validator

from .document import Model, check_version, parse_json, validate
from .quality import EstimationInput

FORMAT: Final = "turnscan.observations"
VERSION: Final = 1

Pixel = tuple[float, float]
Place = tuple[float, float, float]
Laser = Annotated[int, Field(ge=0, le=255)]
Positive = Annotated[float, Field(gt=0)]


class SeenStripe(Model):
    """Stripe points of one laser: pixels, and 1 sigma of each centre, along u, or v if ``along_v``."""

    laser: Laser
    points_px: Annotated[tuple[Pixel, ...], Field(min_length=1)]
    sigma_px: tuple[Positive, ...]
    along_v: bool = False

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.sigma_px) != len(self.points_px):
            raise ValueError(f"{len(self.points_px)} points_px, {len(self.sigma_px)} sigma_px")
        return self


class SeenBoard(Model):
    """One flat board in one frame: its points in board space (z = 0), and the stripes on its plane."""

    name: str
    points_mm: Annotated[tuple[Place, ...], Field(min_length=4)]
    points_px: tuple[Pixel, ...]
    stripes: tuple[SeenStripe, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.points_px) != len(self.points_mm):
            raise ValueError(f"{len(self.points_mm)} points_mm, {len(self.points_px)} points_px")
        if any(p[2] != 0.0 for p in self.points_mm):
            raise ValueError("points_mm: z must be 0, boards are flat")
        return self


class SeenBody(Model):
    """Points of one rigid body (a marker, a board) in one frame of a turning table, by number."""

    frame: Annotated[int, Field(ge=0)]
    body: Annotated[int, Field(ge=0)]
    points_mm: Annotated[tuple[Place, ...], Field(min_length=1)]
    points_px: tuple[Pixel, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.points_px) != len(self.points_mm):
            raise ValueError(f"{len(self.points_mm)} points_mm, {len(self.points_px)} points_px")
        return self


class SeenTurning(Model):
    """Bodies on the table (or in the room, where the head turns) at several angles.

    ``angles_rad`` are nominal, a number a frame, each known to ``angle_sd_rad`` (0: exactly).
    ``size_sd`` is the relative 1 sigma of the bodies' size; 0: exactly as stated.
    """

    head: Literal["rotates", "fixed"]
    frames: tuple[str, ...]
    angles_rad: tuple[float, ...]
    angle_sd_rad: Annotated[float, Field(ge=0)]
    size_sd: Annotated[float, Field(ge=0)] = 0.0
    sightings: Annotated[tuple[SeenBody, ...], Field(min_length=3)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.angles_rad) != len(self.frames):
            raise ValueError(f"{len(self.frames)} frames, {len(self.angles_rad)} angles_rad")
        if max(s.frame for s in self.sightings) >= len(self.frames):
            raise ValueError(f"sightings: there are {len(self.frames)} frames only")
        return self


class SeenAt(Model):
    """A stripe on a reference, with the table (or head) at ``angle_rad``."""

    angle_rad: float = 0.0
    stripe: SeenStripe


class SeenWall(Model):
    """A flat wall: ``distance_mm`` square to it from the camera's centre, at the first stripe's angle.

    Its orientation is unknown; 1 sigma of the distance is ``sd_mm``.
    """

    name: str
    distance_mm: Positive
    sd_mm: Positive
    stripes: Annotated[tuple[SeenAt, ...], Field(min_length=1)]


class SeenSphere(Model):
    """A sphere of ``diameter_mm``, known to ``sd_mm``, that stands still in the scene."""

    name: str
    diameter_mm: Positive
    sd_mm: Positive
    stripes: Annotated[tuple[SeenAt, ...], Field(min_length=1)]


class SeenLength(Model):
    """Two places on stripes whose distance is ``length_mm``, known to ``sd_mm``.

    Each place is the mean of the points of its stripe (a short piece, across which the surface is
    flat).
    """

    name: str
    length_mm: Positive
    sd_mm: Positive
    ends: tuple[SeenAt, SeenAt]


class Observations(Model):
    """All that one command, or several joined, saw with one camera of ``width_px`` x ``height_px``."""

    format: Literal["turnscan.observations"] = FORMAT
    version: Literal[1] = VERSION
    width_px: Annotated[int, Field(gt=0)]
    height_px: Annotated[int, Field(gt=0)]
    boards: tuple[SeenBoard, ...] = ()
    turning: SeenTurning | None = None
    walls: tuple[SeenWall, ...] = ()
    spheres: tuple[SeenSphere, ...] = ()
    lengths: tuple[SeenLength, ...] = ()
    inputs: tuple[EstimationInput, ...] = ()


def parse_observations(data: bytes | str, *, where: str) -> Observations:
    """Observations from JSON text; ``where`` names the file in errors.

    Raises
    ------
    DocumentError
        It is no such document, or a field is wrong; FormatVersionError if it is a newer one.
    """
    value = parse_json(data, where=where)
    check_version(value, name=FORMAT, version=VERSION, where=where)
    return validate(Observations, value, where=where)
