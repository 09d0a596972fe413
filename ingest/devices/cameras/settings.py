"""Set a camera's settings and read each one back: the one place where that is checked.

OpenCV's ``set`` says True when a driver took a request, not when the camera follows it, and many
captures ignore requests. So what counts is what ``get`` says afterwards.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol

from ....schemas.errors import DeviceError
from ..contracts import CameraInfo
from .capture import Image, encoding_of


class Properties(Protocol):
    """What is used of cv2.VideoCapture here."""

    def set(self, propId: int, value: float, /) -> bool:
        """Ask for a value."""

    def get(self, propId: int, /) -> float:
        """The value that stands; -1 or 0 for a property that the source has not."""


@dataclass(frozen=True)
class Setting:
    """One setting: the rig file's word for it, OpenCV's property, and the value in the rig file's unit.

    ``per_unit`` is how many of the property's units make one of the rig file's; ``tolerance`` (in the
    rig file's unit) is the step in which cameras can follow.
    """

    name: str
    property: int
    value: float
    per_unit: float = 1.0
    tolerance: float = 0.0


def refused(
    camera: str, name: str, asked: object, found: object, *, hint: str | None = None
) -> DeviceError:
    """The error of a camera that does not do what it was asked."""
    return DeviceError(
        f"{camera}: {name}: asked {_shown(asked)}, found {_shown(found)}",
        hint=hint or f"set {name} to a value that the camera has, or leave it out of the rig file",
    )


def _shown(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def apply(capture: Properties, settings: Iterable[Setting], *, camera: str) -> dict[str, float]:
    """Set all in order, then read each back; what was found, by the rig file's words and in its units.

    All are set before any is read, because some take effect together (V4L2: width and height).

    Raises
    ------
    DeviceError
        A setting was refused, silently or not: it names the setting, the value asked and the one found.
    """
    asked_all = [(setting, setting.value * setting.per_unit) for setting in settings]
    taken_all = [capture.set(setting.property, asked) for setting, asked in asked_all]
    found: dict[str, float] = {}
    for (setting, asked), taken in zip(asked_all, taken_all, strict=True):
        raw = capture.get(setting.property)
        if raw < 0 or (raw == 0 and asked != 0 and not taken):
            raise refused(
                camera,
                setting.name,
                setting.value,
                "nothing (this source has no such setting)",
                hint=f"leave {setting.name} out of the rig file",
            )
        value = raw / setting.per_unit
        if abs(value - setting.value) > setting.tolerance + 1e-9 * abs(setting.value):
            raise refused(camera, setting.name, setting.value, value)
        found[setting.name] = value
    return found


def checked_info(
    camera: str,
    image: Image,
    *,
    encoding: str,
    width_px: int | None,
    height_px: int | None,
    settings: dict[str, float | str],
) -> CameraInfo:
    """What a camera is, from its first frame, once that is what was asked for."""
    height, width = image.shape[:2]
    for name, asked, found in (("width_px", width_px, width), ("height_px", height_px, height)):
        if asked is not None and asked != found:
            raise refused(camera, name, asked, found)
    if encoding_of(image) != encoding:
        raise refused(
            camera, "encoding", encoding, encoding_of(image), hint=encoding_hint(encoding_of(image))
        )
    return CameraInfo(camera, width, height, encoding, settings)


def encoding_hint(found: str) -> str:
    """What to do about another pixel format than asked."""
    if found in ("mono8", "mono16", "bgr8"):
        return f'set encoding = "{found}"; turning colour into grey is a stage of the recipe'
    return "the log holds mono8, mono16 and bgr8: convert it, or have the camera send one of these"


def no_such_settings(camera: str, asked: dict[str, float | None]) -> None:
    """Refuse settings of a source that has none (files, network streams)."""
    for name, value in asked.items():
        if value is not None:
            raise refused(
                camera,
                name,
                value,
                "nothing (this source has no such setting)",
                hint=f"leave {name} out of the rig file",
            )
