"""The port: what is wrong is said in one clear error, and lasers go off however a program ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import serial

from turnscan.ingest.devices.clock import SystemClock
from turnscan.ingest.devices.emulator.port import Emulator
from turnscan.ingest.devices.serial_link import SerialLink
from turnscan.schemas.errors import DeviceError

from .bench import DIALECTS, Bench, bench


def fails(it: Bench, *, port: str | None = None) -> DeviceError:
    if port is not None:
        it.controller._link.port = port
    with pytest.raises(DeviceError) as caught:
        it.controller.connect()
    assert caught.value.hint
    assert not it.controller._link.is_open
    return caught.value


def test_a_port_that_is_not_there() -> None:
    with bench("turnscan") as it:
        error = fails(it, port="/dev/ttyNOSUCH7")
        assert "/dev/ttyNOSUCH7: there is no such port; ports here:" in str(error)
        assert "rig ports" in (error.hint or "")


def test_a_file_and_a_folder_are_no_ports(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no port")
    for path in (tmp_path / "notes.txt", tmp_path):
        with bench("grbl") as it:
            assert "it is no serial port" in str(fails(it, port=str(path)))


@pytest.mark.skipif(os.geteuid() == 0, reason="root may open everything")
def test_a_port_without_permission(tmp_path: Path) -> None:
    (tmp_path / "tty").write_text("")
    (tmp_path / "tty").chmod(0)
    with bench("grbl") as it:
        assert "no permission" in str(fails(it, port=str(tmp_path / "tty")))


@pytest.mark.parametrize("dialect", DIALECTS)
def test_wrong_baud_is_recognised_by_its_garbage(dialect: str) -> None:
    with bench(dialect, baud=9600) as it:
        error = fails(it)
        assert "9600 baud: garbage instead of" in str(error)
        assert "baud" in (error.hint or "")


@pytest.mark.parametrize("wanted", DIALECTS)
@pytest.mark.parametrize("there", DIALECTS)
def test_other_firmware_than_said(wanted: str, there: str) -> None:
    if wanted == there:
        pytest.skip("that is the right one")
    with bench(there) as board, bench(wanted) as it:
        error = fails(it, port=board.emulator.port)
        assert "found other firmware" in str(error)
        assert f'dialect = "{there}"' in (error.hint or "")


@pytest.mark.parametrize(
    ("dialect", "banner"),
    [("horus", b"\r\nHorus 0.1 ['$' for help]\r\n"), ("grbl", b"\r\nGrbl 0.9j ['$' for help]\r\n")],
)
def test_another_version_of_the_firmware(
    dialect: str, banner: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    from turnscan.ingest.devices.emulator import grbl, horus

    module = horus if dialect == "horus" else grbl
    monkeypatch.setattr(module, "BANNER", banner.decode())
    with bench(dialect) as it:
        assert "found another version" in str(fails(it))


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_silent_port(dialect: str) -> None:
    master, slave = os.openpty()
    try:
        with bench(dialect) as it:
            began = time.monotonic()
            error = fails(it, port=os.ttyname(slave))
            assert "no answer" in str(error)
            assert time.monotonic() - began < 3 * it.settings.timeout_s
    finally:
        os.close(master)
        os.close(slave)


def test_a_port_that_talks_about_something_else() -> None:
    with bench("horus") as it:
        emulator: Emulator = it.emulator
        emulator._firmware.take_byte = lambda command: emulator.say(b"$GPGGA,123519,4807.038,N\r\n")  # type: ignore[method-assign]
        assert "GPGGA" in str(fails(it))


def test_an_output_that_the_board_has_not(monkeypatch: pytest.MonkeyPatch) -> None:
    from turnscan.ingest.devices.emulator import turnscan

    monkeypatch.setattr(turnscan, "LASERS", 1)
    with bench("turnscan", lasers=2) as it:
        assert "the board has 1 laser outputs" in str(fails(it))


def test_garbage_without_end_is_no_endless_line() -> None:
    with bench("turnscan") as it:
        it.controller.connect()
        it.emulator.say(b"\xfe" * 3000)
        time.sleep(0.05)
        it.controller.move_to(0.2)
        assert any("\\xFE" in text for _, _, text, _ in it.lines)


def test_opening_does_not_reset_boards_that_listen_to_dtr() -> None:
    """HUPCL is off: DTR stays up when the program ends, and the board keeps its position."""
    import termios

    with bench("grbl") as it:
        link = SerialLink(it.emulator.port, 115200, timeout_s=1, clock=SystemClock())
        link.open()
        link.close()
        with serial.Serial(it.emulator.port) as port:
            assert not termios.tcgetattr(port.fileno())[2] & termios.HUPCL


# -- ends of programs --------------------------------------------------------------------------------

PROGRAM = """
import sys, time
from turnscan.ingest.devices.building import build_controller
from turnscan.ingest.devices.clock import SystemClock
from turnscan.schemas.rig import LaserSettings, TurntableSettings

settings = TurntableSettings(driver="serial", dialect={dialect!r}, port={port!r}, timeout_s=1.0,
                             gear_ratio=4.0, min_deg=-100, max_deg=400)
controller = build_controller(settings, (LaserSettings(number=0, output=1),), SystemClock())
controller.connect()
controller.switch(0, on=True)
controller.start_move(5.0, 0.5)
print("lit", flush=True)
sys.stdin.readline()
{end}
"""


def ended(it: Bench, end: str, after: Callable[[subprocess.Popen[str]], None]) -> int:
    code = PROGRAM.format(dialect=it.settings.dialect, port=it.emulator.port, end=end)
    with subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        cwd="/",
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "lit\n"
        assert it.emulator.state().outputs_lit == {1}
        until = time.monotonic() + 5
        while not it.emulator.state().turning and time.monotonic() < until:
            time.sleep(0.01)
        assert it.emulator.state().turning
        after(process)
        return process.wait(timeout=20)


def go_on(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.write("\n")
    process.stdin.close()


def interrupt(process: subprocess.Popen[str]) -> None:
    process.send_signal(signal.SIGINT)


@pytest.mark.parametrize(
    ("end", "after"),
    [("pass", go_on), ("sys.exit(3)", go_on), ("raise RuntimeError", go_on), ("pass", interrupt)],
    ids=["ends", "exits", "raises", "ctrl-c"],
)
@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_program_that_forgets_to_close_leaves_nothing_on(
    dialect: str, end: str, after: Callable[[subprocess.Popen[str]], None]
) -> None:
    with bench(dialect, time_scale=1.0) as it:
        ended(it, end, after)
        state = it.emulator.state()
        assert not state.outputs_lit
        assert not state.motor_held
        assert not state.turning


def test_after_kill_9_the_watchdog_switches_off() -> None:
    with bench("turnscan", time_scale=1.0) as it:
        # The program's own rig file says 5 s: too long for a test, so the board is told otherwise.
        ended(it, "", lambda process: process.kill())
        assert it.emulator.state().outputs_lit == {1}
        it.emulator._firmware._watchdog_ms = 300
        time.sleep(0.5)
        assert not it.emulator.state().outputs_lit
