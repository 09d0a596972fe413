"""``turnscan recipe``: the built-in recipes and what is in one."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..schemas.errors import StorageError
from .output import Format, FormatOption, JsonOption, chosen, emit

if TYPE_CHECKING:
    from ..schemas.recipe import Recipe

recipe_app = typer.Typer(
    no_args_is_help=True,
    help="Recipes: ordered stages with parameters.",
    epilog="Examples: turnscan recipe list; turnscan recipe show paper > mine.toml",
)


def load_recipe(word: str) -> Recipe:
    """The recipe that ``word`` names: a built-in name, or the path of a TOML file."""
    # Late, here and below: building the models takes longer than the rest of the start-up.
    from ..schemas.recipe import built_in_recipe, parse_recipe

    if not word.endswith(".toml"):
        return built_in_recipe(word)
    try:
        data = Path(word).read_bytes()
    except OSError as error:
        raise StorageError(
            f"cannot read the recipe {word}: {error.strerror}",
            hint="turnscan recipe show default > mine.toml makes one to start from",
        ) from error
    return parse_recipe(data, where=word)


def complete_recipe(incomplete: str) -> list[str]:
    """Names of built-in recipes and TOML files, for tab completion."""
    from ..schemas.recipe import BUILT_IN

    names = sorted(BUILT_IN) + sorted(p.name for p in Path().glob("*.toml"))
    return [n for n in names if n.startswith(incomplete)]


RecipeOption = Annotated[
    str | None,
    typer.Option(
        "--recipe",
        "-r",
        metavar="NAME|FILE",
        help="Built-in name or .toml file; else the archive's default.",
        autocompletion=complete_recipe,
    ),
]


def recipe_toml(recipe: Recipe) -> str:
    """``recipe`` as TOML text that ``parse_recipe`` reads back to the same recipe."""
    lines = [f"name = {_toml(recipe.name)}"]
    if recipe.note:
        lines.append(f"note = {_toml(recipe.note)}")
    for stage in recipe.stages:
        lines += ["", "[[stages]]"]
        lines += [f"{k} = {_toml(v)}" for k, v in stage.plain().items() if v != []]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # A TOML basic string escapes as JSON does, and DEL as well.
        import json

        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007F")
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{k} = {_toml(v)}" for k, v in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(value)


@recipe_app.command("list", epilog="Example: turnscan recipe list --json")
def list_recipes(style: FormatOption = Format.table, as_json: JsonOption = False) -> None:
    """List the built-in recipes."""
    from ..schemas.recipe import BUILT_IN

    rows = [{"name": r.name, "recipe": r.recipe_id(), "note": r.note} for r in BUILT_IN.values()]
    emit(rows, ["name", "recipe", "note"], chosen(style, as_json))


@recipe_app.command("show", epilog="Example: turnscan recipe show paper > mine.toml")
def show_recipe(
    recipe: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE", help="Built-in name or file.", autocompletion=complete_recipe
        ),
    ],
) -> None:
    """Write a recipe as TOML, with every parameter."""
    sys.stdout.write(recipe_toml(load_recipe(recipe)))
