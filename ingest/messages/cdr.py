"""Decode ROS 2 messages: XCDR version 1, plain, either byte order.

Format: OMG DDS-XTypes 1.3 (formal/2020-02-04), 7.4.1, and OMG CORBA 3.3 part 2, 9.3: an encapsulation
head of four bytes (RTPS 2.5, 10.2), then primitives aligned to their own size, counted from behind
that head; strings carry their length with the closing NUL; sequences their length. Nothing else of
CDR is found in ROS 2 messages, and what is (wide strings, parameter lists, XCDR 2) is refused by name.
"""

from __future__ import annotations

import struct
from typing import Any

from ...schemas.errors import InputError
from .definitions import PRIMITIVES, Definitions, Field

_HEADS = {b"\x00\x00": ">", b"\x00\x01": "<"}
_OTHERS = {2: "PL_CDR", 3: "PL_CDR", 6: "XCDR2", 7: "XCDR2", 8: "XCDR2", 9: "XCDR2"}


class CdrDecoder:
    """Decodes messages of one type; the first of ``definitions`` is that type."""

    def __init__(self, definitions: Definitions) -> None:
        self._definitions = definitions
        self._root = next(iter(definitions))

    def decode(self, message: memoryview) -> dict[str, Any]:
        """Fields by name. A sequence of bytes is a view into ``message``, others are lists or tuples.

        Raises
        ------
        InputError
            The bytes are no such message, or are in a form of CDR that ROS 2 does not use.
        """
        head = bytes(message[:2])
        order = _HEADS.get(head)
        if order is None or len(message) < 4:
            found = _OTHERS.get(head[1], "unknown") if len(head) == 2 and not head[0] else "unknown"
            raise InputError(
                f"message {self._root}: its encapsulation is {head.hex() or 'missing'} ({found}), "
                "expected plain CDR",
                hint="record it with an RMW that writes plain CDR, as ROS 2 does by default",
            )
        cursor = _Cursor(message[4:], order, self._root)
        out = self._message(cursor, self._root)
        if len(cursor.data) - cursor.at > 7:
            raise cursor.wrong(f"{len(cursor.data) - cursor.at} bytes are left over")
        return out

    def _message(self, cursor: _Cursor, name: str) -> dict[str, Any]:
        fields = self._definitions[name]
        if not fields:
            # The C++ mapping of an empty structure has one byte, which is on the wire as well.
            cursor.numbers("uint8", 1)
        return {f.name: self._field(cursor, f) for f in fields}

    def _field(self, cursor: _Cursor, field: Field) -> Any:
        if not field.is_array:
            return self._one(cursor, field.type)
        count = cursor.length() if field.count is None else field.count
        if field.type in ("uint8", "byte", "char"):
            return cursor.take(count)
        if field.type in PRIMITIVES:
            return cursor.numbers(field.type, count)
        if count > len(cursor.data):  # Each holds a byte at least.
            raise cursor.wrong(f"{field.name} claims {count} elements")
        return [self._one(cursor, field.type) for _ in range(count)]

    def _one(self, cursor: _Cursor, kind: str) -> Any:
        if kind in PRIMITIVES:
            return cursor.numbers(kind, 1)[0]
        if kind == "string":
            return cursor.text()
        if kind == "wstring":
            raise InputError(f"message {self._root} holds a wstring, which cannot be read")
        return self._message(cursor, kind)


class _Cursor:
    """A place in one message."""

    def __init__(self, data: memoryview, order: str, name: str) -> None:
        self.data = data
        self.order = order
        self.name = name
        self.at = 0

    def wrong(self, what: str) -> InputError:
        return InputError(
            f"message {self.name}, byte {self.at + 4}: {what}",
            hint="the definition in the file does not fit its messages",
        )

    def take(self, size: int) -> memoryview:
        if size > len(self.data) - self.at:
            raise self.wrong(f"{size} bytes are expected, {len(self.data) - self.at} are there")
        self.at += size
        return self.data[self.at - size : self.at]

    def numbers(self, kind: str, count: int) -> tuple[Any, ...]:
        letter, size = PRIMITIVES[kind]
        if count == 0:
            return ()  # An empty sequence aligns nothing.
        self.at += -self.at % size
        return struct.unpack(f"{self.order}{count}{letter}", self.take(count * size))

    def length(self) -> int:
        return int(self.numbers("uint32", 1)[0])

    def text(self) -> str:
        size = self.length()
        data = bytes(self.take(size))
        # Some writers give an empty string no NUL.
        if size and data[-1]:
            raise self.wrong("a string does not end with NUL")
        try:
            return data[:-1].decode()
        except UnicodeDecodeError as error:
            raise self.wrong("a string is no UTF-8") from error
