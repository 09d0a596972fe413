"""CDR against an encoder of its own, against real recordings, and against bytes that are none."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from turnscan.ingest.messages.cdr import CdrDecoder
from turnscan.ingest.messages.definitions import parse_definitions, standard_definitions
from turnscan.schemas.errors import InputError
from turnscan.store.log_walk import read_messages

from .cdr_writer import LETTERS, TEXTS, full_text, image, write

WHOLE = {
    "int8": (-(2**7), 2**7 - 1),
    "uint8": (0, 255),
    "byte": (0, 255),
    "char": (0, 255),
    "int16": (-(2**15), 2**15 - 1),
    "uint16": (0, 2**16 - 1),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
    "int64": (-(2**63), 2**63 - 1),
    "uint64": (0, 2**64 - 1),
}
words = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=8)


def value_of(kind: str) -> st.SearchStrategy[Any]:
    if kind == "bool":
        return st.booleans()
    if kind == "string":
        return words
    if kind in WHOLE:
        return st.integers(*WHOLE[kind])
    return st.floats(allow_nan=False, width=32 if kind == "float32" else 64)


@st.composite
def messages(draw: st.DrawFn, depth: int = 0) -> tuple[dict[str, str], list[tuple[str, Any]], Any]:
    """Definitions by name (the first is the message), fields to write, and the expected tree."""
    name = f"pkg/M{depth}"
    texts: dict[str, str] = {name: ""}
    fields: list[tuple[str, Any]] = []
    tree: dict[str, Any] = {}
    lines = []
    for i in range(draw(st.integers(1, 5))):
        kinds = [*LETTERS, "string"] + (["struct"] if depth < 2 else [])
        kind = draw(st.sampled_from(kinds))
        shape = draw(st.sampled_from(["", "[]", "[3]"]))
        count = 1 if not shape else 3 if shape == "[3]" else draw(st.integers(0, 4))
        said = kind
        if kind == "struct":
            # One definition for all elements: the same draw is repeated.
            inner_texts, inner_fields, inner_tree = draw(messages(depth=depth + 1))
            said = f"pkg/F{depth}x{i}"
            inner = dict(inner_texts)
            texts[said] = inner.pop(f"pkg/M{depth + 1}")
            texts |= {k: v for k, v in inner.items() if k not in texts}
            # Names of deeper messages must not clash between siblings.
            rename = {k: f"{k}of{depth}x{i}" for k in inner}
            for old, new in rename.items():
                texts[new] = texts.pop(old)
            for key in [said, *rename.values()]:
                for old, new in rename.items():
                    texts[key] = re.sub(rf"{old}\b", new, texts[key])
            written, expected = [inner_fields] * count, [inner_tree] * count
        else:
            written = expected = [draw(value_of(kind)) for _ in range(count)]
        lines.append(f"{said}{shape} f{i}")
        if shape:
            fields.append((f"{kind}{shape}", written))
            tree[f"f{i}"] = list(expected)
        else:
            fields.append((kind, written[0]))
            tree[f"f{i}"] = expected[0]
    texts[name] = "\n".join(lines)
    return texts, fields, tree


def plain(tree: Any) -> Any:
    """Views and tuples as lists, so that trees can be compared."""
    if isinstance(tree, dict):
        return {k: plain(v) for k, v in tree.items()}
    if isinstance(tree, (list, tuple, memoryview)):
        return [plain(v) for v in tree]
    return tree


@given(messages(), st.sampled_from("<>"))
def test_whatever_is_written_is_read(
    message: tuple[dict[str, str], list[tuple[str, Any]], Any], order: str
) -> None:
    texts, fields, tree = message
    first = next(iter(texts))
    text = texts[first] + "".join(
        f"\n{'=' * 80}\nMSG: {n}\n{t}" for n, t in texts.items() if n != first
    )
    decoder = CdrDecoder(parse_definitions(first, text))
    assert plain(decoder.decode(memoryview(write(fields, order)))) == tree


@given(st.data())
def test_no_bytes_crash_the_decoder(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(TEXTS)))
    decoder = CdrDecoder(parse_definitions(name, full_text(name)))
    body = data.draw(st.binary(max_size=80))
    head = data.draw(st.sampled_from([b"\0\1\0\0", b"\0\0\0\0", b"", b"\0\x07\0\0"]))
    try:
        decoder.decode(memoryview(head + body))
    except InputError as error:
        assert "message" in str(error)


@pytest.mark.parametrize("name", sorted(TEXTS))
def test_standard_messages_are_what_recorders_write(name: str) -> None:
    known = standard_definitions(name)
    if name != "std_msgs/msg/String":
        assert known == parse_definitions(name, full_text(name))


def test_the_exact_bytes_of_a_message() -> None:
    """By hand: alignment counts from behind the head of four bytes."""
    data = bytes.fromhex("00010000 05000000 06000000 02000000 4100 0000 0300 0000 01000000 00000000")
    text = "int32 a\nuint32 b\nstring s\nuint16 c\nuint64 d\n"
    tree = CdrDecoder(parse_definitions("p/M", text)).decode(memoryview(data))
    assert tree["a"] == 5
    assert tree["b"] == 6
    assert tree["s"] == "A"
    assert tree["c"] == 0
    data = struct.pack("<4sB7xd", b"\0\1\0\0", 7, 2.5)
    tree = CdrDecoder(parse_definitions("p/M", "uint8 a\nfloat64 b")).decode(memoryview(data))
    assert tree == {"a": 7, "b": 2.5}


def test_pixels_are_a_view() -> None:
    message = memoryview(image(10**18, "mono8", bytes(range(12)), width=4, height=3, step=4))
    definitions = standard_definitions("sensor_msgs/msg/Image")
    assert definitions is not None
    tree = CdrDecoder(definitions).decode(message)
    assert tree["data"].obj is message.obj
    assert tree["header"]["stamp"] == {"sec": 10**9, "nanosec": 0}
    assert (tree["width"], tree["height"], tree["encoding"]) == (4, 3, "mono8")


@pytest.mark.parametrize(
    ("head", "what"),
    [("0002", "PL_CDR"), ("0007", "XCDR2"), ("000a", "unknown"), ("4d41", "unknown")],
)
def test_other_encapsulations_are_refused_by_name(head: str, what: str) -> None:
    decoder = CdrDecoder(parse_definitions("p/M", "bool a"))
    with pytest.raises(InputError, match=what):
        decoder.decode(memoryview(bytes.fromhex(head) + b"\0\0\1"))
    with pytest.raises(InputError, match="missing"):
        decoder.decode(memoryview(b""))


def test_a_definition_that_does_not_fit_is_an_error() -> None:
    decoder = CdrDecoder(parse_definitions("p/M", "float64 a"))
    with pytest.raises(InputError, match="8 bytes are expected, 2 are there"):
        decoder.decode(memoryview(b"\0\1\0\0\0\0"))
    with pytest.raises(InputError, match="12 bytes are left over"):
        decoder.decode(memoryview(b"\0\1\0\0" + bytes(20)))
    with pytest.raises(InputError, match="wstring"):
        CdrDecoder(parse_definitions("p/M", "wstring a")).decode(memoryview(b"\0\1\0\0" + bytes(8)))
    with pytest.raises(InputError, match="claims"):
        CdrDecoder(parse_definitions("p/M", "string[] a")).decode(
            memoryview(b"\0\1\0\0" + b"\xff\xff\xff\x7f")
        )
    with pytest.raises(InputError, match="defined nowhere"):
        parse_definitions("p/M", "Other a")
    with pytest.raises(InputError, match="is no field"):
        parse_definitions("p/M", "float64")
    with pytest.raises(InputError, match="holds itself"):
        parse_definitions("p/M", f"N a\n{'=' * 80}\nMSG: p/N\nM b")


def test_constants_defaults_bounds_and_comments_of_definitions() -> None:
    text = """
    # comment
    uint8 DEBUG=1
    string NAME = "a # b"
    string<=5 s "x"
    int32[<=3] few
    int32[2] two  # [3] no
    float64 x 1.5
    """
    (fields,) = parse_definitions("p/msg/M", text).values()
    assert [(f.name, f.type, f.is_array, f.count) for f in fields] == [
        ("s", "string", False, None),
        ("few", "int32", True, None),
        ("two", "int32", True, 2),
        ("x", "float64", False, None),
    ]


def test_every_message_of_the_real_recordings(test_data: Path) -> None:
    """Definitions and messages of other programs fit each other to the last byte."""
    folder = test_data / "mcap_recordings" / "rosbag2"
    counts = {"cdr_test_0.mcap": 7, "talker.mcap": 20, "wbag_0.mcap": 1246}
    for name, count in counts.items():
        decoders: dict[str, CdrDecoder] = {}
        seen = 0
        for schema, _channel, message in read_messages(folder / name):
            assert schema is not None
            if schema.name not in decoders:
                text = schema.data.decode()
                decoders[schema.name] = CdrDecoder(parse_definitions(schema.name, text))
            tree = decoders[schema.name].decode(message.data)
            seen += 1
            if schema.name == "std_msgs/msg/String":
                assert tree["data"].startswith("Hello, world!")
            if schema.name == "rcl_interfaces/msg/Log":
                assert tree["name"] == "minimal_publisher"
                assert tree["msg"].startswith("Publishing: 'Hello, world!")
        assert seen == count
    expected = {"bool_values", "string_values", "int64_values_default", "alignment_check"}
    assert expected <= set(_first(folder / "cdr_test_0.mcap", "/array_topic"))


def _first(path: Path, topic: str) -> dict[str, Any]:
    schema, _, message = next(read_messages(path, {topic}))
    assert schema is not None
    return CdrDecoder(parse_definitions(schema.name, schema.data.decode())).decode(message.data)
