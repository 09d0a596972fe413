"""The commands there are: what each says of itself in one line, and where it is. Loaded when it is run.

Loading all of them takes several times as long as one needs, and help and tab completion want none.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, MutableMapping
from dataclasses import dataclass
from typing import Any, Final

import typer
from typer.core import TyperCommand, TyperGroup


@dataclass(frozen=True)
class Entry:
    """A command: its line in the list, its module, its function or group there, its examples."""

    line: str
    module: str
    attribute: str
    epilog: str | None = None


#: In the order of the help page. A group has its examples in its own module.
ENTRIES: Final[dict[str, Entry]] = {
    "init": Entry("Make a new archive.", "starting", "init", "Example: turnscan init lab"),
    "demo": Entry(
        "Record a room with a simulated rig, process it, and show how exact it is.",
        "demo",
        "demo",
        "Example: turnscan demo room --overwrite",
    ),
    "record": Entry(
        "Record a scan. Lasers are off and the motor is released however it ends.",
        "recording",
        "record",
        "Example: turnscan record --rig rig.toml --label bust --step-deg 0.5",
    ),
    "rig": Entry("Rigs: turntable, lasers and camera, as a rig.toml describes them.", "rig", "rig_app"),
    "import": Entry("Old data becomes a scan.", "importing", "import_app"),
    "calibrate": Entry(
        "Estimate camera, laser planes and axis, each with covariance and acceptance limits.",
        "calibrate",
        "calibrate_app",
    ),
    "calibration": Entry("The archive's calibrations.", "calibrations", "calibration_app"),
    "process": Entry(
        "Derive what is missing: STRIPES from frames, POINTS from stripes.",
        "deriving",
        "process",
        "Example: turnscan process latest --recipe paper --dry-run",
    ),
    "status": Entry(
        "List the scans that are stale, each with the reason in one line.",
        "deriving",
        "status",
        "Example: turnscan status --check",
    ),
    "scan": Entry("The archive's scans.", "scans", "scan_app"),
    "recipe": Entry("Recipes: ordered stages with parameters.", "recipes", "recipe_app"),
    "query": Entry(
        "Run SQL over scans, calibrations, events, references, derivations, stripes, points.",
        "exporting",
        "query",
        "Example: turnscan query 'SELECT frame, count(*) FROM points GROUP BY frame' --format csv",
    ),
    "export": Entry(
        "Write points to a file, by its suffix.",
        "exporting",
        "export",
        "Example: turnscan export latest cloud.ply",
    ),
    "report": Entry("Reports about scans.", "reporting", "report_app"),
    "compare": Entry(
        "Compare two derivations of scans, point by point: B minus A.",
        "comparing",
        "compare",
        "Example: turnscan compare recorded current latest --picture shifts.png",
    ),
    "verify": Entry(
        "Check every digest, CRC, page checksum and manifest. Exit 1 and a list if anything is "
        "damaged.",
        "fixity",
        "verify",
        "Example: turnscan verify --json",
    ),
    "repair": Entry(
        "Salvage unfinished scans, move damaged tables to quarantine/, rebuild the catalogue.",
        "fixity",
        "repair",
        "Example: turnscan repair --dry-run",
    ),
}


class Commands(MutableMapping[str, Any]):
    """The commands by name, each loaded when it is first asked for."""

    def __init__(self) -> None:
        self._loaded: dict[str, Any] = {}

    def __getitem__(self, name: str) -> Any:
        if name not in self._loaded:
            self._loaded[name] = _load(name, ENTRIES[name])
        return self._loaded[name]

    def __setitem__(self, name: str, command: Any) -> None:
        self._loaded[name] = command

    def __delitem__(self, name: str) -> None:
        del self._loaded[name]

    def __iter__(self) -> Iterator[str]:
        return iter(ENTRIES)

    def __len__(self) -> int:
        return len(ENTRIES)


def _load(name: str, entry: Entry) -> Any:
    found = getattr(importlib.import_module(f".{entry.module}", __package__), entry.attribute)
    if isinstance(found, typer.Typer):
        group = typer.main.get_group(found)
        group.name = name
        return group
    single = typer.Typer(add_completion=False)
    single.command(name, epilog=entry.epilog)(found)
    return typer.main.get_command(single)


class LazyGroup(TyperGroup):
    """A group that lists its commands without loading them."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.commands = Commands()

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002
        """The names, in the order of the help page."""
        return list(self.commands)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002
        """What help and completion show of a command: its name and its line."""
        entry = ENTRIES.get(cmd_name)
        return TyperCommand(cmd_name, help=entry.line) if entry else None

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """The command itself, to be run."""
        name, command, rest = super().resolve_command(ctx, args)
        return name, None if command is None or name is None else self.commands[name], rest
