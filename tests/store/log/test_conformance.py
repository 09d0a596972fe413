"""The published MCAP conformance files, and recordings of other programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mcap import records

from turnscan.schemas.errors import DamageError
from turnscan.store.log_records import LogMessage
from turnscan.store.log_walk import RecordWalk, read_messages

FIELDS_NOT_SHOWN = {records.MessageIndex}


def shown(value: Any) -> Any:
    """A field as the conformance files write it."""
    if isinstance(value, (bytes, memoryview)):
        return [str(b) for b in bytes(value)]
    if isinstance(value, dict):
        return {str(k): shown(v) for k, v in value.items()}
    if isinstance(value, int):
        return str(int(value))
    return value


def as_json(record: Any) -> dict[str, Any]:
    name = "Message" if isinstance(record, LogMessage) else type(record).__name__
    names = (
        LogMessage.__slots__ if isinstance(record, LogMessage) else record.__dataclass_fields__.keys()
    )
    return {"type": name, "fields": {k: shown(getattr(record, k)) for k in names}}


def test_every_conformance_file_gives_its_records(test_data: Path) -> None:
    files = sorted((test_data / "mcap_conformance").rglob("*.mcap"))
    assert len(files) >= 200
    for path in files:
        expected = [
            {"type": r["type"], "fields": dict(r["fields"])}
            for r in json.loads(path.with_suffix(".json").read_text())["records"]
        ]
        found = [as_json(r) for _, r in RecordWalk(path) if type(r) not in FIELDS_NOT_SHOWN]
        for a, b in zip(found, expected, strict=True):
            assert a["type"] == b["type"], path.name
            for key, value in b["fields"].items():
                if key != "crc":
                    assert a["fields"][key] == value, f"{path.name}: {a['type']}.{key}"


def test_flips_in_conformance_files_are_found_or_harmless(test_data: Path, tmp_path: Path) -> None:
    """With CRCs set, one flipped bit never gives other messages than were written."""
    path = next((test_data / "mcap_conformance").rglob("TenMessages-ch-chx-mx-pad-rch-rsh-st-sum.mcap"))
    whole = [bytes(m.data) for _, _, m in read_messages(path)]
    data = path.read_bytes()
    copy = tmp_path / "flip.mcap"
    for at in range(len(data)):
        broken = bytearray(data)
        broken[at] ^= 1 << (at % 8)
        copy.write_bytes(broken)
        try:
            assert [bytes(m.data) for _, _, m in read_messages(copy)] == whole
        except DamageError as error:
            assert "flip.mcap" in str(error)


@pytest.mark.parametrize(
    ("name", "messages", "topics"),
    [
        ("lichtblick/custom-camera-model.mcap", 30, 3),
        ("lichtblick/example.mcap", 111, 1),
        ("rosbag2/talker.mcap", 20, 2),
        ("rosbag2/wbag_0.mcap", 1246, None),
        ("rosbag2/cdr_test_0.mcap", 7, 2),
    ],
)
def test_recordings_of_other_programs_open(
    test_data: Path, name: str, messages: int, topics: int | None
) -> None:
    found = list(read_messages(test_data / "mcap_recordings" / name))
    assert len(found) == messages
    if topics is not None:
        assert len({c.topic for _, c, _ in found}) == topics
    only = found[0][1].topic
    assert all(
        c.topic == only for _, c, _ in read_messages(test_data / "mcap_recordings" / name, {only})
    )


def test_cut_recordings_are_reported(test_data: Path, tmp_path: Path) -> None:
    data = (test_data / "mcap_recordings" / "rosbag2" / "talker.mcap").read_bytes()
    for cut in range(0, len(data), max(1, len(data) // 60)):
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[:cut])
        with pytest.raises(DamageError, match=r"cut\.mcap: damaged at byte"):
            list(read_messages(path))
