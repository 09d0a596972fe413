"""Extraction on real photographs: saturated cores, a second stripe, red clutter, two lasers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from real import read_colour

from turnscan.process.stages import FrameChain
from turnscan.schemas.recipe import BUILT_IN, Denoise, Extract, Grey, Recipe, Triangulate, Window
from turnscan.schemas.tables import Flag


def chain(extract: Extract, mode: str) -> FrameChain:
    return FrameChain(
        Recipe(name="t", stages=(Grey(mode=mode), Denoise(), extract, Triangulate())), None
    )


def test_ciclop_object_with_background_frame(test_data: Path) -> None:
    """Published and measured centres of ciclop/DATA.md, to 0.6 px."""
    folder = test_data / "ciclop" / "segmentation"
    on, off = (read_colour(folder / f"object_laser_{w}.png") for w in ("on", "off"))
    step = Extract(method="centroid", background="off-frame")
    ((_, found),) = chain(step, "red").extract(on, (0,), off)
    centre = dict(zip(found["row"].tolist(), found["u_px"].tolist(), strict=True))
    published = {
        100: (555.2, 555.3),
        300: (576.1, 576.4),
        500: (557.2, 557.3),
        700: (552.6, 553.1),
        900: (558.5, 558.3),
        1050: (568.8, 568.7),
    }
    for row, values in published.items():
        assert min(abs(centre[row] - v) for v in values) < 0.6, row
    assert int(found["row"].min()) == pytest.approx(54, abs=3)
    assert int(found["row"].max()) == pytest.approx(1272, abs=3)
    assert len(found) == pytest.approx(1109, abs=15)


def test_ciclop_board_with_two_lasers_in_one_frame(test_data: Path) -> None:
    folder = test_data / "ciclop" / "segmentation"
    on, off = (read_colour(folder / f"board_two_lasers_{w}_x.png") for w in ("on", "off"))
    windows = (Window(laser=0, from_px=280, to_px=350), Window(laser=1, from_px=600, to_px=680))
    step = Extract(method="centroid", background="off-frame", base_dn=15, windows=windows)
    lines = {0: (-0.00375, 316.53, 0.36), 1: (-0.02649, 657.83, 0.32)}
    for laser, found in chain(step, "red").extract(on, (0, 1), off):
        rows = found[(found["row"] >= 480) & (found["row"] <= 840)]
        slope, start, rms = lines[laser]
        error = rows["u_px"] - (slope * rows["row"].astype(float) + start)
        assert len(rows) > 340
        assert np.median(np.abs(error)) < 0.6
        assert np.sqrt(np.median(error**2)) < 1.5 * rms


def test_etna_clipped_stripe_is_centred_by_its_flanks(test_data: Path) -> None:
    """Centres near the centroid of the saturated run, and flagged as saturated.

    The two need not agree: the flanks, which decide, are visibly lopsided in two of the frames.
    """
    frames = sorted((test_data / "etna").glob("*.png"))
    assert len(frames) == 8
    recipe = BUILT_IN["default"]
    for path in frames:
        image = read_colour(path)
        ((_, found),) = FrameChain(recipe, None).extract(image, (0,))
        grey = image if image.ndim == 2 else image[:, :, 1]
        off = []
        for point in found:
            lit = np.flatnonzero(grey[point["row"]] >= 250)
            lit = lit[np.abs(lit - point["u_px"]) < 25]
            if len(lit) > 3:
                off.append(point["u_px"] - lit.mean())
        assert len(found) > 850
        assert abs(float(np.median(off))) < 0.1
        assert np.percentile(np.abs(off), 99) < 0.85
        assert (found["flags"] & Flag.SATURATED).mean() > 0.8
