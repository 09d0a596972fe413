"""The one family of errors that a user can cause or mend.

Every member says what is wrong, which file or value it is about, and (as ``hint``) what to do. Each
class has a stable ``slug`` and the exit code of the command line. Anything outside this family is a
bug in turnscan and is left to crash as one.
"""

from __future__ import annotations


class TurnscanError(Exception):
    """A failure that the user can understand and act on.

    Parameters
    ----------
    message
        What is wrong, naming the file, the value found and the value expected.
    hint
        The way out, as a sentence or a command.
    """

    slug = "error"
    exit_code = 1

    def __init__(self, message: str, *, hint: str | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.hint = hint

    def __reduce__(self) -> tuple[object, ...]:
        # Worker processes send errors home by pickling; keyword-only hints would be lost otherwise.
        return (_rebuild, (type(self), self.message, self.hint))


def _rebuild(kind: type[TurnscanError], message: str, hint: str | None) -> TurnscanError:
    return kind(message, hint=hint)


class UsageError(TurnscanError):
    """The command was called with words or values that it cannot take."""

    slug = "usage"
    exit_code = 2


class InputError(TurnscanError, ValueError):
    """An input file or array is not what it must be (unreadable, mixed sizes, missing row)."""

    slug = "input"


class DocumentError(TurnscanError, ValueError):
    """A document (calibration, recipe, manifest, event) does not hold to its model."""

    slug = "document"


class FormatVersionError(DocumentError):
    """Something was written by a newer turnscan than this one."""

    slug = "format-version"


class NotFoundError(TurnscanError, LookupError):
    """No such archive, scan, calibration, recipe or table; or more than one fits."""

    slug = "not-found"


class CalibrationError(TurnscanError):
    """The calibration does not fit the scan: wrong image size, missing part, none that holds."""

    slug = "calibration"


class DamageError(TurnscanError):
    """Stored bytes are not the bytes that were written: a digest, CRC or structure is broken."""

    slug = "damage"


class CutOffError(DamageError):
    """A file ends before its structure does; what stands before the end is whole."""

    slug = "cut-off"


class StorageError(TurnscanError):
    """The file system refused: disk full, no permission, not a folder."""

    slug = "storage"


class ConflictError(TurnscanError):
    """What should be written exists already, or another process is in the way."""

    slug = "conflict"


class DeviceError(TurnscanError):
    """A device (port, controller, laser, camera) does not answer, refuses, or answers wrongly."""

    slug = "device"


class ExtraMissingError(TurnscanError):
    """A format or feature needs an optional dependency that is not installed."""

    slug = "extra-missing"
