"""``turnscan init``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .output import current_session


def init(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="A new or empty folder.")],
) -> None:
    """Make a new archive."""
    from ..store import Archive

    archive = Archive.init(folder)
    current_session().say(f"made archive {archive.settings.archive} in {archive.root}")
