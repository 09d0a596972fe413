"""Derived tables as polars LazyFrames over just the files that the catalogue names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..schemas.manifests import DerivationManifest
from ..schemas.tables import TABLES
from .bytes import LocalFolder
from .derivations import check_size

if TYPE_CHECKING:
    import polars as pl

#: What every row of an archive-wide table says of itself, ahead of the table's own columns.
ORIGIN = ("scan", "recipe", "recipe_name", "calibration", "key")


def lazy_table(store: LocalFolder, kind: str, manifests: Sequence[DerivationManifest]) -> pl.LazyFrame:
    """The rows of all ``manifests``, with scan, recipe, calibration and key of each.

    Nothing is read until the frame is collected; only columns and row groups that it needs are.

    Raises
    ------
    DamageError
        A file is missing or has another size than its manifest says.
    """
    import polars as pl

    spec = TABLES[kind]
    parts = []
    for manifest in manifests:
        check_size(store, manifest)
        origin = {
            "scan": manifest.scan,
            "recipe": manifest.recipe,
            "recipe_name": str(manifest.recipe_document.get("name", "")),
            "calibration": manifest.calibration,
            "key": manifest.key,
        }
        part = pl.scan_parquet(
            store.local(manifest.path), hive_partitioning=False, glob=False
        ).with_columns(pl.lit(v, dtype=pl.String).alias(k) for k, v in origin.items())
        parts.append(part)
    if parts:
        columns = [*ORIGIN, *(c.name for c in spec.columns)]
        return pl.concat(parts).select(columns)
    empty = pl.from_arrow(spec.arrow_schema().empty_table())
    assert isinstance(empty, pl.DataFrame)
    origin_columns = [pl.Series(name, [], dtype=pl.String) for name in ORIGIN]
    return pl.DataFrame([*origin_columns, *empty.get_columns()]).lazy()
