"""The docs say what the code says: columns, topics, commands, decisions."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
FORMAT = (ROOT / "docs" / "format.md").read_text()


@pytest.fixture(scope="module")
def generate() -> ModuleType:
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_columns_in_the_docs_are_those_of_the_code(generate: ModuleType) -> None:
    assert generate.with_columns(FORMAT) == FORMAT, "run `make docs` and commit docs/format.md"


def test_every_channel_is_in_the_docs() -> None:
    from turnscan.schemas.channels import TOPICS

    for topic in TOPICS:
        shown = topic.replace("{camera}", "<id>").replace("{laser}", "<laser>")
        assert f"`{shown}`" in FORMAT, f"docs/format.md does not mention {shown}"


def test_links_of_the_docs_lead_somewhere() -> None:
    for page in [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]:
        for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target} does not exist"


def test_examples_in_the_format_page_are_real_documents() -> None:
    from turnscan.schemas.calibration import parse_calibration

    examples = re.findall(r"```json\n(.*?)```", FORMAT, re.DOTALL)
    assert len(examples) == 2
    for text in examples:
        assert parse_calibration(text, where="docs/format.md").lasers


def test_the_command_reference_is_up_to_date(generate: ModuleType) -> None:
    committed = (ROOT / "docs" / "cli.md").read_text()
    assert generate.cli_text() == committed, "run `make docs` and commit docs/cli.md"


def test_every_command_has_help_and_an_example(generate: ModuleType) -> None:
    for path, command in generate.commands():
        if not hasattr(command, "commands"):
            assert command.help, path
            assert command.epilog, f"turnscan {' '.join(path)} has no example"
            assert any(e.strip().startswith("turnscan") for e in generate.examples(command.epilog))


def test_versions_agree() -> None:
    import tomllib

    from turnscan import __version__

    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == __version__


def test_the_scene_in_the_format_page_is_a_real_document() -> None:
    from turnscan.ingest.room.built_in import desk_calibration
    from turnscan.ingest.room.rig import SimulatedRig
    from turnscan.schemas.scene import parse_scene_file

    (text,) = re.findall(r"```toml\n(.*?)```", FORMAT, re.DOTALL)
    scene = parse_scene_file(text.encode(), where="docs/format.md")
    assert SimulatedRig(desk_calibration(), lasers=[0], emitters=scene.lasers).fans[0].laser == 0
