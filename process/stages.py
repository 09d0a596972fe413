"""The stages of one recipe, wired: frames to stripe points, stripe points to scene points."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..schemas.calibration import Calibration, Intrinsics
from ..schemas.errors import CalibrationError, InputError
from ..schemas.recipe import Denoise, Extract, Grey, Recipe, Triangulate, Undistort
from .camera import ideal_camera, numbers_of
from .denoise import denoise, denoise_at_stripe
from .extract import STRIPE_DTYPE, Extractor, noise_of
from .grey import to_grey
from .scene import Geometry, scene_columns
from .triangulate import axis_numbers, plane_numbers
from .uncertainty import factor_of
from .undistort import FrameUndistorter

Columns = dict[str, npt.NDArray[Any]]


class FrameChain:
    """The frame stages of a recipe: undistort, grey, denoise, extract. Pure but for cached maps."""

    def __init__(self, recipe: Recipe, calibration: Calibration | None) -> None:
        self._extract = recipe.extract()
        self._extractors: dict[tuple[int, ...], list[_Of]] = {}
        self._grey: Grey | None = None
        self._denoise = Denoise(method="none")
        self._undistort: FrameUndistorter | None = None
        self._camera: Intrinsics | None = None
        for stage in recipe.frame_stages():
            if isinstance(stage, Grey):
                self._grey = stage
            elif isinstance(stage, Denoise):
                self._denoise = stage
            elif isinstance(stage, Undistort):
                if calibration is None:
                    raise CalibrationError("undistorting frames needs a calibration")
                self._camera = calibration.intrinsics_or_fail()
                self._undistort = FrameUndistorter(self._camera)

    def extract(
        self,
        image: npt.NDArray[Any],
        lasers_on: tuple[int, ...],
        background: npt.NDArray[Any] | None = None,
    ) -> list[tuple[int, npt.NDArray[Any]]]:
        """(laser, stripe points) of every laser lit in one frame; see :func:`extract_stripe`.

        The points lie in memory that the next frame's are written to.
        """
        grey, noise = self._prepare(image)
        off = None
        if self._extract.background == "off-frame":
            if background is None:
                raise InputError("extract.background = off-frame, but no laser-off frame was given")
            off, _ = self._prepare(background)
        lit = self._extractors.get(lasers_on)
        if lit is None:
            lit = self._extractors[lasers_on] = _extractors(self._extract, lasers_on)
        if self._denoise.where == "stripe" and noise is not None:
            spans = [(of.from_px, of.to_px) for of in lit]
            grey, off = denoise_at_stripe(grey, off, self._denoise, self._extract, spans, noise)
        return [(of.laser, of.extractor(grey, off, noise, of.room(grey))) for of in lit]

    def _prepare(self, image: npt.NDArray[Any]) -> tuple[npt.NDArray[Any], float | None]:
        """The frame as extract takes it, and the noise of its pixels before it was filtered.

        None for a frame that is not filtered: extract finds it itself, in one call with all else.
        """
        if self._undistort is not None:
            assert self._camera is not None
            check_size(self._camera, image.shape[1], image.shape[0])
            image = self._undistort(image)
        if self._grey is not None:
            image = to_grey(image, self._grey)
        elif image.ndim != 2:
            raise InputError(
                "colour frames, and the recipe has no grey stage",
                hint='add [[stages]] stage = "grey" to the recipe',
            )
        if self._denoise.method == "none":
            return image, None
        noise = noise_of(image)
        # What is filtered only where the stripe is waits for extract(): both frames show where.
        return image if self._denoise.where == "stripe" else denoise(image, self._denoise), noise


@dataclass
class _Of:
    """How the stripe of one laser is extracted, and memory for its points."""

    laser: int
    from_px: int
    to_px: int | None
    extractor: Extractor
    _points: npt.NDArray[Any] = field(default_factory=lambda: np.empty(0, STRIPE_DTYPE))

    def room(self, frame: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """A point for each row or column of ``frame``: memory that is used again is at hand."""
        if len(self._points) < max(frame.shape):
            self._points = np.empty(max(frame.shape), STRIPE_DTYPE)
        return self._points


def _extractors(step: Extract, lasers_on: tuple[int, ...]) -> list[_Of]:
    """Those of every lit laser."""
    windows = {w.laser: (w.from_px, w.to_px) for w in step.windows}
    if len(lasers_on) > 1:
        missing = [n for n in lasers_on if n not in windows]
        if missing:
            raise InputError(
                f"lasers {list(lasers_on)} are lit in one frame, and nothing tells their stripes apart",
                hint=f"give extract.windows for lasers {missing} in the recipe, or light them singly",
            )
    made = []
    for laser in lasers_on:
        from_px, to_px = windows.get(laser, (0, None))
        extractor = Extractor(
            step.method,
            orientation=step.orientation,
            base_dn=step.base_dn,
            max_width_px=step.max_width_px,
            saturation_dn=step.saturation_dn,
            from_px=from_px,
            to_px=to_px,
            choice=step.choice or "brightest",
            expected_px=step.expected_px,
            pool_rows=step.pool_rows or 1,
        )
        made.append(_Of(laser, from_px, to_px, extractor))
    return made


def check_size(camera: Intrinsics, width_px: int, height_px: int) -> None:
    """Refuse frames of another size than the camera was calibrated with."""
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        raise CalibrationError(
            f"frames are {width_px} x {height_px}, the calibration is for "
            f"{camera.width_px} x {camera.height_px}",
            hint="use the calibration of this camera at this resolution (turnscan calibration list)",
        )


class PointChain:
    """The point stages of a recipe: undistort stripe points, triangulate."""

    def __init__(self, recipe: Recipe, calibration: Calibration) -> None:
        camera = calibration.intrinsics_or_fail()
        # Without the stage on points, either the frames were undistorted, and what is left is the
        # ideal camera, or the recipe takes the lens for ideal.
        points = any(isinstance(s, Undistort) for s in recipe.point_stages())
        camera = camera if points else ideal_camera(camera)
        step = next(s for s in recipe.stages if isinstance(s, Triangulate))
        lasers, joint = calibration.lasers, calibration.joint
        factors = [factor_of(step.sigma or "total", camera, plane, joint) for plane in lasers]
        self._geometry = Geometry(
            camera=numbers_of(camera),
            lasers=np.array([plane.laser for plane in lasers], np.int64),
            planes=np.array([plane_numbers(plane) for plane in lasers], np.float64).reshape(-1, 4),
            factors=_stacked(factors),
            axis=axis_numbers(calibration.axis_or_fail()),
            horizontal=recipe.extract().orientation == "horizontal",
            random=step.sigma != "systematic",
            limits=(
                step.min_range_mm,
                _LARGEST if step.max_range_mm is None else step.max_range_mm,
                _LARGEST if step.max_radius_mm is None else step.max_radius_mm,
            ),
        )
        self._calibration = calibration
        #: Stripe points that gave no scene point: behind the plane, out of limits, not invertible.
        self.dropped = 0

    def points(self, stripes: Mapping[str, npt.NDArray[Any]]) -> Columns:
        """POINTS columns from STRIPES columns, in the same order; lengths in the type of ``u_px``.

        Raises
        ------
        CalibrationError
            There is a stripe of a laser whose plane is not known.
        """
        made, keep, kept = scene_columns(stripes, self._geometry)
        lost = len(keep) - kept
        if lost:
            for laser in np.unique(stripes["laser"]):
                self._calibration.plane_or_fail(int(laser))
        self.dropped += lost
        copied = ("frame", "laser", "row", "angle_rad", "u_px", "amplitude_dn", "width_px", "flags")
        columns = {**{n: stripes[n] for n in copied}, **made}
        return columns if not lost else {k: a[keep] for k, a in columns.items()}


#: Stands for a limit that is not set: what is not finite is beyond it.
_LARGEST = float(np.finfo(np.float64).max)


def _stacked(factors: list[npt.NDArray[np.float64]]) -> npt.NDArray[np.float64]:
    """Factors (14, r) of several lasers as (L, 14, largest r): columns of zeros add nothing."""
    width = max((f.shape[1] for f in factors), default=0)
    out = np.zeros((len(factors), 14, width))
    for one, factor in zip(out, factors, strict=True):
        one[:, : factor.shape[1]] = factor
    return out
