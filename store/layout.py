"""Where everything lies in an archive: the one place that builds paths (docs/format.md)."""

from __future__ import annotations

SETTINGS = "turnscan.toml"
CATALOG = "catalog.sqlite"
SCANS = "scans"
CALIBRATIONS = "calibrations"
EVENTS = "events"
DERIVED = "derived"

LOG = "scan.mcap"
PART = "scan.mcap.part"
SUMMARY = "scan.json"
MANIFEST = "manifest-sha256.txt"
#: In the folder of an unsealed scan: what it was salvaged into.
SALVAGED = "salvaged.txt"


def scan_file(scan: str, name: str) -> str:
    """A file of a scan."""
    return f"{SCANS}/{scan}/{name}"


def calibration_file(calibration: str) -> str:
    """The document of a calibration."""
    return f"{CALIBRATIONS}/{calibration}.json"


def event_file(event: str) -> str:
    """The file of an archive event."""
    return f"{EVENTS}/{event}.json"


def derivation_folder(kind: str, *, recipe: str, calibration: str | None, scan: str) -> str:
    """The hive folder of a derivation; STRIPES lie outside any calibration."""
    if kind == "stripes":
        return f"{DERIVED}/stripes/recipe={recipe}/scan={scan}"
    return f"{DERIVED}/points/recipe={recipe}/calibration={calibration}/scan={scan}"


def table_file(folder: str, key: str) -> str:
    """The Parquet table of the derivation ``key``."""
    return f"{folder}/k-{key[:12]}.parquet"


def manifest_file(folder: str, key: str) -> str:
    """The manifest of the derivation ``key``: when it is there, the derivation is."""
    return f"{folder}/k-{key[:12]}.json"
