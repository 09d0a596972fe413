"""Find image files and put them in the order people mean: img2 before img10."""

from __future__ import annotations

import glob
import re
from collections.abc import Sequence
from pathlib import Path

from ..schemas.errors import InputError

#: Suffix -> the format's name in the log.
FORMATS = {
    ".jpg": "jpeg",
    ".jpeg": "jpeg",
    ".png": "png",
    ".bmp": "bmp",
    ".tif": "tiff",
    ".tiff": "tiff",
}
_DIGITS = re.compile(r"(\d+)")


def natural_key(path: Path) -> tuple[object, ...]:
    """Sorting key: digits count as numbers, letters without case, ties by the exact name."""
    parts = _DIGITS.split(path.name.casefold())
    # The split alternates: text, digits, text. (isdigit would also say yes to a superscript two.)
    mixed = tuple((int(p), "") if i % 2 else (-1, p) for i, p in enumerate(parts))
    return mixed, path.name, str(path.parent)


def is_image(path: Path) -> bool:
    """Whether the suffix is one that can be imported, and the file is not hidden."""
    return path.suffix.lower() in FORMATS and not path.name.startswith(".")


def _files_of(source: str | Path) -> list[Path]:
    path = Path(source)
    if path.is_dir():
        return [p for p in path.iterdir() if p.is_file()]
    if path.is_file():
        if not is_image(path):
            raise InputError(
                f"{path} is no image that can be imported", hint=f"known: {' '.join(FORMATS)}"
            )
        return [path]
    # glob, because a pattern that the shell left alone may hold folders and ** as well.
    found = [Path(p) for p in glob.glob(str(source), recursive=True) if Path(p).is_file()]
    if not found:
        raise InputError(f"{source}: no such file or folder, and no file fits it as a pattern")
    return found


def find_images(sources: Sequence[str | Path]) -> tuple[list[Path], list[Path]]:
    """Images of folders, globs and files in natural order, and what was skipped in folders and globs.

    Raises
    ------
    InputError
        A source does not exist, a file named by itself is no image, or there is no image at all.
    """
    images: list[Path] = []
    skipped: list[Path] = []
    for source in sources:
        try:
            found = _files_of(source)
        except OSError as error:
            raise InputError(f"{source}: cannot be read ({error.strerror})") from error
        images += [p for p in found if is_image(p)]
        skipped += [p for p in found if not is_image(p)]
    unique = sorted({p.absolute(): p for p in images}.values(), key=natural_key)
    if not unique:
        raise InputError(
            f"no image in {', '.join(map(str, sources))}", hint=f"known: {' '.join(FORMATS)}"
        )
    return unique, sorted(skipped)
