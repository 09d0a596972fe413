"""How `turnscan calibrate` ends: the document is written, and a failed gate is a failed command.

A calibration that fails a gate is stored as failed, in the document itself; the command exits with 1.
"""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..schemas.errors import CalibrationError, ConflictError, StorageError
from .output import current_session

if TYPE_CHECKING:
    from ..schemas.calibration import Calibration
    from ..schemas.quality import LeftOut, Quality

OutOption = Annotated[
    Path | None, typer.Option("--out", "-o", metavar="FILE", help="Write the calibration there.")
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace FILE.")]
RigOption = Annotated[str, typer.Option("--rig", help="Id of the rig that was calibrated.")]
NoteOption = Annotated[str, typer.Option("--note", help="Kept in the calibration.")]
PictureOption = Annotated[
    Path | None, typer.Option("--picture", metavar="FILE.png", help="Draw what was found.")
]
DryRunOption = Annotated[bool, typer.Option("--dry-run", help="Estimate and show, but write no file.")]


def check_free(*paths: Path | None, overwrite: bool) -> None:
    """Refuse, before any work, to replace a file unless that is wanted."""
    for path in paths:
        if path is None:
            continue
        if path.is_dir():
            raise ConflictError(f"{path} is a folder", hint="give a file name")
        if path.exists() and not overwrite:
            raise ConflictError(f"{path} exists already", hint="--overwrite replaces it")
        if not path.absolute().parent.is_dir():
            raise StorageError(f"{path}: there is no folder {path.absolute().parent}")


def write_calibration(calibration: Calibration, out: Path) -> None:
    """The document as readable JSON; the file appears whole or not at all."""
    from ..schemas.document import dump_json

    staged = out.with_name(f".{out.name}.{uuid.uuid4().hex[:8]}")
    try:
        staged.write_bytes(dump_json(calibration.plain()))
        staged.replace(out)
    except OSError as error:
        staged.unlink(missing_ok=True)
        raise StorageError(f"cannot write {out}: {error.strerror}") from error


def say_left_out(left_out: Sequence[LeftOut]) -> None:
    """One line on stderr for every input that was not used."""
    for item in left_out:
        current_session().say(f"left out {item.what}: {item.why}")


def conclude(calibration: Calibration, judged: Sequence[Quality], out: Path | None) -> None:
    """Write the document and say how it did.

    Raises
    ------
    CalibrationError
        A gate of ``judged`` failed: the document says so, and was written all the same.
    """
    session = current_session()
    if out is not None:
        write_calibration(calibration, out)
    failed = [gate for quality in judged for gate in quality.failed()]
    where = f"{out} ({calibration.calibration_id()})" if out is not None else "no file was written"
    if not failed:
        if out is not None:
            session.say(f"wrote {where}, all {sum(len(q.gates) for q in judged)} gates passed")
        return
    kept = f"; kept as failed in {where}" if out is not None else f"; {where}"
    raise CalibrationError(
        f"the calibration failed: {'; '.join(g.sentence() for g in failed)}{kept}",
        hint="take better views; to use it all the same, certify it with --force --reason",
    )
