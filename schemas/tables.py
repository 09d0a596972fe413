"""The columns of STRIPES and POINTS, each declared once with type, unit and meaning.

The Arrow schema, the checks at every boundary (:func:`TableSpec.conform`), the docs and the
attributes of exported files all follow from these declarations.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntFlag
from functools import cache
from typing import TYPE_CHECKING

from .errors import DamageError

if TYPE_CHECKING:
    import pyarrow as pa


class Flag(IntFlag):
    """Bits of the ``flags`` column."""

    SATURATED = 1
    EDGE = 2
    WEAK = 4
    SECOND = 8
    GATED = 16


FLAG_MEANINGS = {
    Flag.SATURATED: "some sample of the stripe is at or above the saturation level",
    Flag.EDGE: "the stripe touches the border of the frame or of its search window",
    Flag.WEAK: "amplitude is low for the noise: the centre is uncertain",
    Flag.SECOND: "another stripe of comparable brightness lies in the same row",
    Flag.GATED: "samples were left out of the fit as outliers",
}


@dataclass(frozen=True)
class Column:
    """One column: Arrow type name, unit ("" for none) and meaning."""

    name: str
    type: str
    unit: str
    description: str


@dataclass(frozen=True)
class TableSpec:
    """A named, ordered, closed list of columns; none of them may hold null."""

    name: str
    version: int
    columns: tuple[Column, ...]
    sort_by: tuple[str, ...]

    def arrow_schema(self) -> pa.Schema:
        """The Arrow schema, with unit and description in each field's metadata."""
        return _arrow_schema(self.columns)

    def conform(self, table: pa.Table, *, where: str) -> pa.Table:
        """``table`` with exactly these columns, order, types and field metadata.

        Neither ``pa.table`` nor ``Table.validate(full=True)`` enforces non-null, and engines drop
        field metadata: so every table passes here on its way to and from disk.

        Raises
        ------
        DamageError
            A column is missing, unknown, of another type, or holds null.
        """
        import pyarrow as pa

        names = [c.name for c in self.columns]
        missing = [n for n in names if n not in table.column_names]
        unknown = [n for n in table.column_names if n not in names]
        if missing or unknown:
            raise DamageError(
                f"{where}: not a {self.name} table (missing columns {missing}, unknown {unknown})"
            )
        schema = self.arrow_schema()
        arrays = []
        for column, field in zip(self.columns, schema, strict=True):
            array = table.column(column.name)
            if array.type != field.type:
                raise DamageError(
                    f"{where}: column {column.name} is {array.type}, expected {column.type}"
                )
            if array.null_count:
                raise DamageError(f"{where}: column {column.name} holds {array.null_count} nulls")
            arrays.append(array)
        return pa.table(arrays, schema=schema.with_metadata(table.schema.metadata))


@cache
def _arrow_schema(columns: tuple[Column, ...]) -> pa.Schema:
    import pyarrow as pa

    fields = [
        pa.field(
            c.name,
            pa.type_for_alias(c.type),
            nullable=False,
            metadata={"unit": c.unit, "description": c.description},
        )
        for c in columns
    ]
    return pa.schema(fields)


_FRAME = Column("frame", "uint32", "", "number of the frame in the scan, from 0")
_LASER = Column("laser", "uint8", "", "number of the laser, as in the calibration")
_ROW = Column("row", "uint16", "px", "row of the frame (vertical stripe) or column (horizontal stripe)")
_ANGLE = Column("angle_rad", "float32", "rad", "turntable angle of the frame, within one turn")
_U = Column("u_px", "float32", "px", "stripe centre along the row (vertical) or column (horizontal)")
_AMPLITUDE = Column("amplitude_dn", "float32", "DN", "peak of the stripe above its background")
_WIDTH = Column("width_px", "float32", "px", "stripe width, as Gaussian standard deviation")
_FLAGS = Column("flags", "uint16", "", "bits: " + ", ".join(f"{f.value} {f.name}" for f in Flag))

STRIPES = TableSpec(
    name="STRIPES",
    version=1,
    columns=(
        _FRAME,
        Column("t_ns", "int64", "ns", "exposure time of the frame, UTC epoch"),
        _LASER,
        _ANGLE,
        _ROW,
        _U,
        Column("sigma_u_px", "float32", "px", "standard deviation of u_px, NaN where unknown"),
        _AMPLITUDE,
        _WIDTH,
        Column("background_dn", "float32", "DN", "local background under the stripe"),
        _FLAGS,
    ),
    sort_by=("frame", "row"),
)

POINTS = TableSpec(
    name="POINTS",
    version=1,
    columns=(
        _FRAME,
        _LASER,
        _ROW,
        _ANGLE,
        _U,
        Column("x_mm", "float32", "mm", "scene x"),
        Column("y_mm", "float32", "mm", "scene y"),
        Column("z_mm", "float32", "mm", "scene z, up along the turntable axis"),
        Column("range_mm", "float32", "mm", "distance of the point from the camera's centre"),
        Column("sigma_range_mm", "float32", "mm", "standard deviation of range_mm, NaN where unknown"),
        _AMPLITUDE,
        _WIDTH,
        _FLAGS,
    ),
    sort_by=("frame", "row"),
)

TABLES = {"stripes": STRIPES, "points": POINTS}
