"""What deriving needs, imported and its machine code loaded: workers are forked from a process that
imported this module, and from nothing else is it imported.
"""

from __future__ import annotations

import signal

import cv2

from ..schemas.calibration import Calibration, Intrinsics, LaserPlane, TurntableAxis
from ..schemas.recipe import BUILT_IN
from . import pipeline  # noqa: F401 (for the workers)
from .warming import warm

# Loading may take half a minute, the first time: Ctrl-C ends it, without a word.
signal.signal(signal.SIGINT, signal.SIG_DFL)
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
# A thread here would be missing in the workers.
cv2.setNumThreads(1)

_WIDTH_PX, _HEIGHT_PX = 64, 48

warm(
    BUILT_IN["default"],
    Calibration(
        rig="none",
        camera=Intrinsics(
            width_px=_WIDTH_PX, height_px=_HEIGHT_PX, fx_px=300.0, fy_px=300.0, cx_px=32.0, cy_px=24.0
        ),
        lasers=(LaserPlane(laser=0, normal=(0.6, 0.0, 0.8), distance_mm=150.0),),
        turntable=TurntableAxis(point_mm=(0.0, 0.0, 180.0), direction=(0.0, -1.0, 0.0)),
    ),
    _WIDTH_PX,
    _HEIGHT_PX,
    "mono8",
)
