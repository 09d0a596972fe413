"""docs/controllers.md is the protocol: its examples are parsed from the page and replayed."""

from __future__ import annotations

import re
import time
from collections import deque
from pathlib import Path

import pytest
import serial
from hypothesis import given
from hypothesis import strategies as st

from turnscan.ingest.devices.building import build_emulator
from turnscan.ingest.devices.clock import SystemClock
from turnscan.ingest.devices.controller import setup_of
from turnscan.ingest.devices.dialects.turnscan import TurnscanDialect
from turnscan.ingest.devices.dialects.turnscan_lines import RESET, Line, crc16, parse_line
from turnscan.schemas.errors import DeviceError
from turnscan.schemas.rig import LaserSettings, TurntableSettings

PAGE = (Path(__file__).resolve().parents[3] / "docs" / "controllers.md").read_text()
#: One conversation, in order: the lines of all examples.
EXCHANGE = [
    line
    for block in re.findall(r"```exchange\n(.*?)```", PAGE, re.DOTALL)
    for line in block.splitlines()
]
WORD = st.from_regex(r"[!-)+-~]{1,9}", fullmatch=True)
#: The rig that the page's numbers come from: 90 deg/s are 800 microsteps/s.
SETTINGS = TurntableSettings(
    driver="simulated",
    speed_deg_s=90,
    acceleration_deg_s2=450,
    watchdog_s=5,
    min_deg=-360,
    max_deg=720,
    timeout_s=0.3,
)


def test_the_page_has_examples_and_every_line_is_well_formed() -> None:
    assert len(EXCHANGE) > 40
    damaged = [t for t in EXCHANGE if t[0] in "<>!" and parse_line(t) is None]
    assert damaged == [t for t in EXCHANGE if "PONG" in t]
    words = {t.split("*")[0].split()[1] for t in EXCHANGE if t[0] == ">"}
    assert words >= {"HELLO", "SET", "MOTOR", "MOVE", "STAT", "LASER", "PING"}


def test_the_crcs_check_value_is_that_of_the_page() -> None:
    assert f"`{crc16('123456789'):04X}`" in PAGE


def test_the_emulator_answers_as_the_page_says() -> None:
    clock = SystemClock()
    emulator = build_emulator(SETTINGS, clock, time_scale=10)
    with emulator, serial.Serial(emulator.port, 115200, timeout=2, exclusive=True) as port:
        # The first READY was sent before anybody listened: a restart says it again.
        emulator._firmware.boot()
        for line in EXCHANGE:
            if line == "^":
                port.reset_input_buffer()
                port.write(RESET.encode())
            elif line == "...":
                until = time.monotonic() + 5
                while emulator.state().turning and time.monotonic() < until:
                    time.sleep(0.005)
            elif line[0] == ">":
                port.write(f"{line}\n".encode())
            else:
                assert port.readline().decode() == f"{line}\n"


class PageLink:
    """A link whose other end is the page: it takes the next request only, and gives its reply."""

    port, baud, timeout_s, is_open = "page", 115200, 0.05, True

    def __init__(self) -> None:
        self.clock = SystemClock()
        self.script = deque(t for t in EXCHANGE if "cause=power" not in t)
        self.replies: deque[str] = deque()

    def send(self, text: str, *, end: str = "\n") -> int:
        while self.script and self.script[0] == "...":
            self.script.popleft()
        wanted = self.script.popleft()
        assert ("^" if text == RESET else text) == wanted
        while self.script and self.script[0][0] in "<!":
            self.replies.append(self.script.popleft())
        return self.clock.now_ns()

    def read_line(self, until_s: float) -> str | None:
        return self.replies.popleft() if self.replies else None


def test_the_driver_speaks_as_the_page_says() -> None:
    link = PageLink()
    dialect = TurnscanDialect(link, setup_of(SETTINGS, [LaserSettings(number=0, output=1)]))  # type: ignore[arg-type]
    assert dialect.wake().facts["encoder"] == "1"
    assert dialect.sees_missed_steps
    dialect.start(180, 90)
    refused = 0
    while link.script:
        line = next(t for t in link.script if t != "...")
        if "PONG" in line:  # damage happens on the wire, no driver sends it
            while link.script[0][0] != ">" or "PONG" in link.script[0]:
                link.script.popleft()
            dialect._number += 1
            continue
        if line == "^":
            dialect._reset()
            continue
        request = parse_line(line)
        assert request is not None
        if dialect._number == request.number:  # the page repeats it: so would the driver
            dialect._number -= 1
        try:
            reply = dialect._request(*request.words)
        except DeviceError as error:
            assert "refused" in str(error)
            refused += 1
        else:
            assert reply.words[0] == "OK"
            assert reply.number == request.number
    assert refused == 6


@given(st.integers(0, 0xFFFF), st.lists(WORD, min_size=1, max_size=8))
def test_lines_survive_the_way_and_back(number: int, words: list[str]) -> None:
    line = Line(">", number, tuple(words))
    assert parse_line(line.text()) == line


@given(st.data())
def test_one_damaged_character_never_passes(data: st.DataObject) -> None:
    text = data.draw(st.sampled_from([t for t in EXCHANGE if t[0] in "<>!" and "PONG" not in t]))
    at = data.draw(st.integers(0, len(text) - 1))
    other = data.draw(
        st.characters(min_codepoint=32, max_codepoint=126).filter(lambda c: c != text[at])
    )
    damaged = text[:at] + other + text[at + 1 :]
    # A CRC finds every single error; the mark "<" for ">" is one, too.
    assert parse_line(damaged) is None


@pytest.mark.parametrize(
    "request_words",
    [
        "MOVE",
        "MOVE x",
        "MOVE 1 2 3",
        "MOVE 99999999999",
        "MOVE 1 0",
        "LASER 1 maybe",
        "LASER 0 on",
        "SET speed=0",
        "SET speed=",
        "SET x=1",
        "MOTOR",
        "MOTOR dim",
        "MOVE \N{ARABIC-INDIC DIGIT THREE}",
    ],
)
def test_the_emulator_refuses_nonsense_and_lives(request_words: str) -> None:
    with (
        build_emulator(SETTINGS, SystemClock()) as emulator,
        serial.Serial(emulator.port, 115200, timeout=2) as port,
    ):
        time.sleep(0.02)
        port.reset_input_buffer()
        if request_words.isascii():
            line = Line(">", 1, tuple(request_words.split())).text()
            port.write(f"{line}\n".encode())
            reply = parse_line(port.readline().decode().strip())
            assert reply is not None
            assert reply.words[0] == "NO"
        else:
            port.write(f">0001 {request_words}*0000\n".encode())
            assert b"NAK" in port.readline()
        port.write(f"{Line('>', 2, ('PING',)).text()}\n".encode())
        assert port.readline().startswith(b"<0002 OK")
