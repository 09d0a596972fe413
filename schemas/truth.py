"""Packing of the columns of a ``stripe-truth`` event: base64 of little-endian numbers."""

from __future__ import annotations

import base64
import binascii
from collections.abc import Mapping
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from .errors import DamageError, InputError
from .events import StripeTruth

#: Column -> type on the wire.
COLUMNS: Final = {
    "row": "<u2",
    "u_px": "<f8",
    "x_mm": "<f8",
    "y_mm": "<f8",
    "z_mm": "<f8",
    "range_mm": "<f8",
    "amplitude_dn": "<f4",
    "width_px": "<f4",
    "surface": "<u2",
}

Columns = Mapping[str, npt.NDArray[np.generic]]


def packed_truth(
    columns: Columns,
    *,
    t_ns: int,
    frame: int,
    laser: int,
    stripe: Literal["vertical", "horizontal"],
    angle_rad: float,
    camera: str = "0",
) -> StripeTruth:
    """The event for columns of one length, named as in :data:`COLUMNS`; InputError if they are not."""
    lengths = {name: len(columns[name]) if name in columns else -1 for name in COLUMNS}
    if len(set(lengths.values())) != 1 or set(columns) != set(COLUMNS):
        raise InputError(f"truth of frame {frame}: columns {sorted(columns)} of lengths {lengths}")
    packed = {
        name: base64.b64encode(np.ascontiguousarray(columns[name], kind).tobytes()).decode("ascii")
        for name, kind in COLUMNS.items()
    }
    return StripeTruth(
        t_ns=t_ns,
        frame=frame,
        camera=camera,
        laser=laser,
        stripe=stripe,
        angle_rad=angle_rad,
        points=lengths["row"],
        **packed,
    )


def unpacked_truth(event: StripeTruth) -> dict[str, npt.NDArray[np.generic]]:
    """Column name -> array (points,); DamageError where a column is not what it must be."""
    out: dict[str, npt.NDArray[np.generic]] = {}
    for name, kind in COLUMNS.items():
        try:
            data = base64.b64decode(getattr(event, name), validate=True)
        except (binascii.Error, ValueError) as error:
            raise DamageError(
                f"truth of frame {event.frame}: {name} is not base64 ({error})"
            ) from error
        if len(data) != event.points * np.dtype(kind).itemsize:
            raise DamageError(
                f"truth of frame {event.frame}: {name} holds {len(data)} bytes, expected "
                f"{event.points} numbers of type {kind}"
            )
        out[name] = np.frombuffer(data, kind)
    return out
