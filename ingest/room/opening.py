"""From a rig file's [simulated] and [camera] to a simulated camera: scenes from files or by name."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

from ...schemas.calibration import Calibration, parse_calibration
from ...schemas.document import Model, validate
from ...schemas.errors import CalibrationError, DocumentError, InputError
from ...schemas.rig import Rig, Simulated
from ...schemas.scene import Light, SceneDocument, Sensor, parse_scene, parse_scene_file
from ..devices.contracts import Clock
from .built_in import BUILT_IN_CALIBRATIONS, BUILT_IN_SCENES
from .camera import Look, SimulatedCamera
from .rig import SimulatedRig
from .scene import Scene


def open_scene(scene: str | dict[str, Any], *, folder: Path, where: str) -> tuple[SceneDocument, Path]:
    """The scene document, and the folder that its mesh files are relative to.

    ``scene`` is the name of a built-in scene, the path of a scene file (relative to ``folder``), or the
    table itself; ``where`` names the rig file in errors.
    """
    if isinstance(scene, dict):
        return parse_scene(scene, where=f"{where}: simulated.scene"), folder
    if scene in BUILT_IN_SCENES:
        return BUILT_IN_SCENES[scene](), folder
    path = folder / scene
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(
            f"{where}: simulated.scene = {scene!r} is no built-in scene, and {path} cannot be read "
            f"({error.strerror})",
            hint=f"built-in are {', '.join(sorted(BUILT_IN_SCENES))}; or give the path of a scene.toml",
        ) from error
    return parse_scene_file(data, where=str(path)), path.parent


def relit(document: SceneDocument, changes: dict[str, Any], *, where: str) -> SceneDocument:
    """``document`` with other values of its light and sensor, by field name."""
    unknown = set(changes) - set(Light.model_fields) - set(Sensor.model_fields)
    if unknown:
        known = sorted([*Light.model_fields, *Sensor.model_fields])
        raise DocumentError(
            f"{where}: simulated.light has no {sorted(unknown)[0]!r}", hint=f"it has {', '.join(known)}"
        )
    table = f"{where}: simulated.light"
    light = {**document.light.model_dump(), **_of(Light, changes)}
    sensor = {**document.sensor.model_dump(), **_of(Sensor, changes)}
    made = {
        "light": validate(Light, light, where=table),
        "sensor": validate(Sensor, sensor, where=table),
    }
    return document.model_copy(update=made)


def _of(model: type[Model], changes: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in changes.items() if key in model.model_fields}


def true_calibration(rig: Rig, *, folder: Path, where: str) -> Calibration:
    """What a simulated rig truly is: the calibration of its rig file, else of its built-in scene."""
    if rig.calibration is not None:
        path = folder / rig.calibration
        try:
            data = path.read_bytes()
        except OSError as error:
            raise InputError(
                f"{where}: cannot read the calibration {path}: {error.strerror}",
                hint="calibration is a path relative to the rig file",
            ) from error
        return parse_calibration(data, where=str(path))
    scene = (rig.simulated or Simulated()).scene
    if isinstance(scene, str) and scene in BUILT_IN_CALIBRATIONS:
        return BUILT_IN_CALIBRATIONS[scene]()
    raise CalibrationError(
        f"{where}: a simulated camera needs a calibration, and this scene has none of its own",
        hint='name one in the rig file: calibration = "calibration.json"',
    )


def simulated_camera(
    rig: Rig,
    clock: Clock,
    *,
    actual_angle_rad: Callable[[int], float],
    lasers_lit: Callable[[int], Collection[int]],
    folder: Path,
    where: str,
    calibration: Calibration | None = None,
) -> SimulatedCamera:
    """The camera of a rig file with ``driver = "simulated"``.

    ``folder`` and ``where`` are the rig file's; ``calibration`` is what the rig truly is (None:
    :func:`true_calibration`). The callables are those of :class:`~.camera.SimulatedCamera`.
    CalibrationError where frame size or lasers of rig file and calibration differ.
    """
    simulated = rig.simulated or Simulated()
    document, beside = open_scene(simulated.scene, folder=folder, where=where)
    document = relit(document, simulated.light, where=where)
    truth = calibration or true_calibration(rig, folder=folder, where=where)
    wanted, intrinsics = rig.camera, truth.intrinsics_or_fail()
    size = (intrinsics.width_px, intrinsics.height_px)
    if wanted.width_px is not None and (wanted.width_px, wanted.height_px) != size:
        raise CalibrationError(
            f"{where}: camera is {wanted.width_px} x {wanted.height_px}, its calibration "
            f"{size[0]} x {size[1]} px",
            hint="a simulated camera has the size of its calibration: leave out width_px and height_px",
        )
    look = Look(
        Scene(document.shapes, folder=beside),
        SimulatedRig(truth, lasers=[laser.number for laser in rig.lasers], emitters=document.lasers),
        document.light,
        document.sensor,
        wanted.encoding,
        simulated.seed,
    )
    return SimulatedCamera(
        look,
        clock,
        actual_angle_rad=actual_angle_rad,
        lasers_lit=lasers_lit,
        exposure_us=wanted.exposure_us,
        fps=wanted.fps,
        timeout_s=wanted.timeout_s,
    )
