"""Files that are cut off or damaged."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType

from turnscan.ingest.mcap_import import McapPlan, import_mcap, read_content
from turnscan.schemas.errors import (
    DamageError,
    InputError,
    StorageError,
)
from turnscan.schemas.events import ScanEnd
from turnscan.store import Archive

from ..images import frames, pixels
from .importing import nothing_is_left, refused, ros_recording, run, said


@pytest.mark.parametrize("how", [{"chunk_bytes": 4000}, {"chunks": False}], ids=str)
def test_a_cut_file_gives_what_is_whole(lab: Archive, tmp_path: Path, how: dict[str, Any]) -> None:
    whole = ros_recording(tmp_path / "bag.mcap", 8, **how)
    data = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: len(data) * 6 // 10])
    items = run(lab, cut)
    kept = frames(items)
    assert 2 <= len(kept) <= 5
    for i, frame in enumerate(kept):
        assert np.array_equal(frame.decode(), pixels(i))
    end = items[-1]
    assert isinstance(end, ScanEnd)
    assert end.ended == "interrupted"
    assert "runs past the end" in end.note
    assert "the recording is cut off" in said(items)


def test_every_cut_gives_a_beginning_or_an_error(tmp_path: Path) -> None:
    data = ros_recording(tmp_path / "bag.mcap", 3, chunk_bytes=2000).read_bytes()
    cut = tmp_path / "cut.mcap"
    found = set()
    for size in range(0, len(data), 97):
        cut.write_bytes(data[:size])
        try:
            content = read_content(McapPlan(cut))
        except (InputError, DamageError) as error:
            assert str(cut) in str(error)
        else:
            assert content.survey.lost
            for i, frame in enumerate(content.images()):
                assert np.array_equal(frame.pixels, pixels(i))
            found.add(len(content.order))
    assert found == {1, 2, 3}


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_no_flipped_bit_changes_what_is_imported(tmp_path: Path, data: st.DataObject) -> None:
    good = tmp_path / "bag.mcap"
    if not good.exists():
        ros_recording(good, 3, chunk_bytes=4000)
    bits = bytearray(good.read_bytes())
    at = data.draw(st.integers(0, len(bits) * 8 - 1))
    bits[at // 8] ^= 1 << at % 8
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(bits)
    try:
        content = read_content(McapPlan(bad))
    except (DamageError, InputError) as error:
        assert str(bad) in str(error)
        return
    assert not content.survey.lost
    for i, frame in enumerate(content.images()):
        assert np.array_equal(frame.pixels, pixels(i))
    assert list(content.choice.angles.reported) == [math.radians(i) for i in range(3)]


def test_a_broken_chunk_is_an_error_and_no_loss(lab: Archive, tmp_path: Path) -> None:
    path = ros_recording(tmp_path / "bag.mcap", 4, compression=CompressionType.NONE)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    refused(path, "the CRC of a chunk does not fit", DamageError)
    assert nothing_is_left(lab)


def test_no_such_file_and_no_mcap(tmp_path: Path) -> None:
    refused(tmp_path / "none.mcap", "no such file", StorageError)
    (tmp_path / "a.txt").write_text("hello, this is no recording")
    refused(tmp_path / "a.txt", "does not begin as an MCAP file", DamageError)


def test_a_file_that_changes_in_between(lab: Archive, tmp_path: Path) -> None:
    path = ros_recording(tmp_path / "bag.mcap", 4)
    content = read_content(McapPlan(path))
    ros_recording(path, 2)
    with pytest.raises(InputError, match="changed while it was read"):
        import_mcap(lab, content)
    assert nothing_is_left(lab)
