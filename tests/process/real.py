"""The real turntable scan: its published calibration, its angles, and how its table is measured."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from turnscan.schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis

#: Numbers of srv_turntable/DATA.md: intrinsics published, plane and axis measured there.
SRV = Calibration(
    rig="srv",
    camera=Intrinsics(
        width_px=640,
        height_px=480,
        fx_px=620.26784,
        fy_px=618.61306,
        cx_px=322.94580,
        cy_px=239.42136,
        distortion=(0.113699, -0.193716, -0.001114, -0.002160, -0.035195),
    ),
    lasers=(LaserPlane(laser=0, normal=(0.90545, -0.13960, 0.40083), distance_mm=166.04),),
    turntable=TurntableAxis(point_mm=(13.57, 55.93, 412.84), direction=(0.03747, -0.92413, -0.38024)),
)


def srv_angle_deg(name: str) -> float:
    """Angle of step_num<K>.jpg: 1.125 (K - 2) degrees, frame 1 shows the same as frame 2."""
    number = int(re.findall(r"\d+", name)[-1])
    return 1.125 * (number - 2) if number >= 2 else 0.0


@dataclass(frozen=True)
class Measured:
    """What the table must show."""

    disc_rms_mm: float
    disc_tilt_deg: float
    rim_radius_mm: float
    rim_rms_mm: float
    block_mm: tuple[float, float, float]


def measure(x: np.ndarray, y: np.ndarray, z: np.ndarray, frame: np.ndarray) -> Measured:
    """Disc, rim and block of a POINTS table of srv_turntable; plain, without hiding outliers.

    Disc: every point within 4 mm of z = 0 between 70 and 97 mm from the axis. Rim: in each
    frame the outermost point near z = 0. Block: its four faces below the figure, and its top.
    """
    r = np.hypot(x, y)
    disc = (r > 70) & (r < 97) & (np.abs(z) < 4)
    design = np.stack([x[disc], y[disc], np.ones(disc.sum())], axis=1)
    plane, *_ = np.linalg.lstsq(design, z[disc], rcond=None)
    near = (np.abs(z) < 4) & (r < 115)
    rim = []
    for n in np.unique(frame):
        mine = np.flatnonzero(near & (frame == n))
        if len(mine):
            far = mine[np.argmax(r[mine])]
            rim.append((x[far], y[far]))
    edge = np.array(rim)
    circle, *_ = np.linalg.lstsq(
        np.column_stack([2 * edge, np.ones(len(edge))]), (edge**2).sum(axis=1), rcond=None
    )
    radius = float(np.sqrt(circle[2] + circle[0] ** 2 + circle[1] ** 2))
    off = np.hypot(edge[:, 0] - circle[0], edge[:, 1] - circle[1]) - radius
    return Measured(
        disc_rms_mm=float(np.sqrt(np.mean(z[disc] ** 2))),
        disc_tilt_deg=float(np.rad2deg(np.hypot(plane[0], plane[1]))),
        rim_radius_mm=radius,
        rim_rms_mm=float(np.sqrt(np.mean(off**2))),
        block_mm=_block(x, y, z, r),
    )


def _block(x: np.ndarray, y: np.ndarray, z: np.ndarray, r: np.ndarray) -> tuple[float, float, float]:
    side = (r < 62) & (z > 6) & (z < 34)
    points = np.stack([x[side], y[side]], axis=1)
    best = (0.0, points)
    for angle in np.deg2rad(np.arange(0, 90, 0.25)):
        c, s = np.cos(angle), np.sin(angle)
        turned = points @ np.array([[c, -s], [s, c]])
        low, high = np.percentile(turned, [1, 99], axis=0)
        share = float((np.minimum(abs(turned - low), abs(turned - high)) < 1.5).any(axis=1).mean())
        if share > best[0]:
            best = (share, turned)
    sizes = []
    for i in (0, 1):
        along, across = best[1][:, i], best[1][:, 1 - i]
        low, high = np.percentile(along, [1, 99])
        middle = (across > np.percentile(across, 10)) & (across < np.percentile(across, 90))
        faces = [np.median(along[middle & (np.abs(along - e) < 2)]) for e in (high, low)]
        sizes.append(float(faces[0] - faces[1]))
    top = (z > 36) & (z < 42.5) & (r > 25) & (r < 48)
    return max(sizes), min(sizes), float(np.median(z[top]))


def check_srv(found: Measured) -> None:
    """The limits that the data set's own page gives."""
    assert found.disc_rms_mm < 0.8, found
    assert found.disc_tilt_deg < 0.4, found
    assert abs(found.rim_radius_mm - 105.4) < 1.5, found
    assert found.rim_rms_mm < 0.15, found
    assert abs(found.block_mm[0] - 87.6) < 3, found
    assert abs(found.block_mm[1] - 50.8) < 3, found
    assert abs(found.block_mm[2] - 39.4) < 1, found


def read_colour(path: Path) -> np.ndarray:
    """A colour image as the log would give it."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image


def measure_archive(folder: str, calibration: str = "current") -> Measured:
    """What the newest scan of an archive shows, under the recipe default."""
    from turnscan.store import Archive

    archive = Archive.open(folder)
    scan = archive.scan("latest").scan
    points = archive.points(where=f"scan = '{scan}'", calibration=calibration).collect()
    x, y, z = (points[f"{a}_mm"].to_numpy().astype(np.float64) for a in "xyz")
    return measure(x, y, z, points["frame"].to_numpy())


if __name__ == "__main__":
    import sys

    found = measure_archive(*sys.argv[1:])
    print(f"disc: rms {found.disc_rms_mm:.2f} mm, tilt {found.disc_tilt_deg:.2f} deg")
    print(f"rim: radius {found.rim_radius_mm:.2f} mm, circle rms {found.rim_rms_mm:.3f} mm")
    print("block: {:.1f} x {:.1f} x {:.1f} mm".format(*found.block_mm))
