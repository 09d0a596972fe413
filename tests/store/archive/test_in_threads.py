"""Frames extracted in the threads that decompress them: bytes and errors of one thread alone."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from turnscan.process import finding
from turnscan.process.finding import StripeFinder
from turnscan.process.pipeline import Outcome, derive
from turnscan.schemas.events import Exposure, ScanEnd, ScanStart, TurntableAngle
from turnscan.schemas.recipe import BUILT_IN, Extract, Grey, Recipe, Triangulate
from turnscan.store import Archive
from turnscan.store.log_writer import LogWriter

from .scans import calibration

FRAMES = 24
OFF_FRAME = Recipe(
    name="off-frame",
    stages=(Grey(), Extract(background="off-frame"), Triangulate()),
)


def frame(n: int, *, width: int = 64, lit: bool = True) -> np.ndarray:
    x, row = np.arange(width), np.arange(48)[:, None]
    image = 12 + 180 * lit * np.exp(-((x - 20 - n - 0.05 * row) ** 2) / 4.5)
    image = image + np.random.default_rng(n).normal(0, 2, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def scan(archive: Archive, *, encoding: str = "", dark: bool = False, wrong: int = -1) -> None:
    """A scan in chunks of about a frame each; frame ``wrong`` cannot be decoded."""
    with archive.new_scan() as draft:
        with LogWriter(draft.part, chunk_bytes=5000) as writer:
            writer.write_event(
                ScanStart(
                    t_ns=5, scan=draft.scan, rig="r1", source="test", time_source="clock", software="t"
                )
            )
            writer.write_calibration(calibration(), 5)
            for n in range(FRAMES):
                writer.write_event(TurntableAngle(t_ns=10 * n + 10, commanded_rad=n / 9))
                for lit in (True, False) if dark else (True,):
                    exposure = Exposure(
                        t_ns=10 * n + (14 if lit else 16),
                        frame=2 * n + (not lit) if dark else n,
                        lasers_on=(0,) if lit else (),
                    )
                    image = frame(n, lit=lit)
                    if encoding:
                        data = cv2.imencode(f".{encoding}", image)[1].tobytes()
                        data = data[:40] if n == wrong else data
                        writer.write_image(exposure, data=data, encoding=encoding)
                    else:
                        writer.write_image(exposure, image)
            writer.write_event(
                ScanEnd(t_ns=10**6, ended="complete", frames=FRAMES * (2 if dark else 1))
            )
        archive.seal(draft, draft.examine())


def derived(archive: Archive, recipe: Recipe, *, overlap: bool) -> tuple[Outcome, dict[str, bytes]]:
    for path in (archive.root / "derived").rglob("k-*"):
        path.unlink()
    archive.rebuild_catalog()
    (outcome,) = derive(archive, archive.scans(), recipe, overlap=overlap)
    return outcome, {m.kind: (archive.root / m.path).read_bytes() for m in archive.derivations()}


@pytest.fixture
def helpers(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Names of the threads that find stripes; every frame is worth one."""
    monkeypatch.setattr(finding, "_WORTH_S", -1.0)
    seen: set[str] = set()
    find = StripeFinder.find

    def watched(self: StripeFinder, *args: object) -> finding.Found:
        # Whoever is at it leaves the next one to others.
        time.sleep(0.002)
        seen.add(threading.current_thread().name.split("_")[0])
        return find(self, *args)  # type: ignore[arg-type]

    monkeypatch.setattr(StripeFinder, "find", watched)
    return seen


@pytest.mark.parametrize("encoding", ["", "png"])
@pytest.mark.parametrize("recipe", ["default", "paper"])
def test_the_tables_are_the_same(tmp_path: Path, helpers: set[str], recipe: str, encoding: str) -> None:
    archive = Archive.init(tmp_path / "lab")
    scan(archive, encoding=encoding)
    alone, tables = derived(archive, BUILT_IN[recipe], overlap=False)
    assert alone.error is None
    assert alone.points > 40 * FRAMES
    assert helpers == {"MainThread"}
    together, same = derived(archive, BUILT_IN[recipe], overlap=True)
    assert together.error is None
    assert same == tables
    assert "decompress" in helpers


def test_encoded_frames_are_worth_a_thread(tmp_path: Path, helpers: set[str], monkeypatch) -> None:
    monkeypatch.setattr(finding, "_WORTH_S", 1e9)
    archive = Archive.init(tmp_path / "lab")
    scan(archive, encoding="png")
    assert derived(archive, BUILT_IN["default"], overlap=True)[0].error is None
    assert "decompress" in helpers


def test_frames_that_need_their_dark_frame_are_paired_first(tmp_path: Path, helpers: set[str]) -> None:
    archive = Archive.init(tmp_path / "lab")
    scan(archive, dark=True)
    alone, tables = derived(archive, OFF_FRAME, overlap=False)
    assert alone.error is None
    assert alone.points > 40 * FRAMES
    together, same = derived(archive, OFF_FRAME, overlap=True)
    assert together.error is None
    assert same == tables
    assert helpers == {"MainThread"}


def test_what_is_wrong_with_a_frame_is_told_as_without_threads(
    tmp_path: Path, helpers: set[str]
) -> None:
    archive = Archive.init(tmp_path / "lab")
    scan(archive, encoding="png", wrong=17)
    told = []
    for overlap in (False, True):
        outcome, tables = derived(archive, BUILT_IN["default"], overlap=overlap)
        assert tables == {}
        told.append(str(outcome.error))
    assert "frame 17: the image cannot be decoded" in told[0]
    assert told[0] == told[1]
    assert "decompress" in helpers
