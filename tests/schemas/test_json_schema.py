"""The committed JSON Schemas are what the models say, and real documents hold to them."""

from __future__ import annotations

import json
from pathlib import Path

import jsonschema

from turnscan.schemas.json_schema import json_schemas
from turnscan.schemas.recipe import BUILT_IN

FOLDER = Path(__file__).resolve().parents[2] / "schemas" / "json"


def test_committed_schemas_are_up_to_date() -> None:
    present = json_schemas()
    committed = {p.name.removesuffix(".schema.json") for p in FOLDER.glob("*.schema.json")}
    assert committed == set(present), "run `make docs` and commit schemas/json"
    for name, schema in present.items():
        text = (FOLDER / f"{name}.schema.json").read_text()
        assert json.loads(text) == schema, f"{name}: run `make docs` and commit schemas/json"


def test_schemas_are_valid_and_accept_built_in_recipes() -> None:
    schemas = json_schemas()
    for schema in schemas.values():
        jsonschema.Draft202012Validator.check_schema(schema)
    for recipe in BUILT_IN.values():
        jsonschema.validate(recipe.plain(), schemas["recipe"])
