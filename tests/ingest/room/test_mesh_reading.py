"""STL and OBJ files, as others write them and as they should not be."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from turnscan.ingest.room.mesh_reading import read_mesh
from turnscan.schemas.errors import InputError


@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "obj"])
def test_what_trimesh_writes(tmp_path: Path, kind: str) -> None:
    box = trimesh.creation.icosphere(subdivisions=2, radius=12.5)
    path = tmp_path / f"ball.{kind[:3]}"
    box.export(path, file_type=kind)
    corners = read_mesh(path)
    expected = np.asarray(box.vertices)[np.asarray(box.faces)]
    assert corners.shape == expected.shape
    assert np.abs(corners - expected).max() < 1e-5


def test_a_binary_stl_whose_head_says_solid(tmp_path: Path) -> None:
    facet = struct.pack("<12fH", *[0.0] * 3, *[float(n) for n in range(9)], 0)
    path = tmp_path / "s.STL"
    path.write_bytes(b"solid by somebody".ljust(80) + struct.pack("<I", 1) + facet)
    assert read_mesh(path).tolist() == [[[0, 1, 2], [3, 4, 5], [6, 7, 8]]]


def test_obj_counts_from_one_and_backwards_and_takes_polygons(tmp_path: Path) -> None:
    path = tmp_path / "a.obj"
    path.write_text("# a square\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf 1/1/1 2//1 3 -1\n")
    assert read_mesh(path).tolist() == [
        [[0, 0, 0], [1, 0, 0], [1, 1, 0]],
        [[0, 0, 0], [1, 1, 0], [0, 1, 0]],
    ]


BAD = {
    "cut.stl": (b"\0" * 80 + struct.pack("<I", 5) + b"\0" * 60, "neither binary STL"),
    "words.stl": (b"solid a\nfacet\nvertex 1 2 x\n", "could not convert"),
    "two.stl": (b"solid a\nvertex 1 2 3\nvertex 1 2 3\n", "2 vertices do not make triangles"),
    "none.stl": (b"solid a\nendsolid a\n", "holds no triangle"),
    "nan.stl": (b"solid a\n" + b"vertex 1 nan 3\n" * 3, "not a finite number"),
    "far.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "line 4: a face that names no such vertex"),
    "zero.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "line 4: a face that names no such vertex"),
    "short.obj": (b"v 0 0\n", "line 1: a vertex of 2 numbers"),
    "empty.obj": (b"", "holds no triangle"),
    "a.ply": (b"ply\n", "a mesh is a .stl or .obj file"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files(tmp_path: Path, name: str) -> None:
    data, message = BAD[name]
    (tmp_path / name).write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        read_mesh(tmp_path / name)
    assert name in caught.value.message


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cannot read the mesh .*gone.stl: No such file"):
        read_mesh(tmp_path / "gone.stl")
