"""Square ArUco and AprilTag markers in one image: their numbers and corners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from ...schemas.board import DICTIONARIES
from ...schemas.errors import InputError, UsageError

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Marker:
    """One marker: its number and its corners (4, 2) in px, clockwise from its own top left."""

    number: int
    corners_px: Floats


def find_markers(
    grey: npt.NDArray[Any], dictionary: str, *, numbers: set[int] | None = None
) -> tuple[list[Marker], list[int]]:
    """The markers in ``grey`` (H, W) uint8, by number, and the numbers that were seen twice.

    A number seen twice belongs to two different things, and neither is used. ``numbers`` limits what
    is looked for.
    """
    if dictionary not in DICTIONARIES:
        raise UsageError(
            f"no dictionary {dictionary!r}", hint=f"one of {' '.join(DICTIONARIES)}; 4X4_50 is common"
        )
    if grey.ndim != 2 or grey.dtype != np.uint8:
        raise InputError(f"markers are looked for in grey 8-bit frames, not {grey.shape} {grey.dtype}")
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    # A window of a share of the marker's own modules: a fixed one reaches into the neighbours.
    settings.cornerRefinementWinSize = 4
    settings.relativeCornerRefinmentWinSize = 0.35
    code = getattr(cv2.aruco, f"DICT_{dictionary}")
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(code), settings)
    corners, found, _ = detector.detectMarkers(grey)
    if found is None or not len(corners):
        return [], []
    labels = np.asarray(found).ravel().astype(int)
    twice = sorted({int(n) for n in labels if (labels == n).sum() > 1})
    out = [
        Marker(int(n), np.asarray(c, np.float64).reshape(4, 2))
        for n, c in zip(labels, corners, strict=True)
        if n not in twice and (numbers is None or int(n) in numbers)
    ]
    return sorted(out, key=lambda m: m.number), twice


def marker_points_mm(side_mm: float) -> Floats:
    """The corners (4, 3) of a marker about its own middle, in the detector's order."""
    half = side_mm / 2.0
    return np.array([[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]])
