"""Import a recording and look at its log; recordings of ROS 2 to begin with."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from turnscan.ingest.mcap_import import McapPlan, import_mcap, read_content
from turnscan.ingest.mcap_survey import Asked
from turnscan.schemas.errors import (
    InputError,
)
from turnscan.schemas.events import LogLine
from turnscan.store import Archive
from turnscan.store.bytes import STAGING

from ..images import pixels
from ..messages import cdr_writer as cdr
from ..recordings import MS, Recording, times


def run(archive: Archive, path: Path, **words: Any) -> list[object]:
    """Import and give all items of the new log."""
    asked = Asked(**{k: words.pop(k) for k in list(words) if k in Asked.__dataclass_fields__})
    plan = McapPlan(path, asked, **words)
    summary = import_mcap(archive, read_content(plan))
    return list(archive.log(summary.scan).items())


def refused(path: Path, match: str, error: type[Exception] = InputError, **words: Any) -> Any:
    with pytest.raises(error, match=match) as caught:
        asked = Asked(**{k: words.pop(k) for k in list(words) if k in Asked.__dataclass_fields__})
        read_content(McapPlan(path, asked, **words))
    return caught.value


def of_kind(items: list[object], kind: type) -> list[Any]:
    return [i for i in items if isinstance(i, kind)]


def nothing_is_left(archive: Archive) -> bool:
    folders = [archive.root / "scans", archive.root / STAGING]
    return not [p for f in folders for p in f.iterdir()] and archive.scans() == []


def said(items: list[object]) -> str:
    return "\n".join(line.message for line in of_kind(items, LogLine))


def ros_image(rec: Recording, t_ns: int, image: Any, encoding: str = "mono8", **more: Any) -> None:
    data = more.pop("data", image.tobytes())
    step = more.pop("step", len(data) // image.shape[0])
    message = cdr.image(
        t_ns, encoding, data, width=image.shape[1], height=image.shape[0], step=step, **more
    )
    rec.ros("/camera/image_raw", "sensor_msgs/msg/Image", t_ns + 5 * MS, message)


def joint(rec: Recording, t_ns: int, angle: float, *, topic: str = "/joints", **more: Any) -> None:
    data = cdr.joints(t_ns, {"table": angle, **more.pop("others", {})}, **more)
    rec.ros(topic, "sensor_msgs/msg/JointState", t_ns + 2 * MS, data)


def ros_recording(path: Path, count: int = 4, **how: Any) -> Path:
    """A joint report 10 ms before every image; stamps lie before log times."""
    rec = Recording(path, **how)
    for i, t_ns in enumerate(times(count)):
        joint(rec, t_ns - 10 * MS, math.radians(i))
        ros_image(rec, t_ns, pixels(i))
    return rec.close()
