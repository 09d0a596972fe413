"""``turnscan calibrate``: the group of the commands that estimate."""

from __future__ import annotations

from .calibrating import calibrate_app
from .calibrating_axis import calibrate_axis_command
from .calibrating_centre import calibrate_centre_command
from .calibrating_plane import calibrate_plane_command
from .calibrating_refine import calibrate_refine_command

__all__ = ["calibrate_app"]

calibrate_app.command(
    "plane",
    epilog="Examples: turnscan calibrate plane laser --pattern 8x6 --square-mm 40 -c camera.json "
    "-o cal.json --picture plane.png; turnscan calibrate plane pairs --off '*_off.png' "
    "--pattern 11x6 --square-mm 13 --laser 0 --laser 1 -c camera.json -o cal.json",
)(calibrate_plane_command)
calibrate_app.command(
    "axis",
    epilog="Examples: turnscan calibrate axis 'table/*.jpg' --step-deg 22.5 --markers 4X4_50 "
    "--marker-side-mm 30 -c cal.json -o rig.json; turnscan calibrate axis turned --angles angles.csv "
    "--pattern 9x6 --square-mm 25 --head rotates -c cal.json -o rig.json",
)(calibrate_axis_command)
calibrate_app.command(
    "laser-centre",
    epilog="Examples: turnscan calibrate laser-centre 500:230 2000:865; turnscan calibrate "
    "laser-centre 500:230 2000:865 --sigma-distance-mm 1.5 -c cal.json -o cal2.json",
)(calibrate_centre_command)
calibrate_app.command(
    "refine",
    epilog="Examples: turnscan calibrate refine camera-seen.json plane-seen.json axis-seen.json "
    "-c rig.json -o refined.json; turnscan calibrate refine camera-seen.json plane-seen.json "
    "-c rig.json --wall wall.csv:7000:1.5 -o refined.json",
)(calibrate_refine_command)
