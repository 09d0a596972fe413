"""Triangles from .stl (binary, text) and .obj files, for the simulated scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ...schemas.errors import InputError
from .rays import Floats

#: A facet of binary STL: normal, three corners, attribute bytes (Burns, "Automated Fabrication", 1993).
_FACET = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("attribute", "<u2")])
_STL_HEAD = 84


def read_mesh(path: Path) -> Floats:
    """Corners (T, 3, 3) of the triangles in ``path``, in the file's own unit.

    InputError if the file cannot be read, is no mesh, or holds no triangle or a number not finite.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot read the mesh {path}: {error.strerror}",
            hint="a mesh file stands relative to the scene's own file",
        ) from error
    suffix = path.suffix.lower()
    if suffix not in {".stl", ".obj"}:
        raise InputError(f"{path}: a mesh is a .stl or .obj file", hint="convert it to STL")
    try:
        corners = _obj(data) if suffix == ".obj" else _stl(data)
    except (ValueError, IndexError) as error:
        raise InputError(f"{path}: not a readable {suffix} file ({error})") from error
    if not len(corners):
        raise InputError(f"{path}: holds no triangle")
    if not np.isfinite(corners).all():
        raise InputError(f"{path}: holds a coordinate that is not a finite number")
    return corners


def _stl(data: bytes) -> Floats:
    if len(data) >= _STL_HEAD:
        count = int.from_bytes(data[80:84], "little")
        # Binary files may begin with "solid" too; only their length tells them for sure.
        if len(data) == _STL_HEAD + count * _FACET.itemsize:
            return np.frombuffer(data, _FACET, count, _STL_HEAD)["corner"].astype(np.float64)
    if not data.lstrip().startswith(b"solid"):
        raise ValueError("neither binary STL of the length that it says, nor text")
    lines = (line.split() for line in data.decode("ascii", "replace").splitlines())
    vertices = [[float(a) for a in words[1:4]] for words in lines if words and words[0] == "vertex"]
    if len(vertices) % 3 or any(len(v) != 3 for v in vertices):
        raise ValueError(f"{len(vertices)} vertices do not make triangles")
    return np.array(vertices, np.float64).reshape(-1, 3, 3)


def _obj(data: bytes) -> Floats:
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        words = line.split()
        if not words or words[0] not in {"v", "f"}:
            continue
        if words[0] == "v":
            if len(words) < 4:
                raise ValueError(f"line {number}: a vertex of {len(words) - 1} numbers")
            vertices.append([float(a) for a in words[1:4]])
            continue
        at = [int(word.split("/")[0]) for word in words[1:]]
        # Counted from 1, or backwards from the last one.
        at = [n - 1 if n > 0 else len(vertices) + n for n in at]
        if len(at) < 3 or any(not 0 <= n < len(vertices) for n in at):
            raise ValueError(f"line {number}: a face that names no such vertex")
        faces += [[at[0], at[k], at[k + 1]] for k in range(1, len(at) - 1)]
    if not faces:
        return np.empty((0, 3, 3))
    return np.array(vertices, np.float64)[np.array(faces, np.int64)]
