"""LAS 1.4 and LAZ through laspy: metres, intensity from the amplitude, the other columns as extras."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import import_module
from pathlib import Path

import laspy
import numpy as np
import pyarrow as pa

from ...schemas.errors import InputError
from ...schemas.tables import POINTS
from . import ExportInfo
from .refusal import refusal

#: LAS stores 32-bit whole numbers: at 1 um a scene may reach 2 km.
_SCALE_M = 1e-6
_REACH_M = 2147.0
_EXTRAS = [c for c in POINTS.columns if c.name not in ("x_mm", "y_mm", "z_mm")]


def write(batches: Iterable[pa.RecordBatch], out: Path, info: ExportInfo, suffix: str) -> None:
    """Stream ``batches`` to ``out``."""
    header = laspy.LasHeader(version="1.4", point_format=6)
    header.scales = np.full(3, _SCALE_M)
    header.offsets = np.zeros(3)
    header.system_identifier = "turnscan"
    header.generating_software = info.software[:32]
    # LAS 1.4 asks for this bit with point format 6, whether a coordinate system is given or not.
    header.global_encoding.wkt = True
    header.vlrs.append(_description(info))
    for column in _EXTRAS:
        kind = np.dtype(column.type)
        unit = f"[{column.unit}] " if column.unit else ""
        params = laspy.ExtraBytesParams(column.name, kind, f"{unit}{column.description}"[:32])
        header.add_extra_dim(params)
    # lazrs hides what the file system said; .las is written without it.
    hiding = import_module("lazrs").LazrsError if suffix == ".laz" else ()
    try:
        # Our own file: laspy leaves the one that it opens open when it fails.
        with (
            out.open("w+b") as file,
            laspy.open(
                file, mode="w", header=header, do_compress=suffix == ".laz", closefd=False
            ) as writer,
        ):
            for batch in batches:
                if batch.num_rows:
                    writer.write_points(_points(batch, header))
    except hiding as error:
        raise refusal(error, out) from error


def _description(info: ExportInfo) -> laspy.VLR:
    """Where the points come from, as the standard's "text area description"."""
    text = "\n".join(info.lines()).encode("ascii", "backslashreplace")[: 2**16 - 2]
    return laspy.VLR("LASF_Spec", 3, "turnscan export", text + b"\0")


def _points(batch: pa.RecordBatch, header: laspy.LasHeader) -> laspy.ScaleAwarePointRecord:
    points = laspy.ScaleAwarePointRecord.zeros(batch.num_rows, header=header)
    for axis in "xyz":
        metres = batch.column(f"{axis}_mm").to_numpy().astype(np.float64) / 1000.0
        if not np.all(np.abs(metres) < _REACH_M):
            raise InputError(
                f"a point lies {np.abs(metres).max():.6g} m from the turntable's axis along {axis}; "
                f"LAS in steps of 1 um reaches {_REACH_M:.0f} m",
                hint="export to .e57 or .ply, or filter far points in the recipe",
            )
        points[axis] = metres
    amplitude = batch.column("amplitude_dn").to_numpy()
    points["intensity"] = np.clip(np.rint(amplitude), 0, 65535).astype(np.uint16)
    points["point_source_id"] = batch.column("scan_index").to_numpy().astype(np.uint16)
    points["return_number"] = np.ones(batch.num_rows, np.uint8)
    points["number_of_returns"] = np.ones(batch.num_rows, np.uint8)
    for column in _EXTRAS:
        points[column.name] = batch.column(column.name).to_numpy()
    return points
