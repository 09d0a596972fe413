"""What `turnscan calibrate` looks at: image files and frames of scans, one after the other."""

from __future__ import annotations

import hashlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import typer

from ..schemas.errors import DamageError, InputError, UsageError
from .places import complete_scan, open_archive

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

Found = TypeVar("Found")
_THREADS = 2

ImagesArgument = Annotated[
    list[str] | None,
    typer.Argument(metavar="DIR|GLOB|FILE...", help="JPEG, PNG, BMP, TIFF; or none, with --scan."),
]
ScanOption = Annotated[
    list[str] | None,
    typer.Option(
        "--scan", metavar="SCAN", help="Use a scan's frames; may repeat.", autocompletion=complete_scan
    ),
]
EveryOption = Annotated[
    int, typer.Option("--every", metavar="N", min=1, help="Use every N-th frame of a scan.")
]


@dataclass(frozen=True)
class Picture:
    """One input: its name, its SHA-256 if it is a file, and its pixels, or why it has none."""

    name: str
    sha256: str | None
    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | None
    problem: str = ""


def pictures(
    images: Sequence[str] | None, scans: Sequence[str] | None, every: int
) -> Iterator[Picture]:
    """Every image that the words name, in natural order, then the scans' frames.

    A file that cannot be decoded comes without pixels and with the reason.

    Raises
    ------
    UsageError
        Nothing was named.
    InputError
        A path does not exist.
    """
    if not images and not scans:
        raise UsageError("no images given", hint="name files, a folder or a pattern; or use --scan")
    if images:
        from ..ingest.image_sources import find_images

        paths, _ = find_images(list(images))
        several = len({p.parent for p in paths}) > 1
        for path in paths:
            yield _file(path, str(path) if several else path.name)
    for word in scans or ():
        archive = open_archive()
        scan = archive.scan(word).scan
        for i, frame in enumerate(archive.log(scan).frames()):
            if i % every == 0:
                yield Picture(f"{scan} frame {frame.frame}", None, frame.decode())


def side_by_side(
    look: Callable[[Picture], Found], seen: Iterable[Picture]
) -> Iterator[tuple[Picture, Found]]:
    """Every picture with what ``look`` says of it, in order: one is read while others are looked at.

    OpenCV works without the interpreter's lock, so threads do. Few pictures are held at a time.
    """
    waiting: deque[tuple[Picture, Future[Found]]] = deque()
    with ThreadPoolExecutor(_THREADS) as pool:
        for picture in seen:
            waiting.append((picture, pool.submit(look, picture)))
            if len(waiting) > 2 * _THREADS:
                first, future = waiting.popleft()
                yield first, future.result()
        for first, future in waiting:
            yield first, future.result()


def _file(path: Path, name: str) -> Picture:
    from ..ingest.image_reading import read_image
    from ..store.log_reader import decode_image_file

    try:
        checked = read_image(path)
        pixels: Any = decode_image_file(checked.data, where=str(path))
    except (InputError, DamageError) as error:
        return Picture(name, None, None, str(error))
    return Picture(name, hashlib.sha256(checked.data).hexdigest(), pixels)
