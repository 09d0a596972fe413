"""Record batches as packed structured arrays, for formats that store points one after another."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa


def packed_dtype(schema: pa.Schema, names: dict[str, str]) -> np.dtype[Any]:
    """A packed little-endian dtype of the columns in ``schema``, renamed by ``names``."""
    kinds = [(names.get(f.name, f.name), np.dtype(f.type.to_pandas_dtype())) for f in schema]
    return np.dtype([(n, k.newbyteorder("<")) for n, k in kinds])


def packed(batch: pa.RecordBatch, dtype: np.dtype[Any]) -> npt.NDArray[Any]:
    """The rows of ``batch`` in ``dtype``, whose fields are in the order of its columns."""
    out = np.empty(batch.num_rows, dtype)
    for name, column in zip(dtype.names or (), batch.columns, strict=True):
        out[name] = column.to_numpy(zero_copy_only=False)
    return out
