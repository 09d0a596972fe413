"""The scene document: what it takes, and one clear error for what it does not."""

from __future__ import annotations

import pytest

from turnscan.schemas.errors import DocumentError, FormatVersionError
from turnscan.schemas.scene import Emitter, Mesh, SceneDocument, Sphere, parse_scene, parse_scene_file

WHOLE = b"""
format = "turnscan.scene"
version = 1
name = "everything"

[light]
exposure_us = 8000
ambient_dn = 20
ambient_gradient_dn = [5, -3]
focus_mm = 400
aperture_mm = 2

[sensor]
noise_dn = 1.5
impulse_share = 0.001
speckle_contrast = 0.3

[[lasers]]
laser = 2
emitter_mm = [150, 0, 10]
fan_deg = 60
colour_bgr = [0, 1, 0.2]

[[shapes]]
kind = "plane"
size_mm = [100, 200]
turn_deg = [90, 0, 0]
[[shapes]]
kind = "room"
size_mm = [4000, 4000, 2500]
[[shapes]]
kind = "box"
size_mm = [10, 20, 30]
[[shapes]]
kind = "sphere"
radius_mm = 25
at_mm = [0, 0, 25]
[[shapes]]
kind = "cylinder"
radius_mm = 5
height_mm = 40
[[shapes]]
kind = "mesh"
file = "part.stl"
[[shapes]]
kind = "mesh"
vertices_mm = [[0, 0, 0], [10, 0, 0], [0, 10, 0]]
triangles = [[0, 1, 2]]
albedo = 0.4
"""


def test_a_whole_document() -> None:
    scene = parse_scene_file(WHOLE, where="scene.toml")
    assert [s.kind for s in scene.shapes] == [
        "plane",
        "room",
        "box",
        "sphere",
        "cylinder",
        "mesh",
        "mesh",
    ]
    assert scene.emitter(2).fan_deg == 60
    assert scene.emitter(7) == Emitter(laser=7)
    assert scene.light.ambient_gradient_dn == (5, -3)
    assert SceneDocument.model_validate(scene.plain()) == scene


def test_a_table_needs_no_format() -> None:
    scene = parse_scene({"shapes": [{"kind": "sphere", "radius_mm": 3}]}, where="rig.toml")
    assert scene.shapes == (Sphere(kind="sphere", radius_mm=3),)


def changed(old: bytes, new: bytes) -> bytes:
    assert WHOLE.count(old) == 1
    return WHOLE.replace(old, new)


BAD = {
    "unknown key": (changed(b"fan_deg = 60", b"fan = 60"), r"lasers.0.fan: Extra inputs"),
    "unknown kind": (changed(b'"sphere"', b'"ball"'), r"shapes.3: Input tag 'ball' .* 'sphere'"),
    "no size": (changed(b"radius_mm = 25\n", b""), r"shapes.3.sphere.radius_mm: Field required"),
    "negative": (changed(b"radius_mm = 25", b"radius_mm = -25"), r"greater than 0 \(found -25\)"),
    "too far": (changed(b"[0, 0, 25]", b"[0, 0, 25e6]"), r"at_mm.2: .*less than or equal to 1000000"),
    "whiter than white": (
        changed(b"albedo = 0.4", b"albedo = 1.4"),
        r"albedo: .*less than or equal to 1 ",
    ),
    "not finite": (
        changed(b"ambient_dn = 20", b"ambient_dn = inf"),
        r"light.ambient_dn: .*(finite|65535)",
    ),
    "vertex": (changed(b"[[0, 1, 2]]", b"[[0, 1, 3]]"), r"triangle \[0, 1, 3\] names a vertex"),
    "fan": (changed(b"fan_deg = 60", b"fan_deg = 180"), r"fan_deg: .*less than 180"),
    "both": (
        changed(b'file = "part.stl"', b'file = "a.stl"\ntriangles = [[0, 0, 0]]'),
        "has either a file",
    ),
    "no mesh": (changed(b'file = "part.stl"', b""), "has either a file, or vertices_mm and triangles"),
    "aim": (changed(b"fan_deg = 60", b"aim = [0, 0, 0]"), "the aim of laser 2 has no length"),
    "twice": (WHOLE + b"[[lasers]]\nlaser = 2\n", r"the same laser number stands twice in \[2, 2\]"),
    "format": (changed(b"turnscan.scene", b"turnscan.rig"), "format is 'turnscan.rig', expected"),
    "not TOML": (b"[[[", "not TOML"),
    "empty": (b'format = "turnscan.scene"\nversion = 1\nshapes = []', "there is nothing to see"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_documents(name: str) -> None:
    data, message = BAD[name]
    with pytest.raises(DocumentError, match=message) as caught:
        parse_scene_file(data, where="scene.toml")
    assert caught.value.message.startswith("scene.toml: ")


def test_a_newer_document() -> None:
    with pytest.raises(FormatVersionError, match="version 9"):
        parse_scene({"format": "turnscan.scene", "version": 9}, where="scene.toml")


def test_a_mesh_of_a_file_needs_no_vertices() -> None:
    assert Mesh(kind="mesh", file="a.obj", mm_per_unit=1000).triangles == ()
