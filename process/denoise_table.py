"""The paper's Table 1 on any frames: what each filter does, against three references."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from ..schemas.errors import InputError
from ..schemas.recipe import Denoise
from .denoise import denoise
from .psnr import Distance, peak_dn

Image = npt.NDArray[Any]
Reference = Literal["unfiltered", "truth", "temporal_mean"]

#: The paper's four experiments, and doing nothing, which tells what they are worth.
_METHODS: Final = ("none", "gaussian", "median", "gaussian-median", "median-gaussian")
REFERENCES: Final[tuple[Reference, ...]] = ("unfiltered", "truth", "temporal_mean")


class FilterTable:
    """Gathers frames one by one; nothing of them is kept but sums.

    ``unfiltered`` is the paper's reference: it measures how much a filter changes an image, not how
    good the result is, and doing nothing scores infinity. ``truth`` is the noise-free image,
    ``temporal_mean`` what it is best known to be.
    """

    def __init__(self, median_size_px: Literal[3, 5] = 3) -> None:
        self._steps = [Denoise(method=m, median_size_px=median_size_px) for m in _METHODS]
        self._sums: dict[tuple[str, str], Distance] = {}
        self._dtype: np.dtype[Any] | None = None
        self.frames = 0

    @property
    def peak_dn(self) -> float:
        """Full scale of the frames."""
        assert self._dtype is not None, "no frame was added"
        return peak_dn(self._dtype)

    def add(self, frame: Image, references: Mapping[Reference, Image]) -> None:
        """Filter a grey frame (H, W), uint8 or uint16, by every method and compare with ``references``.

        The unfiltered frame itself need not be among them.

        Raises
        ------
        InputError
            The frame has another type than the first one, or a reference has another shape.
        """
        if frame.dtype not in (np.uint8, np.uint16) or frame.dtype != (self._dtype or frame.dtype):
            raise InputError(
                f"the frame is {frame.dtype}, expected {self._dtype or 'uint8 or uint16'}",
                hint="PSNR is told by full scale: frames of one type alone can share a table",
            )
        self._dtype = frame.dtype
        self.frames += 1
        for step in self._steps:
            filtered = denoise(frame, step)
            for name, reference in {**references, "unfiltered": frame}.items():
                self._sums.setdefault((step.method, name), Distance()).add(filtered, reference)

    def has(self, reference: Reference) -> bool:
        """Whether any frame came with that reference."""
        return (_METHODS[0], reference) in self._sums

    def rows(self) -> list[dict[str, Any]]:
        """One row a filter: ``psnr_vs_R_db``, ``mse_vs_R_dn2``, ``snr_vs_R_db`` for each reference R.

        None where no frame came with that reference.
        """
        out = []
        for method in _METHODS:
            row: dict[str, Any] = {"filter": method}
            for name in REFERENCES:
                sums = self._sums.get((method, name))
                row[f"psnr_vs_{name}_db"] = sums and sums.psnr_db(self.peak_dn)
                row[f"mse_vs_{name}_dn2"] = sums and sums.mse_dn2
                row[f"snr_vs_{name}_db"] = sums and sums.snr_db()
            out.append(row)
        return out
