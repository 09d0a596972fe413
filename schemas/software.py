"""The name and version of this program, as written into everything it makes."""

from __future__ import annotations

from typing import Final

__version__: Final = "0.1.0"
SOFTWARE: Final = f"turnscan {__version__}"
