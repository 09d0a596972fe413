"""Tables: one declaration, conform() refuses what Arrow itself lets through."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from turnscan.schemas.errors import DamageError
from turnscan.schemas.tables import POINTS, STRIPES, TABLES, Flag, TableSpec


def rows(spec: TableSpec, n: int = 3) -> pa.Table:
    schema = spec.arrow_schema()
    return pa.table([pa.array(np.zeros(n), type=f.type) for f in schema], schema=schema)


@pytest.mark.parametrize("spec", TABLES.values(), ids=lambda s: s.name)
def test_every_column_has_description_and_unit_of_its_name(spec: TableSpec) -> None:
    for column in spec.columns:
        assert column.description
        for suffix in ("mm", "px", "rad", "ns", "dn"):
            if column.name.endswith(f"_{suffix}"):
                assert column.unit.lower() == suffix


def test_columns_are_those_of_the_format() -> None:
    assert " ".join(c.name for c in STRIPES.columns) == (
        "frame t_ns laser angle_rad row u_px sigma_u_px amplitude_dn width_px background_dn flags"
    )
    assert " ".join(c.name for c in POINTS.columns) == (
        "frame laser row angle_rad u_px x_mm y_mm z_mm range_mm sigma_range_mm amplitude_dn "
        "width_px flags"
    )


def test_conform_restores_metadata_and_keeps_values() -> None:
    bare = rows(POINTS).replace_schema_metadata({"k": "v"})
    stripped = pa.table({n: bare.column(n) for n in bare.column_names})
    table = POINTS.conform(stripped, where="t")
    assert table.schema.field("x_mm").metadata[b"unit"] == b"mm"
    assert not table.schema.field("x_mm").nullable


def test_conform_refuses_nulls_types_and_columns() -> None:
    good = rows(POINTS)
    i = good.column_names.index("x_mm")
    holes = good.set_column(i, "x_mm", pa.array([1.0, None, 2.0], pa.float32()))
    with pytest.raises(DamageError, match=r"p\.parquet: column x_mm holds 1 nulls"):
        POINTS.conform(holes, where="p.parquet")
    wide = good.set_column(i, "x_mm", pa.array([1.0, 2.0, 3.0], pa.float64()))
    with pytest.raises(DamageError, match="x_mm is double, expected float32"):
        POINTS.conform(wide, where="p.parquet")
    with pytest.raises(DamageError, match=r"missing columns \['x_mm'\]"):
        POINTS.conform(good.drop_columns(["x_mm"]), where="p.parquet")
    extra = good.append_column("w", pa.array([1, 2, 3]))
    with pytest.raises(DamageError, match=r"unknown \['w'\]"):
        POINTS.conform(extra, where="p.parquet")


def test_flags_are_single_bits_of_sixteen() -> None:
    assert sorted(f.value for f in Flag) == [1 << i for i in range(len(Flag))]
    assert max(Flag).value < 1 << 16
