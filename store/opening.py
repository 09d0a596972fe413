"""Make the folders of a new archive, find one, and read its settings."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from ..schemas.document import check_version, parse_toml, validate
from ..schemas.errors import ConflictError, NotFoundError
from ..schemas.ids import new_ulid
from ..schemas.manifests import ARCHIVE_VERSION, ArchiveSettings
from . import layout
from .bytes import STAGING, LocalFolder, storage_error


def make_folder(root: Path, recipe: str) -> tuple[Path, ArchiveSettings]:
    """The empty archive ``root``, and its settings, which are written last."""
    try:
        if (root / layout.SETTINGS).exists():
            raise ConflictError(f"{root} is an archive already", hint=f"cd {root}")
        if root.exists() and (not root.is_dir() or any(root.iterdir())):
            raise ConflictError(
                f"{root} is not empty", hint="give a new folder, or empty this one first"
            )
        root.mkdir(parents=True, exist_ok=True)
        for name in (layout.SCANS, layout.CALIBRATIONS, layout.EVENTS, layout.DERIVED, STAGING):
            (root / name).mkdir(exist_ok=True)
    except OSError as error:
        raise storage_error(error, root) from error
    settings = ArchiveSettings(archive=new_ulid(), created_ns=time.time_ns(), recipe=recipe)
    text = "".join(f"{k} = {_toml(v)}\n" for k, v in settings.plain().items())
    LocalFolder(root).put_if_absent(layout.SETTINGS, text.encode())
    return root, settings


def read_settings(root: Path) -> ArchiveSettings:
    """turnscan.toml of the archive ``root``; refuses archives of a newer format version."""
    path = root / layout.SETTINGS
    try:
        data = path.read_bytes()
    except (FileNotFoundError, NotADirectoryError) as error:
        raise NotFoundError(
            f"{root} is no archive (it has no {layout.SETTINGS})",
            hint=f"turnscan init {root} makes one",
        ) from error
    except OSError as error:
        raise storage_error(error, path) from error
    value = parse_toml(data, where=str(path))
    check_version(value, name="turnscan.archive", version=ARCHIVE_VERSION, where=str(path))
    return validate(ArchiveSettings, value, where=str(path))


def nearest_archive(start: Path) -> Path:
    """The folder of the archive in ``start`` or above it."""
    for folder in (start, *start.parents):
        if (folder / layout.SETTINGS).is_file():
            return folder
    raise NotFoundError(
        f"no archive in {start} or above",
        hint="turnscan init DIR makes one; --archive DIR or TURNSCAN_ARCHIVE names one",
    )


def _toml(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value)
