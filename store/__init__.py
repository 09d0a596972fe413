"""Everything on disk: logs, archive, derivations, catalogue, query, export, fixity."""

from __future__ import annotations

from .archive import Archive

__all__ = ["Archive"]
