"""Write what follows from the code: JSON Schemas and the command reference (``make docs``)."""

from __future__ import annotations

import json
from pathlib import Path

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


if __name__ == "__main__":
    page = ROOT / "docs" / "format.md"
    page.write_text(with_columns(page.read_text()))
    write_json_schemas(ROOT / "schemas" / "json")
