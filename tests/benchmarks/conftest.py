"""The benchmarks share bench.py beside them, and the simulated rig of the tests of calibration."""

from __future__ import annotations

import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent / "process" / "calibrate")]
