"""Covariance of the camera parameters, and whether the views bear it out.

The plain covariance takes all residuals for independent noise. Real ones are not: a bent board or a
lens that the model does not fit pull all corners of a view together. Each view's pull at the
solution shows it, and where the pulls are more than noise explains, the covariance is enlarged (as
a Birge ratio).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...schemas.errors import CalibrationError
from .bundle import Bundle
from .projection import project_with_derivatives

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Uncertainty:
    """What is known of the parameters.

    ``covariance`` (10, 10) as stated; ``noise_px`` of one coordinate of a corner; ``condition`` of the
    unknowns, each scaled to its own curvature; ``birge`` (>= 1): how much sigmas were enlarged.
    """

    covariance: Floats
    noise_px: float
    condition: float
    birge: float


def uncertainty_of(bundle: Bundle) -> Uncertainty:
    """Covariance of the solution, enlarged where the views contradict each other.

    Raises
    ------
    CalibrationError
        The normal matrix is singular: something that was to be estimated cannot be seen.
    """
    normal = bundle.normal.sum(axis=0)
    scale = 1.0 / np.sqrt(np.diag(normal))
    scaled = normal * np.outer(scale, scale)
    eigenvalues = np.linalg.eigvalsh(scaled)
    if not np.isfinite(eigenvalues).all() or eigenvalues[0] <= 1e-14 * eigenvalues[-1]:
        raise CalibrationError(
            "the views do not fix all that is to be estimated",
            hint="tilt the board in several directions, fill the image with it, or use --fix",
        )
    inverse = np.linalg.inv(scaled) * np.outer(scale, scale)
    noise = bundle.noise_px()
    plain = noise * noise * inverse
    birge = _birge(bundle, normal, noise)
    full = bundle.free @ (birge * birge * plain) @ bundle.free.T
    return Uncertainty(
        covariance=0.5 * (full + full.T),
        noise_px=noise,
        condition=float(np.sqrt(eigenvalues[-1] / eigenvalues[0])),
        birge=birge,
    )


def _birge(bundle: Bundle, normal: Floats, noise_px: float) -> float:
    """Square root of how much harder the views pull at the solution than noise would; 1 if not.

    The pull of view v is its gradient g_v at the solution. For independent noise of variance s^2
    the mean of sum_v g_v' N^-1 g_v is s^2 (m - sum_v tr(N^-1 N_v N^-1 N_v)), N_v being what the
    view adds to the normal matrix N of m unknowns.
    """
    count, m = len(bundle.residuals_px), bundle.free.shape[1]
    scale = 1.0 / np.sqrt(np.diag(normal))
    inverse = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
    pull = np.einsum("vi,ij,vj->v", bundle.slope, inverse, bundle.slope)
    share = inverse @ bundle.normal
    free = m - float(np.einsum("vij,vji->", share, share))
    if count < 4 or free <= 0.05 * m:
        return 1.0
    ratio = float(pull.sum()) / (noise_px**2 * free)
    # A sum of about m (views - 1) squares, unevenly weighted: this is passed by chance once in 20
    # or less.
    chance = 1.0 + 2.5 * float(np.sqrt(2.0 / (m * (count - 1))))
    return float(np.sqrt(ratio)) if ratio > chance else 1.0


def ray_sigma_mm_per_m(
    camera: Floats, covariance: Floats, size_px: tuple[int, int]
) -> tuple[float, float]:
    """How far the rays of the image are off at 1 m because of the camera, 1 sigma: rms and worst, mm.

    Over 9 x 7 pixels from border to border. A turn of all rays together is taken out: planes and
    axis that are estimated with the same camera absorb it whole. They absorb a part of the rest,
    too.
    """
    from ...schemas.calibration import Intrinsics
    from ..camera import undistort_points

    values = [float(v) for v in camera]
    lens = (values[5], values[6], values[7], values[8], values[9])
    width, height = size_px
    model = Intrinsics(
        width_px=width,
        height_px=height,
        fx_px=values[0],
        fy_px=values[1],
        cx_px=values[2],
        cy_px=values[3],
        skew=values[4],
        distortion=lens,
    )
    u, v = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 7))
    x, y = undistort_points(u.ravel(), v.ravel(), model)
    good = np.isfinite(x) & np.isfinite(y)
    rays = np.stack([x[good], y[good], np.ones(int(good.sum()))], axis=1)
    if not len(rays):
        return float("nan"), float("nan")
    _, by_camera, by_pose = project_with_derivatives(camera, rays, rays)
    moves = np.linalg.solve(by_pose[:, :, 3:5], by_camera)
    # A small turn w moves (x, y) of the ray (x, y, 1) by w x ray, brought back to z = 1.
    x, y = rays[:, 0], rays[:, 1]
    turns = np.stack(
        [np.stack([-x * y, 1.0 + x * x, -y], axis=1), np.stack([-1.0 - y * y, x * y, x], axis=1)],
        axis=1,
    )
    basis, _ = np.linalg.qr(turns.reshape(-1, 3))
    flat = moves.reshape(-1, 10)
    moves = (flat - basis @ (basis.T @ flat)).reshape(-1, 2, 10)
    variance = np.einsum("nij,jk,nik->n", moves, covariance, moves)
    return 1000.0 * float(np.sqrt(variance.mean())), 1000.0 * float(np.sqrt(variance.max()))
