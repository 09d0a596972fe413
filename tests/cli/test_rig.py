"""``turnscan rig``: new, check, ports."""

from __future__ import annotations

from pathlib import Path

import pytest
from console import Inside

from turnscan.schemas.rig import parse_rig


@pytest.fixture
def desk(tmp_path: Path) -> Inside:
    return Inside(tmp_path)


def write_rig(desk: Inside, *, dialect: str = "turnscan", more: str = "", **changes: str) -> Path:
    desk("rig", "new", "--driver", "simulated", "--dialect", dialect, "-o", "rig.toml")
    path = desk.cwd / "rig.toml"
    text = path.read_text()
    for line, new in changes.items():
        old = f"# {line} = "
        assert old in text
        text = text.replace(old, f"{line} = {new}  # ", 1)
    text = text.replace("# time_scale = 1.0", "time_scale = 20.0").replace(
        "# timeout_s = 2.0", "timeout_s = 0.5"
    )
    path.write_text(text + more)
    return path


def test_new_writes_a_rig_file_with_comments(desk: Inside) -> None:
    text = desk("rig", "new", "--dialect", "horus", "--name", "attic").stdout
    made = parse_rig(text.encode(), where="new")
    assert made.name == "attic"
    assert made.turntable.dialect == "horus"
    assert text.count("#") > 30


def test_new_replaces_nothing(desk: Inside) -> None:
    desk("rig", "new", "-o", "rig.toml")
    assert "exists" in desk.fails("rig", "new", "-o", "rig.toml")
    assert "cannot write" in desk.fails("rig", "new", "-o", "no/where.toml")
    assert "name" in desk.fails("rig", "new", "--name", "my rig")


@pytest.mark.parametrize("dialect", ["turnscan", "horus", "grbl"])
def test_a_rig_that_is_well(desk: Inside, dialect: str) -> None:
    write_rig(desk, dialect=dialect)
    rows = desk.json("rig", "check", "rig.toml")
    assert [r["check"] for r in rows] == [
        "controller",
        "motion",
        "camera",
        "frame",
        "laser 0",
        "everything off",
    ]
    assert {r["result"] for r in rows} == {"ok"}
    assert "640 x 480" in rows[3]["seen"]
    assert "rise" in rows[4]["seen"]
    assert "motion" not in [r["check"] for r in desk.json("rig", "check", "rig.toml", "--no-move")]


@pytest.mark.parametrize(
    ("fault", "check"),
    [
        ('kind = "stall"', "motion"),
        ('kind = "missed-steps"', "motion"),
        ('kind = "lost-reply"\non = "laser"\ncount = 1000', "laser 0"),
        ('kind = "lost-command"\ncount = 1000', "controller"),
        ('kind = "hang-up"\non = "status"', "motion"),
    ],
)
def test_a_rig_with_a_fault_says_which_and_what_to_try(desk: Inside, fault: str, check: str) -> None:
    write_rig(desk, more=f"\n[[simulated.faults]]\n{fault}\n")
    said = desk.fails("rig", "check", "rig.toml")
    assert "went wrong" in said
    assert f"{check}: " in said
    assert "try: " in said


def test_what_is_wrong_is_data_too(desk: Inside) -> None:
    write_rig(desk, more='\n[[simulated.faults]]\nkind = "stall"\n')
    done = desk.run("rig", "check", "rig.toml", "--json")
    assert done.returncode == 1
    assert '"result": "wrong"' in done.stdout


def test_a_rig_file_that_is_not_there_or_not_one(desk: Inside) -> None:
    assert "cannot read the rig file" in desk.fails("rig", "check", "no.toml")
    (desk.cwd / "bad.toml").write_text('format = "turnscan.rig"\nversion = 1\n')
    assert "bad.toml: name: Field required" in desk.fails("rig", "check", "bad.toml")


def test_a_rig_on_a_port_that_is_not_there(desk: Inside) -> None:
    desk("rig", "new", "-o", "rig.toml")
    path = desk.cwd / "rig.toml"
    path.write_text(path.read_text().replace("/dev/ttyUSB0", "/dev/ttyNOSUCH7"))
    said = desk.fails("rig", "check", "rig.toml")
    assert "no such port" in said


def test_ports(desk: Inside) -> None:
    for row in desk.json("rig", "ports"):
        assert row["port"].startswith("/dev/")
