"""Meshes of synthetic sweeps: which points are joined, which way triangles face, units, closing."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pytest
import trimesh

from turnscan.ingest.image_import import ImportPlan, import_images
from turnscan.ingest.poses import poses_by_step
from turnscan.process.pipeline import derive
from turnscan.schemas.calibration import Calibration, TurntableAxis
from turnscan.schemas.errors import InputError
from turnscan.schemas.recipe import BUILT_IN
from turnscan.store import Archive
from turnscan.store.export import Viewpoint, export_points
from turnscan.store.export.mesh import sweep_faces

from ..archive.scans import calibration, write_images
from .clouds import MESHES, batch, cloud, info, xyz_mm

Head = Literal["fixed", "rotates"]
Turn = Literal["clockwise", "counterclockwise"]


def rig(head: Head = "fixed", turn: Turn = "counterclockwise") -> Calibration:
    """A camera that looks level at the axis, which stands upright 400 mm ahead of it."""
    axis = TurntableAxis(point_mm=(0, 30, 400), direction=(0, -1, 0), head=head, positive_turn=turn)
    return calibration().model_copy(update={"turntable": axis})


def sweep(
    profile: np.ndarray, sign: int, degrees: np.ndarray, *, scan: int = 0, laser: int = 0
) -> pa.RecordBatch:
    """The points (rows, 3) of turntable space ``profile``, seen at each of these angles."""
    turn = np.repeat(np.deg2rad(degrees), len(profile))
    x, y, z = np.tile(profile.astype(np.float64), (len(degrees), 1)).T
    cos, sin = np.cos(sign * turn), np.sin(sign * turn)
    return batch(
        {
            "frame": np.repeat(np.arange(len(degrees)), len(profile)),
            "row": np.tile(np.arange(len(profile)) + 100, len(degrees)),
            "laser": np.full(len(turn), laser),
            "angle_rad": turn,
            "x_mm": cos * x - sin * y,
            "y_mm": sin * x + cos * y,
            "z_mm": z,
        },
        scan,
    )


def faces_of(batches: list[pa.RecordBatch], viewpoints: list[Viewpoint]) -> np.ndarray:
    table = pa.Table.from_batches(batches)
    columns = {n: table.column(n).to_numpy() for n in table.column_names}
    return sweep_faces(xyz_mm(batches), columns, viewpoints)


def normals(batches: list[pa.RecordBatch], viewpoints: list[Viewpoint]) -> tuple[np.ndarray, ...]:
    """Unit normals of all triangles by the right-hand rule, and their middles."""
    corners = xyz_mm(batches)[faces_of(batches, viewpoints)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True), corners.mean(axis=1)


def wall(radius: float) -> np.ndarray:
    """A stripe on an upright wall, from above to below, on the side of the axis towards -y."""
    heights = np.linspace(40, -40, 21)
    return np.stack([np.full(21, 5.0), np.full(21, -radius), heights], axis=1)


@pytest.mark.parametrize("step", [5.0, -5.0])
@pytest.mark.parametrize("turn", ["clockwise", "counterclockwise"])
@pytest.mark.parametrize("head", ["fixed", "rotates"])
def test_triangles_face_the_camera(head: Head, turn: Turn, step: float) -> None:
    viewpoint = Viewpoint.of(rig(head, turn))
    degrees = 20 + step * np.arange(40)
    # The camera stands 400 mm from the axis, outside a post and inside a room.
    for radius, outward in ((50.0, 1), (900.0, -1)):
        normal, middle = normals([sweep(wall(radius), viewpoint.turn_sign, degrees)], [viewpoint])
        assert len(normal) == 39 * 20 * 2
        radial = middle * [1, 1, 0] / np.hypot(middle[:, 0], middle[:, 1])[:, None]
        assert (outward * (normal * radial).sum(axis=1) > 0.99).all()


def test_a_disc_faces_up_on_both_sides_of_the_axis() -> None:
    """Beyond the axis neighbours of the next frame lie on the other side: order alone misleads."""
    viewpoint = Viewpoint.of(rig())
    across = np.linspace(95.0, -95.0, 39)
    profile = np.stack([np.full(39, 4.0), across, np.zeros(39)], axis=1)
    batches = [sweep(profile, viewpoint.turn_sign, np.arange(0, 90, 5.0))]
    normal, _ = normals(batches, [viewpoint])
    assert (normal[:, 2] > 0.99).all()
    misled, _ = normals(batches, [])
    assert (misled[:, 2] > 0.99).any()
    assert (misled[:, 2] < -0.99).any()


@pytest.mark.parametrize("head", ["fixed", "rotates"])
def test_the_viewpoint_is_where_ranges_are_measured_from(tmp_path: Path, head: Head) -> None:
    archive = Archive.init(tmp_path / "lab")
    (tmp_path / "images").mkdir()
    source = write_images(tmp_path / "images", 4)
    poses = poses_by_step(sorted(source.glob("*.png")), step_deg=10.0)
    document = rig(head, "clockwise")
    import_images(archive, ImportPlan(poses, rig="r1", calibration=document))
    assert [o.error for o in derive(archive, archive.scans(), BUILT_IN["default"])] == [None]
    (made,) = (m for m in archive.derivations() if m.kind == "points")
    points = pa.Table.from_batches(archive.read(made)).to_pydict()
    at = Viewpoint.of(document)
    turn = at.turn_sign * np.array(points["angle_rad"])
    x, y, z = at.centre_mm
    cos, sin = np.cos(turn), np.sin(turn)
    camera = np.stack([cos * x - sin * y, sin * x + cos * y, np.full_like(turn, z)], axis=1)
    there = np.stack([points[f"{a}_mm"] for a in "xyz"], axis=1)
    assert len(there) > 100
    assert np.ptp(turn) > 0.5
    np.testing.assert_allclose(np.linalg.norm(there - camera, axis=1), points["range_mm"], rtol=1e-6)


@pytest.mark.parametrize(
    ("degrees", "closed"),
    [
        (np.arange(0, 360, 5.0), True),
        (np.arange(0, -360, -5.0), True),
        (np.arange(250, 610, 5.0), True),
        (np.arange(250, 610, 5.0) % 360, True),
        (np.arange(0, 358, 5.0) + np.random.default_rng(1).normal(0, 0.3, 72), True),
        (np.arange(0, 355, 5.0), False),
        (np.arange(0, 361, 5.0), False),
        (np.arange(0, 400, 5.0), False),
        (np.arange(0, 180, 5.0), False),
        (np.array([0.0, 180.0]), False),
    ],
    ids=(
        *("turn", "back", "on", "wrapped", "uneven"),
        *("one-frame-short", "first-again", "more-than-a-turn", "half", "two-frames"),
    ),
)
def test_only_a_full_turn_closes(degrees: np.ndarray, closed: bool) -> None:
    batches = [sweep(wall(50.0), -1, degrees)]
    faces = faces_of(batches, [Viewpoint.of(rig())])
    last = len(degrees) - 1
    frame = batches[0].column("frame").to_numpy()[faces]
    joins = (frame == 0).any(axis=1) & (frame == last).any(axis=1) & (last > 1)
    assert joins.sum() == (40 if closed else 0)
    if closed:
        assert len(faces) == 20 * 2 * len(degrees)
        mesh = trimesh.Trimesh(xyz_mm(batches), faces, process=False)
        assert mesh.euler_number == 0, "a tube"
        assert mesh.is_winding_consistent


def test_edges_are_at_most_eight_medians_long() -> None:
    """Two plates, one behind the other: the step between them stays open, a slope does not."""
    profile = np.stack([np.zeros(40), np.full(40, -50.0), np.linspace(39, 0, 40)], axis=1)
    profile[20:, 1] -= 30.0
    batches = [sweep(profile, -1, np.arange(0, 30, 1.0))]
    faces = faces_of(batches, [])
    row = batches[0].column("row").to_numpy()[faces]
    assert not ((row <= 119).any(axis=1) & (row >= 120).any(axis=1)).any()
    assert len(faces) == 29 * 38 * 2
    # Rows lie 1 mm apart, frames 0.9 to 1.4 mm: 8 to 11 mm is as far as an edge may reach.
    profile[20:, 1] += 24.0
    assert len(faces_of([sweep(profile, -1, np.arange(0, 30, 1.0))], [])) == 29 * 39 * 2


def test_scans_and_lasers_are_not_joined() -> None:
    parts = [
        sweep(wall(50.0), -1, np.arange(0, 50, 5.0)),
        sweep(wall(50.1), -1, np.arange(0, 50, 5.0), laser=1),
        sweep(wall(50.2), -1, np.arange(0, 50, 5.0), scan=1),
    ]
    faces = faces_of(parts, [Viewpoint.of(rig())] * 2)
    table = pa.Table.from_batches(parts)
    for name in ("laser", "scan_index"):
        of = table.column(name).to_numpy()[faces]
        assert (of == of[:, :1]).all()
    assert len(faces) == 3 * 9 * 20 * 2


def exported(path: Path, batches: list[pa.RecordBatch], **more: Any) -> trimesh.Trimesh:
    export_points(batches, path, info(batches, **more))
    found = trimesh.load(path, force="mesh")
    assert isinstance(found, trimesh.Trimesh)
    return found


@pytest.mark.parametrize("suffix", MESHES)
def test_files_hold_the_mesh_in_their_own_units(tmp_path: Path, suffix: str) -> None:
    at = Viewpoint.of(rig())
    batches = [sweep(wall(50.0), at.turn_sign, np.arange(0, 180, 5.0))]
    faces = faces_of(batches, [at])
    points = xyz_mm(batches)
    expected = points[faces]
    if suffix == ".glb":
        expected = np.stack([expected[..., 0], expected[..., 2], -expected[..., 1]], axis=-1) / 1000
    found = exported(tmp_path / f"mesh{suffix}", batches, viewpoints=[at])
    assert len(found.faces) == len(faces) == 35 * 20 * 2
    # Readers may begin a triangle at any corner, but keep its direction and the triangles' order.
    there = found.vertices[found.faces]
    shifts = np.stack([np.abs(np.roll(there, k, axis=1) - expected).max(axis=(1, 2)) for k in range(3)])
    assert shifts.min(axis=0).max() < 1e-6 * np.abs(expected).max()


@pytest.mark.parametrize("suffix", MESHES)
def test_no_mesh_without_neighbours(tmp_path: Path, suffix: str) -> None:
    for batches, words in (
        ([], "there are no points to make a mesh of"),
        ([cloud(0)], "there are no points to make a mesh of"),
        ([cloud(1)], "no points are neighbours of each other"),
        ([sweep(wall(50.0), 1, np.array([3.0]))], "no points are neighbours of each other"),
    ):
        with pytest.raises(InputError, match=words):
            export_points(batches, tmp_path / f"mesh{suffix}", info(batches))
    assert list(tmp_path.iterdir()) == []
