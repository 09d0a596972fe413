"""What every command shares: help, output formats, colours, logs, exits, finding the archive."""

from __future__ import annotations

import csv
import io
import json
import os
import pty
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from console import Console, Inside, every_file, surroundings, write_frames, write_json

from turnscan.cli.commands import ENTRIES
from turnscan.cli.main import app
from turnscan.cli.recipes import recipe_toml
from turnscan.schemas.recipe import BUILT_IN, Extract, Grey, Recipe, Window, parse_recipe


@pytest.fixture
def lab(tiny_lab: Path, tmp_path: Path) -> Inside:
    """A copy of the tiny archive."""
    shutil.copytree(tiny_lab, tmp_path / "lab")
    return Inside(tmp_path, tmp_path / "lab")


# -- help and start-up ------------------------------------------------------------------------------


def every_command(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield path, command
    for name, sub in getattr(command, "commands", {}).items():
        yield from every_command(sub, (*path, name))


COMMANDS = dict(every_command(typer.main.get_command(app)))


@pytest.mark.parametrize("path", COMMANDS, ids=" ".join)
def test_every_command_has_help_and_an_example_that_parses(path: tuple[str, ...]) -> None:
    command = COMMANDS[path]
    assert (command.help or "").strip()
    assert "Example" in (command.epilog or ""), path
    examples = command.epilog.split(": ", 1)[1].split("; ")
    runs = [e for e in examples if e.startswith("turnscan ")]
    assert runs, command.epilog
    # The words lead to this command (for a group: to one below it).
    assert any(tuple(e.split()[1 : 1 + len(path)]) == path for e in runs), command.epilog
    for option in command.params:
        assert option.param_type_name == "argument" or option.help, (path, option.name)


def test_all_promised_commands_are_there() -> None:
    assert {
        *[("init",), ("demo",), ("import", "images"), ("process",), ("status",), ("query",)],
        *[("export",), ("verify",), ("repair",), ("recipe", "list"), ("recipe", "show")],
        *[("calibration", n) for n in ("add", "list", "show", "certify", "withdraw", "diff")],
        *[("scan", n) for n in ("list", "show", "tag", "retire")],
    } <= set(COMMANDS)


def cpu_seconds(command: list[str], cwd: Path) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, check=True, capture_output=True, cwd=cwd, env=surroundings())
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def test_help_starts_fast(console: Console) -> None:
    rounds = [
        (
            cpu_seconds(console.command("--help"), console.cwd),
            cpu_seconds([sys.executable, "-c", "import typer"], console.cwd),
        )
        for _ in range(3)
    ]
    ours, typers = (min(r[i] for r in rounds) for i in (0, 1))
    print(f"turnscan --help / import typer: {ours / typers:.2f} ({ours:.3f} s CPU), target 4")
    assert ours / typers < 6


def test_the_list_of_commands_loads_none_of_them() -> None:
    code = """
import atexit, os, sys
from turnscan.cli.main import main
loaded = lambda: [m for m in sys.modules if m in ("pydantic", "numpy", "turnscan.cli.scans")]
atexit.register(lambda: os._exit(len(loaded())))
main(["--help"])
"""
    subprocess.run([sys.executable, "-c", code], check=True, cwd="/", stdout=subprocess.DEVNULL)


@pytest.mark.parametrize("name", ENTRIES)
def test_the_list_says_what_the_command_says(name: str) -> None:
    assert COMMANDS[(name,)].help.split("\n\n")[0].replace("\n", " ") == ENTRIES[name].line
    assert COMMANDS[(name,)].name == name


def test_no_words_is_help_and_usage(console: Console) -> None:
    done = console.run()
    assert done.returncode == 2
    assert "Usage: turnscan" in done.stdout + done.stderr
    version = console("--version")
    assert version.stdout.startswith("turnscan ")
    assert version.stderr == ""


# -- recipes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "recipe",
    [
        *BUILT_IN.values(),
        Recipe(
            name="all.of-it",
            note='quotes " and \\ and\ttabs, \u00fcml\u00e4ute, a line\nend and \x7f',
            stages=(
                Grey(mode="weights", weights=(0.1, 1 / 3, 1e-17)),
                Extract(
                    method="argmax",
                    orientation="horizontal",
                    base_dn=1e22,
                    background="off-frame",
                    saturation_dn=65535.0,
                    windows=(Window(laser=0, from_px=0, to_px=9), Window(laser=1, from_px=9, to_px=20)),
                ),
                BUILT_IN["default"].stages[-1],
            ),
        ),
    ],
    ids=lambda r: r.name,
)
def test_a_recipe_survives_toml(recipe: Recipe) -> None:
    text = recipe_toml(recipe)
    again = parse_recipe(text.encode(), where="text")
    assert again == recipe
    assert again.recipe_id() == recipe.recipe_id()
    assert recipe_toml(again) == text


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_parameter_survives_toml(name: str) -> None:
    """Change one field of one stage at a time; the id changes with each, and comes back with each."""
    base = BUILT_IN[name]
    seen = {base.recipe_id()}
    for at, stage in enumerate(base.stages):
        for field in type(stage).model_fields:
            for value in (1.25, 3, 5, "off-frame", "horizontal", "argmax", "green", "none", "gaussian"):
                try:
                    changed = type(stage).model_validate({**stage.plain(), field: value})
                except ValueError:
                    continue
                stages = (*base.stages[:at], changed, *base.stages[at + 1 :])
                recipe = Recipe(name="mine", stages=stages)
                again = parse_recipe(recipe_toml(recipe).encode(), where="text")
                assert again == recipe
                if changed != stage:
                    seen.add(again.recipe_id())
    assert len(seen) > 12


def test_a_shown_recipe_is_the_same_recipe(lab: Inside) -> None:
    (lab.cwd / "mine.toml").write_text(lab("recipe", "show", "default").stdout)
    (did,) = lab.json("process", "--recipe", "mine.toml")
    assert did["did"] == "nothing"
    text = (lab.cwd / "mine.toml").read_text().replace("base_dn = 30.0", "base_dn = 25.0")
    assert "base_dn = 25.0" in text
    (lab.cwd / "mine.toml").write_text(text)
    (did,) = lab.json("process", "--recipe", "mine.toml")
    assert did["did"] == "derived stripes and points"


# -- output -----------------------------------------------------------------------------------------


def test_one_set_of_rows_in_three_formats(tiny_lab: Path, tmp_path: Path) -> None:
    lab = Inside(tmp_path, tiny_lab)
    rows = lab.json("scan", "list")
    assert json.loads(lab("scan", "list", "--format", "json").stdout) == rows
    (line,) = csv.DictReader(io.StringIO(lab("scan", "list", "--format", "csv").stdout))
    assert line["scan"] == rows[0]["scan"]
    assert json.loads(line["tags"]) == rows[0]["tags"] == {"owner": "lab2"}
    header, only = lab("scan", "list").stdout.splitlines()
    assert header.split()[:3] == ["scan", "label", "rig"]
    assert only.split()[:3] == [rows[0]["scan"], "first", "r1"]
    assert list(line) == header.split() == list(rows[0])


def test_json_is_json_even_where_a_value_is_unknown(tiny_lab: Path, tmp_path: Path) -> None:
    def refuse(token: str) -> None:
        raise AssertionError(f"{token} is no JSON")

    done = Inside(tmp_path, tiny_lab)(
        "query", "SELECT sigma_range_mm, CAST('NaN' AS FLOAT) AS nan FROM points LIMIT 2", "--json"
    )
    rows = json.loads(done.stdout, parse_constant=refuse)
    assert [r["nan"] for r in rows] == [None, None]


def in_terminal(console: Console, *words: object, env: dict[str, str] | None = None) -> str:
    """What a command shows on a terminal, a real pseudo-terminal."""
    ours, theirs = pty.openpty()
    with subprocess.Popen(
        console.command(*words),
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        cwd=console.cwd,
        env=surroundings({"TERM": "xterm-256color", **(env or {})}),
    ):
        os.close(theirs)
        shown = b""
        while True:
            try:
                part = os.read(ours, 65536)
            except OSError:  # Linux says EIO when the last process has closed its side.
                break
            if not part:
                break
            shown += part
    os.close(ours)
    return shown.decode()


def test_colours_on_a_terminal_alone_and_not_against_no_color(lab: Inside) -> None:
    assert "\033[1m" in in_terminal(lab, "scan", "list")
    assert "\033" not in in_terminal(lab, "scan", "list", env={"NO_COLOR": "1"})
    assert "\033[31merror:" in in_terminal(lab, "scan", "show", "nothing")


def test_quiet_verbose_log_file_and_debug(lab: Inside) -> None:
    assert lab("-q", "status").stderr == ""
    assert lab("status").stderr == "1 scan up to date\n"
    done = lab("-q", "--log-file", "log.txt", "process", "--recipe", "paper")
    assert done.stderr == ""
    log = (lab.cwd / "log.txt").read_text()
    assert "processing: 3 of 3" in log
    assert all(line[:2] == "20" and "Z " in line for line in log.splitlines())
    plain = lab.fails("scan", "show", "nothing")
    loud = lab.run("--debug", "--log-file", "log.txt", "scan", "show", "nothing")
    assert loud.returncode == 1
    assert "Traceback" in loud.stderr
    assert loud.stderr.endswith(plain)
    assert "NotFoundError" in (lab.cwd / "log.txt").read_text()
    lab.fails("--log-file", "no/folder/log.txt", "status")


@pytest.mark.parametrize("style", ["json", "csv", "table"])
def test_a_reader_that_goes_away_is_no_error(tiny_lab: Path, tmp_path: Path, style: str) -> None:
    console = Console(tmp_path, tiny_lab)
    sql = "SELECT a.x_mm, b.y_mm FROM points a CROSS JOIN points b"
    command = console.command("query", sql, "--format", style)
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path, env=surroundings()
    ) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        assert running.stdout.readline()
        running.stdout.close()
        assert running.stderr.read() == b""
        assert running.wait(timeout=60) == 0


def test_a_reader_that_was_never_there_is_no_error(tiny_lab: Path, tmp_path: Path) -> None:
    ours, theirs = os.pipe()
    os.close(ours)
    done = subprocess.run(
        Console(tmp_path, tiny_lab).command("scan", "list"),
        stdout=theirs,
        stderr=subprocess.PIPE,
        env=surroundings(),
        check=False,
    )
    os.close(theirs)
    assert done.stderr == b""
    assert done.returncode == 0


# -- which archive ----------------------------------------------------------------------------------


def test_the_archive_is_named_or_found_upward(lab: Inside, monkeypatch: pytest.MonkeyPatch) -> None:
    assert lab.archive is not None
    deep = next((lab.archive / "scans").iterdir())
    bare = Inside(lab.cwd)
    bare("init", "other")
    assert len(bare.json("scan", "list", cwd=deep)) == 1
    monkeypatch.setenv("TURNSCAN_ARCHIVE", str(lab.cwd / "other"))
    assert bare.json("scan", "list", cwd=deep) == []
    assert len(lab.json("scan", "list")) == 1
    monkeypatch.setenv("TURNSCAN_ARCHIVE", str(deep))
    assert "is no archive" in bare.fails("scan", "list")


# -- interruption -----------------------------------------------------------------------------------


def test_an_interrupted_process_leaves_nothing_half_done(console: Console, tiny_files: Path) -> None:
    console("init", "lab")
    console.archive = archive = console.cwd / "lab"
    photos = write_frames(console.cwd / "photos", 1, size=(640, 480))
    data = (photos / "img0.png").read_bytes()
    # So many that it is not over before a busy machine has looked.
    for i in range(1, 320):
        (photos / f"img{i}.png").write_bytes(data)
    calibration = json.loads((tiny_files / "cal.json").read_text())
    calibration["camera"] |= {"width_px": 640, "height_px": 480}
    write_json(console.cwd / "cal.json", calibration)
    console("import", "images", "photos", "--step-deg", 1, "--calibration", "cal.json")
    before = every_file(archive / "scans")
    with subprocess.Popen(
        console.command("process", "--recipe", "paper"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=console.cwd,
        env=surroundings(),
    ) as running:
        deadline = time.monotonic() + 60
        while not list((archive / "staging").iterdir()):
            assert time.monotonic() < deadline
            assert running.poll() is None
            time.sleep(0.01)
        running.send_signal(signal.SIGINT)
        out, said = running.communicate(timeout=60)
    assert running.returncode == 130, said
    # Where this is the first to process, it says before that it compiles.
    assert said.splitlines()[-1] == "error: interrupted"
    assert "Traceback" not in said
    assert out == ""
    assert not [p for p in (archive / "derived").rglob("*") if p.is_file()]
    assert not list((archive / "staging").iterdir())
    assert every_file(archive / "scans") == before
    inside = Inside(console.cwd, archive)
    assert inside.json("verify") == []
    assert [r["table"] for r in inside.json("status")] == ["stripes and points"]
