"""The simulated camera, against drawing one normal number for each pixel."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
from bench import best_cpu, show

from turnscan.ingest.room.board_patterns import Charuco, Chessboard
from turnscan.ingest.room.boards import BoardCamera
from turnscan.ingest.room.built_in import (
    desk_calibration,
    desk_document,
    room_calibration,
    room_document,
)
from turnscan.ingest.room.render import Encoding, Rendered, render
from turnscan.ingest.room.rig import SimulatedRig
from turnscan.ingest.room.scene import Scene
from turnscan.schemas.scene import Light, Mesh

pytestmark = pytest.mark.benchmark

#: What a frame of 640 x 480 may take on one core.
LIMIT_S = 0.010


def waves(across: int) -> Mesh:
    """A wavy sheet of 2 across^2 triangles over the turntable."""
    x, y = np.meshgrid(*[np.linspace(-60, 60, across + 1)] * 2)
    z = 30 + 12 * np.sin(x / 9) * np.cos(y / 11)
    n = np.arange((across + 1) ** 2).reshape(across + 1, across + 1)
    a, b, c, d = n[:-1, :-1], n[:-1, 1:], n[1:, :-1], n[1:, 1:]
    triangles = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (b, d, c))])
    vertices = np.stack([x, y, z], -1).reshape(-1, 3)
    return Mesh(
        kind="mesh",
        vertices_mm=tuple(tuple(v) for v in vertices.tolist()),
        triangles=tuple(tuple(t) for t in triangles.tolist()),
    )


def test_frames_of_640_by_480() -> None:
    rng = np.random.default_rng(0)
    room, desk = SimulatedRig(room_calibration()), desk_document()
    pair = SimulatedRig(desk_calibration(), emitters=desk.lasers)
    scenes = {"room": Scene(room_document().shapes), "desk": Scene(desk.shapes)}
    mesh = Scene([waves(220)])
    turn = iter(range(1_000_000))

    def shot(
        scene: Scene, rig: SimulatedRig, lasers: list[int], encoding: Encoding = "mono8"
    ) -> Rendered:
        n = next(turn)
        look = {"light": desk.light, "sensor": desk.sensor} if rig is pair else {}
        return render(scene, rig, 0.37 * n, seed=1, frame=n, lasers=lasers, encoding=encoding, **look)

    works = {
        "limit": lambda: rng.standard_normal((480, 640), np.float32),
        "room": partial(shot, scenes["room"], room, [0]),
        "room, laser off": partial(shot, scenes["room"], room, []),
        "desk, one laser": partial(shot, scenes["desk"], pair, [0]),
        "desk, two lasers": partial(shot, scenes["desk"], pair, [0, 1]),
        "desk, one laser, bgr8": partial(shot, scenes["desk"], pair, [0], "bgr8"),
        "mesh of 96800 triangles": partial(shot, mesh, pair, [0]),
    }
    took = best_cpu(works, 40)
    print(f"\n640 x 480; NumPy's normal numbers for a frame take {took['limit'] * 1e3:.2f} ms")
    for name in list(works)[1:]:
        note = f"{took[name] / LIMIT_S:.2f} of {LIMIT_S * 1e3:.0f} ms"
        show(f"render {name} / normal numbers", took[name] / took["limit"], note=note)


def test_boards() -> None:
    rng = np.random.default_rng(0)
    camera = BoardCamera(SimulatedRig(desk_calibration()), light=Light(ambient_dn=180))
    at = np.eye(4)
    at[:3, 3] = (-50, -40, 380)
    c, s = math.cos(0.3), math.sin(0.3)
    at[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    works = {
        "limit": lambda: rng.standard_normal((480, 640), np.float32),
        "chessboard": lambda: camera.look(Chessboard(8, 6, 14.0), at, seed=1),
        "ChArUco and laser": lambda: camera.look(Charuco(8, 6, 14.0, 10.0), at, seed=1, lasers=[0]),
    }
    took = best_cpu(works, 10)
    for name in list(works)[1:]:
        note = f"{took[name] * 1e3:.1f} ms"
        show(f"render {name} / normal numbers", took[name] / took["limit"], note=note)
