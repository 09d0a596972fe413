"""The scene document: what a simulated rig looks at, how its lasers shine, and how its camera sees.

A TOML file (``format = "turnscan.scene"``) or the table ``[simulated.scene]`` of a rig file. Shapes
stand in scene space (mm, z up along the turntable's axis: docs/conventions.md); emitters stand in
camera space. Grey values (``_dn``) are those of an 8-bit frame; a mono16 frame holds 257 times as much.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, model_validator

from .calibration import Vector
from .document import Model, check_version, parse_toml, validate

FORMAT: Final = "turnscan.scene"
VERSION: Final = 1

#: No rig sees a thousand metres: a larger number was given in another unit.
_FAR_MM = 1e6
Mm = Annotated[float, Field(ge=-_FAR_MM, le=_FAR_MM)]
LengthMm = Annotated[float, Field(gt=0, le=_FAR_MM)]
Place = tuple[Mm, Mm, Mm]
Share = Annotated[float, Field(ge=0, le=1)]
Dn = Annotated[float, Field(ge=0, le=65535)]
TurnDeg = Annotated[float, Field(ge=-360, le=360)]


class Posed(Model):
    """Something with a place: turned about the scene's x, then y, then z, then moved to ``at_mm``."""

    at_mm: Place = Field(default=(0.0, 0.0, 0.0), description="its centre (plane, mesh: its origin)")
    turn_deg: tuple[TurnDeg, TurnDeg, TurnDeg] = Field(
        default=(0.0, 0.0, 0.0), description="turns about the scene's x, y, z, in this order"
    )
    albedo: Share = Field(default=0.7, description="share of the light that is scattered back")


class Plane(Posed):
    """A plane through ``at_mm``; its normal is z before turning. Without ``size_mm`` it never ends."""

    kind: Literal["plane"]
    size_mm: tuple[LengthMm, LengthMm] | None = Field(
        default=None, description="extent along x and y before turning"
    )


class Box(Posed):
    """A block seen from outside."""

    kind: Literal["box"]
    size_mm: tuple[LengthMm, LengthMm, LengthMm]


class Room(Posed):
    """The inside of a block: four walls, floor and ceiling. The rig must stand in it."""

    kind: Literal["room"]
    size_mm: tuple[LengthMm, LengthMm, LengthMm]


class Sphere(Posed):
    """A ball seen from outside."""

    kind: Literal["sphere"]
    radius_mm: LengthMm


class Cylinder(Posed):
    """A round rod along z before turning; without ``height_mm`` it never ends, else it has lids."""

    kind: Literal["cylinder"]
    radius_mm: LengthMm
    height_mm: LengthMm | None = None


class Mesh(Posed):
    """Triangles: a file (.stl, .obj), or vertices and triangles written out. Seen from both sides."""

    kind: Literal["mesh"]
    file: str | None = Field(default=None, description="relative to the document's own file")
    mm_per_unit: Annotated[float, Field(gt=0, le=1e6)] = Field(
        default=1.0, description="1 for a file in mm, 1000 for one in metres"
    )
    vertices_mm: tuple[Place, ...] = ()
    triangles: tuple[tuple[int, int, int], ...] = Field(
        default=(), description="three vertex numbers each, from 0"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.file is None) == (not self.triangles):
            raise ValueError("a mesh has either a file, or vertices_mm and triangles")
        for triangle in self.triangles:
            if not all(0 <= n < len(self.vertices_mm) for n in triangle):
                raise ValueError(
                    f"triangle {list(triangle)} names a vertex that is not among the "
                    f"{len(self.vertices_mm)} of vertices_mm"
                )
        return self


Shape = Annotated[Plane | Box | Room | Sphere | Cylinder | Mesh, Field(discriminator="kind")]


class Emitter(Model):
    """How one laser shines. Its plane stands in the calibration; this says where in it light starts."""

    laser: Annotated[int, Field(ge=0, le=255)] = Field(description="as in the calibration")
    emitter_mm: Place | None = Field(
        default=None,
        description="in camera space, in the laser's plane; left out: where the plane meets the "
        "camera's X axis (or Y axis, for a sheet above or below)",
    )
    fan_deg: Annotated[float, Field(gt=0, lt=180)] = Field(
        default=80.0, description="full opening of the fan of light"
    )
    aim: Vector | None = Field(
        default=None, description="middle of the fan, in camera space; left out: forward"
    )
    stripe: Literal["vertical", "horizontal"] | None = Field(
        default=None,
        description="whether truth has a point in each row (vertical) or in each column "
        "(horizontal); left out: as the plane lies",
    )
    stripe_dn_at_1m: Dn = Field(
        default=900.0,
        description="peak on white, square to the beam, at 1 m from the emitter, at the nominal "
        "exposure and the nominal stripe width",
    )
    line_sigma_mm: Annotated[float, Field(ge=0, le=100)] = Field(
        default=0.0, description="half thickness (standard deviation) of the sheet at its waist"
    )
    waist_at_mm: Annotated[float, Field(ge=0, le=_FAR_MM)] = Field(
        default=1000.0, description="distance from the emitter where the sheet is thinnest"
    )
    rayleigh_mm: LengthMm = Field(
        default=1000.0, description="distance from the waist where it is sqrt(2) times as thick"
    )
    colour_bgr: tuple[Share, Share, Share] = Field(
        default=(0.05, 0.1, 1.0), description="share of the light in each channel of a bgr8 frame"
    )


class Light(Model):
    """Ambient light and optics of the simulated camera."""

    exposure_us: Annotated[float, Field(gt=0, le=1e7)] = Field(
        default=10_000.0, description="nominal exposure: at it, all grey values are as given"
    )
    ambient_dn: Dn = 12.0
    ambient_gradient_dn: tuple[float, float] = Field(
        default=(0.0, 0.0), description="change of ambient light over the frame's width and height"
    )
    ambient_bgr: tuple[Share, Share, Share] = (1.0, 1.0, 1.0)
    stripe_sigma_px: Annotated[float, Field(gt=0, le=50)] = Field(
        default=1.8, description="nominal stripe width: point spread of lens and sensor"
    )
    focus_mm: LengthMm = Field(default=1000.0, description="depth that is in focus")
    aperture_mm: Annotated[float, Field(ge=0, le=500)] = Field(
        default=0.0, description="diameter of the entrance pupil; 0: everything is in focus"
    )


class Sensor(Model):
    """Noise and limits of the simulated sensor."""

    noise_dn: Annotated[float, Field(ge=0, le=1000)] = Field(
        default=2.0, description="read noise, standard deviation"
    )
    shot_dn_per_dn: Annotated[float, Field(ge=0, le=100)] = Field(
        default=0.02, description="variance of the shot noise for each grey value of light"
    )
    impulse_share: Share = Field(default=0.0, description="share of pixels struck black or white")
    speckle_contrast: Share = Field(
        default=0.0, description="standard deviation of the laser's light over its mean"
    )
    speckle_grain_px: Annotated[float, Field(ge=0.5, le=100)] = 1.5
    saturation_dn: Annotated[float, Field(gt=0, le=255)] = Field(
        default=255.0, description="grey values end here"
    )


class SceneDocument(Model):
    """What stands before a simulated rig, with its light, lasers and sensor."""

    format: Literal["turnscan.scene"] = FORMAT
    version: Literal[1] = VERSION
    name: str = ""
    light: Light = Light()
    sensor: Sensor = Sensor()
    lasers: tuple[Emitter, ...] = ()
    shapes: tuple[Shape, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.shapes:
            raise ValueError("shapes: there is nothing to see; add a [[shapes]] table")
        numbers = [emitter.laser for emitter in self.lasers]
        if len(set(numbers)) != len(numbers):
            raise ValueError(f"lasers: the same laser number stands twice in {numbers}")
        for emitter in self.lasers:
            if emitter.aim is not None and math.hypot(*emitter.aim) < 1e-9:
                raise ValueError(f"lasers: the aim of laser {emitter.laser} has no length")
        return self

    def emitter(self, laser: int) -> Emitter:
        """How ``laser`` shines; with the defaults where the document does not say."""
        return next((e for e in self.lasers if e.laser == laser), Emitter(laser=laser))


def parse_scene(data: dict[str, Any], *, where: str) -> SceneDocument:
    """A scene from a TOML table; ``where`` names the file in errors. The format may be left out."""
    if "format" in data or "version" in data:
        check_version(data, name=FORMAT, version=VERSION, where=where)
    return validate(SceneDocument, data, where=where)


def parse_scene_file(data: bytes, *, where: str) -> SceneDocument:
    """A scene from the bytes of a TOML file, which must say its format and version."""
    table = parse_toml(data, where=where)
    check_version(table, name=FORMAT, version=VERSION, where=where)
    return validate(SceneDocument, table, where=where)
