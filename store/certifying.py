"""What a certification or withdrawal means before it is made: what forbids it, which scans change.

The newest certification that covers a moment holds then, so a new one that overlaps an older one takes
its place for the shared time. Nobody should find that out from moved points.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ..schemas.archive_events import Certified
from ..schemas.calibration import Calibration
from ..schemas.errors import CalibrationError
from .catalog import Catalog, Row


@dataclass(frozen=True)
class Change:
    """A scan whose effective calibration becomes another; None: no calibration holds."""

    scan: str
    label: str
    before: str | None
    after: str | None


@dataclass(frozen=True)
class Certifying:
    """What certifying a calibration would mean.

    ``objections`` forbid it unless it is forced; ``overlaps`` are the standing certifications of other
    calibrations for the same rig that share time with it; ``standing`` is set where an equal
    certification stands already and is the one that holds, so that there is nothing to do.
    """

    calibration: Calibration
    rig: str
    objections: tuple[str, ...]
    warnings: tuple[str, ...]
    overlaps: tuple[Certified, ...]
    changes: tuple[Change, ...]
    standing: Certified | None

    def check(self, reason: str | None) -> None:
        """Raise a CalibrationError if anything speaks against it and no ``reason`` overrules that."""
        if self.objections and not reason:
            raise CalibrationError(
                f"calibration {self.calibration.calibration_id()} is not certified for rig "
                f"{self.rig!r}: " + "; ".join(self.objections),
                hint="calibrate again; or certify with --force --reason WHY, which is kept for good",
            )


def scans_of_rig(catalog: Catalog, rig: str) -> list[Row]:
    """Scans of ``rig`` that are in use, oldest first: what certifications decide on."""
    return catalog.rows(
        "SELECT scan, label, started_ns, width_px, height_px, calibration FROM scans "
        "WHERE rig = ? AND retired = 0 ORDER BY scan",
        (rig,),
    )


def known_rigs(catalog: Catalog) -> list[str]:
    """Rigs that the archive has scans or calibrations of."""
    rows = catalog.rows("SELECT rig FROM scans UNION SELECT rig FROM calibrations ORDER BY rig")
    return [str(r["rig"]) for r in rows]


def holding(certifications: Sequence[Certified], rig: str, t_ns: int) -> Certified | None:
    """The newest of ``certifications`` (oldest first) that covers ``t_ns`` for ``rig``."""
    for event in reversed(certifications):
        if event.rig == rig and event.covers(t_ns):
            return event
    return None


def changes(
    scans: Iterable[Row], rig: str, before: Sequence[Certified], after: Sequence[Certified]
) -> tuple[Change, ...]:
    """The scans whose effective calibration differs between two states of the certifications."""
    out = []
    for row in scans:
        old, new = (holding(state, rig, row["started_ns"]) for state in (before, after))
        names = [e.calibration if e else row["calibration"] for e in (old, new)]
        if names[0] != names[1]:
            out.append(Change(row["scan"], row["label"], names[0], names[1]))
    return tuple(out)


def consider(
    catalog: Catalog,
    standing: Sequence[Certified],
    calibration: Calibration,
    *,
    rig: str,
    from_ns: int | None,
    to_ns: int | None,
) -> Certifying:
    """What it would mean to certify ``calibration`` for ``rig`` over [from_ns, to_ns)."""
    name = calibration.calibration_id()
    proposed = Certified(
        id="7" + "Z" * 25, t_ns=0, calibration=name, rig=rig, from_ns=from_ns, to_ns=to_ns
    )
    sharing = [e for e in standing if e.rig == rig and e.overlaps(from_ns, to_ns)]
    newest = sharing[-1] if sharing else None
    same = (
        newest
        if newest is not None
        and (newest.calibration, newest.from_ns, newest.to_ns) == (name, from_ns, to_ns)
        else None
    )
    scans = scans_of_rig(catalog, rig)
    covered = [s for s in scans if proposed.covers(s["started_ns"])]
    return Certifying(
        calibration=calibration,
        rig=rig,
        objections=tuple(_objections(catalog, calibration, rig, covered)),
        warnings=tuple(_warnings(calibration, rig, len(scans), len(covered))),
        overlaps=tuple(e for e in sharing if e.calibration != name) if same is None else (),
        changes=changes(scans, rig, standing, [*standing, proposed]),
        standing=same,
    )


def _objections(catalog: Catalog, calibration: Calibration, rig: str, covered: list[Row]) -> list[str]:
    out = [
        f"it failed an acceptance limit: {part}: {gate.sentence()}"
        for part, gate in calibration.failed_gates()
    ]
    known = known_rigs(catalog)
    if rig not in known and rig != calibration.rig:
        names = ", ".join(known) or "none"
        out.append(f"the archive knows no rig {rig!r} (it knows {names})")
    camera = calibration.camera
    if camera is not None:
        size = (camera.width_px, camera.height_px)
        other = [s for s in covered if (s["width_px"], s["height_px"]) != size]
        if other:
            first = other[0]
            theirs = f"{first['width_px']} x {first['height_px']}"
            out.append(
                f"{len(other)} of the {len(covered)} scans that it would hold for have frames of "
                f"another size, such as {first['scan']} with {theirs}; it is for {size[0]} x {size[1]}"
            )
    return out


def _warnings(calibration: Calibration, rig: str, scans: int, covered: int) -> list[str]:
    out = []
    if calibration.verdict == "not judged":
        out.append("it carries no acceptance limits: nobody has judged how good it is")
    if rig != calibration.rig:
        out.append(f"it was made for rig {calibration.rig!r}, not for {rig!r}")
    if not covered:
        found = f"none of its {scans} scans lies in that time" if scans else "it has no scans yet"
        out.append(f"no scan of rig {rig!r} is affected: {found}")
    return out
