"""Recipes: ordered stages with parameters, each with a hand-raised version.

A recipe is a TOML file or a built-in name. Its id is the digest of its stages with every parameter
written out, so that a default that changes later does not silently change an old recipe.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, Self

from pydantic import Field, field_validator, model_validator

from .canonical import digest
from .document import Model, check_version, parse_toml, validate
from .errors import DocumentError, NotFoundError

FORMAT: Final = "turnscan.recipe"
VERSION: Final = 1

Dn = Annotated[float, Field(ge=0)]
Orientation = Literal["vertical", "horizontal"]


class Undistort(Model):
    """Remove lens distortion: from whole frames (the paper) or from stripe points (exact)."""

    stage: Literal["undistort"] = "undistort"
    on: Literal["frames", "points"] = "points"


class Grey(Model):
    """Colour frame to one channel. Grey frames pass unchanged."""

    stage: Literal["grey"] = "grey"
    mode: Literal["luma", "red", "green", "blue", "max", "weights", "red-minus-others"] = "luma"
    weights: tuple[float, float, float] | None = Field(
        default=None, description="red, green, blue; only with mode = weights"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.mode == "weights") != (self.weights is not None):
            raise ValueError('weights go with mode = "weights", and that mode needs them')
        return self


class Denoise(Model):
    """Gaussian 3x3 and median filters, in the paper's four combinations, or none.

    ``where = "stripe"`` filters the surroundings of the stripe alone: the same numbers there as
    ``"frame"`` gives. Left out it means ``"frame"``, and is then no part of the key.
    """

    stage: Literal["denoise"] = "denoise"
    method: Literal["none", "gaussian", "median", "gaussian-median", "median-gaussian"] = "median"
    median_size_px: Literal[3, 5] = 3
    where: Literal["frame", "stripe"] | None = Field(
        default=None, description="frame: everywhere, also if left out; stripe: only about the stripe"
    )

    @field_validator("where")
    @classmethod
    def _one_form(cls, value: str | None) -> str | None:
        # Both forms mean the same, so they have one key: that of recipes older than this parameter.
        return None if value == "frame" else value


class Window(Model):
    """Where the stripe of one laser may lie, as a half-open range along the row."""

    laser: Annotated[int, Field(ge=0, le=255)]
    from_px: Annotated[int, Field(ge=0)]
    to_px: Annotated[int, Field(gt=0)]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.to_px <= self.from_px:
            raise ValueError(f"to_px {self.to_px} is not above from_px {self.from_px}")
        return self


class Extract(Model):
    """Sub-pixel stripe centre in each row (vertical stripe) or column (horizontal).

    ``base_dn`` is the paper's Gbase: samples at or below it (above the local background) are not
    looked at. ``background = "off-frame"`` subtracts the nearest laser-off frame of the same angle.
    """

    stage: Literal["extract"] = "extract"
    method: Literal[
        "argmax",
        "threshold",
        "centroid",
        "parabola",
        "blais-rioux",
        "gaussian",
        "steger",
        "varied-boundary",
        "fused",
    ] = "varied-boundary"
    orientation: Orientation = "vertical"
    base_dn: Dn = 30.0
    background: Literal["none", "off-frame"] = "none"
    max_width_px: Annotated[float, Field(gt=0, le=400)] = 40.0
    saturation_dn: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="level from which a sample counts as clipped; None: full scale"
    )
    windows: tuple[Window, ...] = ()
    choice: Literal["brightest", "first", "nearest", "continuous"] | None = Field(
        default=None,
        description="which stripe of a row with several: the brightest if left out; the first along "
        "the row; the one nearest to expected_px; or the one that goes on along the stripe",
    )
    expected_px: float | None = Field(
        default=None, description="where the stripe is expected; only with choice = nearest"
    )
    pool_rows: Literal[1, 3] | None = Field(
        default=None,
        description="3: centres are means of three neighbouring rows that lie on a line; else 1",
    )

    @field_validator("choice", "pool_rows")
    @classmethod
    def _only_if_used(cls, value: Any) -> Any:
        # What is said but is the same as leaving it out must not make another recipe of it.
        return None if value in {"brightest", 1} else value

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.choice == "nearest") != (self.expected_px is not None):
            raise ValueError('expected_px goes with choice = "nearest", and that choice needs it')
        return self


class Triangulate(Model):
    """Stripe points and laser plane to scene points, with range limits (camera distance)."""

    stage: Literal["triangulate"] = "triangulate"
    min_range_mm: Annotated[float, Field(ge=0)] = 0.0
    max_range_mm: Annotated[float, Field(gt=0)] | None = None
    max_radius_mm: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="largest distance from the turntable axis that is kept"
    )
    sigma: Literal["random", "systematic"] | None = Field(
        default=None,
        description="share of the uncertainty in sigma_range_mm: random (the stripe centre), "
        "systematic (the calibration), or total, which is the default and not written down",
    )

    @field_validator("sigma", mode="before")
    @classmethod
    def _default(cls, value: Any) -> Any:
        # One meaning has one form, and so one key.
        return None if value == "total" else value


Stage = Annotated[Undistort | Grey | Denoise | Extract | Triangulate, Field(discriminator="stage")]

#: Raised by hand when a stage's results change for equal parameters and input.
STAGE_VERSIONS = {"undistort": 1, "grey": 1, "denoise": 1, "extract": 1, "triangulate": 1}

#: Raised by hand when one extraction method changes: recipes with other methods stay valid.
METHOD_VERSIONS = {
    "fused": 2,
    "varied-boundary": 2,
    "centroid": 2,
    "threshold": 1,
    "argmax": 2,
    "parabola": 1,
    "blais-rioux": 1,
    "gaussian": 1,
    "steger": 1,
}


def stage_version(stage: Stage) -> int | str:
    """The version that enters the key of ``stage``."""
    version = STAGE_VERSIONS[stage.stage]
    if isinstance(stage, Extract):
        return f"{version}.{METHOD_VERSIONS[stage.method]}"
    return version


class Recipe(Model):
    """Ordered stages: [undistort frames] [grey] [denoise] extract [undistort] triangulate."""

    format: Literal["turnscan.recipe"] = FORMAT
    version: Literal[1] = VERSION
    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]{0,39}$")]
    note: str = ""
    stages: tuple[Stage, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        order = [
            "undistort-frames",
            "grey",
            "denoise",
            "extract",
            "undistort-points",
            "triangulate",
        ]
        names = [_slot(s) for s in self.stages]
        if len(set(names)) != len(names):
            raise ValueError(f"a stage stands twice: {', '.join(names)}")
        if sorted(names, key=order.index) != names:
            raise ValueError(f"stages are out of order: {', '.join(names)}; order: {order}")
        if "extract" not in names or "triangulate" not in names:
            raise ValueError("a recipe needs the stages extract and triangulate")
        if "undistort-frames" in names and "undistort-points" in names:
            raise ValueError("undistort works on frames or on points, not on both")
        return self

    def recipe_id(self) -> str:
        """``r-`` and the first 12 hex digits of the digest of the stages (the name is no part)."""
        return f"r-{digest('recipe', [s.plain() for s in self.stages])[:12]}"

    def frame_stages(self) -> tuple[Stage, ...]:
        """The stages up to and including extract: frames in, STRIPES out."""
        return self.stages[: self._cut()]

    def point_stages(self) -> tuple[Stage, ...]:
        """The stages after extract: STRIPES in, POINTS out."""
        return self.stages[self._cut() :]

    def extract(self) -> Extract:
        """The extract stage."""
        return next(s for s in self.stages if isinstance(s, Extract))

    def _cut(self) -> int:
        return 1 + next(i for i, s in enumerate(self.stages) if isinstance(s, Extract))


def _slot(stage: Stage) -> str:
    return f"undistort-{stage.on}" if isinstance(stage, Undistort) else stage.stage


BUILT_IN = {
    "default": Recipe(
        name="default",
        note="grey, fused extraction from raw pixels; undistorts stripe points",
        stages=(Grey(), Extract(method="fused"), Undistort(), Triangulate()),
    ),
    "paper": Recipe(
        name="paper",
        note="Xiao et al. 2015: undistort frames, grey, median 3x3, varied-boundary",
        stages=(Undistort(on="frames"), Grey(), Denoise(), Extract(), Triangulate()),
    ),
}


def built_in_recipe(name: str) -> Recipe:
    """The built-in recipe ``name``; NotFoundError lists the names there are."""
    if name not in BUILT_IN:
        raise NotFoundError(
            f"no built-in recipe {name!r}; there are: {', '.join(sorted(BUILT_IN))}",
            hint="give one of these names or the path of a .toml file",
        )
    return BUILT_IN[name]


def parse_recipe(data: bytes, *, where: str) -> Recipe:
    """A recipe from TOML with ``name`` and ``[[stages]]`` tables, each with ``stage = "..."``."""
    value: dict[str, Any] = parse_toml(data, where=where)
    value.setdefault("format", FORMAT)
    value.setdefault("version", VERSION)
    check_version(value, name=FORMAT, version=VERSION, where=where)
    stages = value.get("stages")
    if not isinstance(stages, list) or not all(isinstance(s, dict) for s in stages):
        raise DocumentError(
            f"{where}: has no [[stages]] tables", hint="turnscan recipe show default prints one"
        )
    return validate(Recipe, value, where=where)
