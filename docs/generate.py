"""Write what follows from the code: JSON Schemas and the command reference (``make docs``)."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from turnscan.schemas.json_schema import json_schemas
from turnscan.schemas.tables import FLAG_MEANINGS, TABLES

ROOT = Path(__file__).resolve().parents[1]


def write_json_schemas(folder: Path) -> None:
    """schemas/json/<name>.schema.json for every document and event."""
    for old in folder.glob("*.schema.json"):
        old.unlink()
    for name, schema in json_schemas().items():
        text = json.dumps(schema, indent=2, sort_keys=True, ensure_ascii=False)
        (folder / f"{name}.schema.json").write_text(text + "\n")


def columns_text() -> str:
    """The tables' columns as Markdown, from their one declaration."""
    lines = []
    for spec in TABLES.values():
        lines += [f"### {spec.name} (version {spec.version})", ""]
        lines += ["| column | type | unit | meaning |", "|---|---|---|---|"]
        lines += [f"| `{c.name}` | {c.type} | {c.unit} | {c.description} |" for c in spec.columns]
        lines.append("")
    lines += ["### Flags", "", "| bit | name | meaning |", "|---|---|---|"]
    lines += [f"| {f.value} | {f.name} | {text} |" for f, text in FLAG_MEANINGS.items()]
    return "\n".join(lines)


def with_columns(text: str) -> str:
    """``text`` of docs/format.md with the generated part replaced."""
    begin, end = "<!-- columns: written by docs/generate.py -->", "<!-- end of columns -->"
    head, rest = text.split(begin)
    _, tail = rest.split(end)
    return f"{head}{begin}\n\n{columns_text()}\n\n{end}{tail}"


def cli_text() -> str:
    """The command reference as Markdown, from the commands' own help."""
    lines = [
        "# Command reference",
        "",
        "Written by `make docs` from the commands themselves. Data goes to stdout, all else to stderr.",
        "Exit codes: 0 done, 1 failed, 2 usage, 130 interrupted.",
    ]
    for path, command in commands():
        lines += ["", f"## turnscan{''.join(f' {p}' for p in path)}", ""]
        lines += [" ".join(part.split()) + "\n" for part in _plain(command.help).split("\n\n")]
        rows = [parameter_row(p) for p in command.params if p.name != "help"]
        if rows:
            lines += ["| | |", "|---|---|", *rows]
        if command.epilog:
            lines += ["", *(f"    {e.strip()}" for e in examples(command.epilog))]
    return "\n".join(lines).replace("\n\n\n", "\n\n").rstrip() + "\n"


def _plain(text: str | None) -> str:
    """Help text without rich's markup."""
    return re.sub(r"\[/?(bold|dim|italic)\]", "", text or "")


def commands() -> list[tuple[tuple[str, ...], Any]]:
    """(words, command) of the whole tree, groups before their commands."""
    import typer

    from turnscan.cli.main import app

    out: list[tuple[tuple[str, ...], Any]] = []

    def walk(path: tuple[str, ...], command: Any) -> None:
        out.append((path, command))
        for name, inner in getattr(command, "commands", {}).items():
            walk((*path, name), inner)

    walk((), typer.main.get_command(app))
    return out


def examples(epilog: str) -> list[str]:
    """The examples of an epilog, one each."""
    return epilog.replace("Examples:", "").replace("Example:", "").split(";")


def parameter_row(parameter: Any) -> str:
    """One line of an options table."""
    if parameter.param_type_name == "argument":
        name = parameter.metavar or str(parameter.name).upper()
    else:
        name = ", ".join([*parameter.opts, *parameter.secondary_opts])
        if parameter.metavar:
            name += f" {parameter.metavar}"
    text = " ".join((getattr(parameter, "help", "") or "").split())
    escaped = name.replace("|", "\\|")
    return f"| `{escaped}` | {text} |"


if __name__ == "__main__":
    (ROOT / "docs" / "cli.md").write_text(cli_text())
    page = ROOT / "docs" / "format.md"
    page.write_text(with_columns(page.read_text()))
    write_json_schemas(ROOT / "schemas" / "json")
