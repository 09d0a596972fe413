"""turnscan: laser-triangulation scans as immutable event logs, and tables derived from them.

The public names are imported on use, so that ``import turnscan`` costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from .schemas.software import __version__

if TYPE_CHECKING:
    from .process.extract import extract_stripe
    from .store import Archive

__all__ = ["Archive", "__version__", "extract_stripe"]


def __getattr__(name: str) -> object:
    if name == "Archive":
        from .store import Archive

        return Archive
    if name == "extract_stripe":
        from .process.extract import extract_stripe

        return extract_stripe
    raise AttributeError(f"module 'turnscan' has no attribute {name!r}")
