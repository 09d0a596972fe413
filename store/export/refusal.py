"""Why a library could not write its file, when it hides the file system's answer behind its own."""

from __future__ import annotations

import errno
import os
from pathlib import Path


def refusal(error: Exception, path: Path) -> OSError:
    """The file system's error behind ``error``, found by adding a little to the half-made ``path``."""
    try:
        with path.open("ab", buffering=0) as file:
            for _ in range(16):
                file.write(bytes(65536))
            os.fsync(file.fileno())
    except OSError as found:
        return found
    return OSError(errno.EIO, str(error).strip().splitlines()[0])
