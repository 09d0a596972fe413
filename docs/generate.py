"""Write what follows from the code: JSON Schemas and the command reference (``make docs``)."""

from __future__ import annotations

import json
from pathlib import Path

from turnscan.schemas.json_schema import json_schemas

ROOT = Path(__file__).resolve().parents[1]


def write_json_schemas(folder: Path) -> None:
    """schemas/json/<name>.schema.json for every document and event."""
    for old in folder.glob("*.schema.json"):
        old.unlink()
    for name, schema in json_schemas().items():
        text = json.dumps(schema, indent=2, sort_keys=True, ensure_ascii=False)
        (folder / f"{name}.schema.json").write_text(text + "\n")


if __name__ == "__main__":
    write_json_schemas(ROOT / "schemas" / "json")
