"""``turnscan compare``: how far the points of two derivations of the same scans are apart."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..schemas.errors import NotFoundError, TurnscanError
from .output import Format, FormatOption, JsonOption, chosen, counted, current_session, emit
from .places import (
    CalibrationOption,
    WhereOption,
    chosen_recipe,
    chosen_scans,
    complete_scan,
    open_archive,
)
from .recipes import RecipeOption, load_recipe

if TYPE_CHECKING:
    from ..process.compare import ShiftGrid, Shifts
    from ..schemas.manifests import DerivationManifest, ScanSummary
    from ..store import Archive

_COLUMNS = [
    *("scan", "label", "matched", "only_first", "only_second"),
    *("rms_mm", "bias_mm", "p95_mm", "max_mm", "x_mm", "y_mm", "z_mm"),
]
_SIDE_HELP = "A calibration (id, current, recorded), a recipe (name, file, r-id) or a key."


@dataclass(frozen=True)
class _Pair:
    scan: ScanSummary
    label: str
    first: DerivationManifest
    second: DerivationManifest


def compare(
    first: Annotated[str, typer.Argument(metavar="A", help=_SIDE_HELP)],
    second: Annotated[str, typer.Argument(metavar="B", help="The same, to compare with.")],
    scans: Annotated[
        list[str] | None,
        typer.Argument(metavar="[SCAN...]", help="Else all scans.", autocompletion=complete_scan),
    ] = None,
    where: WhereOption = None,
    recipe: RecipeOption = None,
    calibration: CalibrationOption = "current",
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="PNG", help="Also draw it, all scans together.")
    ] = None,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Compare two derivations of scans, point by point: B minus A.

    Points are matched by frame, laser and row. rms, p95 and max are of the shift in space, bias is the
    mean change of range; --json has them by range, too. Where A and B are calibrations, --recipe names
    the recipe of both; where they are recipes, --calibration the calibration. Scans that lack one of
    the two are left out and counted.
    """
    from ..process.compare import ShiftGrid, Shifts

    archive = open_archive()
    session = current_session()
    choice = _Choice(archive, recipe, calibration)
    picked = chosen_scans(archive, scans, where)
    labels = {r["scan"]: r["label"] for r in archive.scan_rows(retired=True)}
    sides = [choice.side(word, picked) for word in (first, second)]
    pairs = [
        _Pair(s, labels.get(s.scan, s.label), sides[0][s.scan], sides[1][s.scan])
        for s in picked
        if s.scan in sides[0] and s.scan in sides[1]
    ]
    if not pairs:
        raise NotFoundError(
            f"no scan has points of both: of {first} there are {len(sides[0])}, of {second} "
            f"{len(sides[1])}, in {counted(len(picked), 'scan')}",
            hint="turnscan query 'SELECT scan, recipe_name, calibration, key FROM derivations'",
        )
    if len(pairs) < len(picked):
        session.say(f"left out: {counted(len(picked) - len(pairs), 'scan')} without one of the two")
    total = Shifts()
    grid = ShiftGrid(
        max(p.scan.frames + p.scan.background_frames for p in pairs),
        max(max(p.scan.height_px, p.scan.width_px) for p in pairs)
        if any(_horizontal(p.first) for p in pairs)
        else max(p.scan.height_px for p in pairs),
    )
    rows = []
    points = sum(p.first.rows for p in pairs)
    done = 0
    with session.progress("comparing") as advance:
        for pair in pairs:
            rows.append(_one(archive, pair, total, grid if picture else None))
            done += pair.first.rows
            advance(done, points)
    if len(pairs) > 1:
        rows.append({"scan": "all", "label": "", **asdict(total.statistics())})
    if picture is not None:
        _draw(picture, f"{second} minus {first}, {counted(len(pairs), 'scan')}", total, grid)
        session.say(f"wrote {picture}")
    emit(rows, _COLUMNS, chosen(style, as_json))


def _horizontal(manifest: DerivationManifest) -> bool:
    stages = manifest.recipe_document.get("stages", [])
    return any(s.get("orientation") == "horizontal" for s in stages)


def _one(archive: Archive, pair: _Pair, total: Shifts, grid: ShiftGrid | None) -> dict[str, Any]:
    from ..process.batches import columns_of
    from ..process.compare import Shifts, sum_shifts

    def read(manifest: DerivationManifest) -> Iterator[dict[str, Any]]:
        return (columns_of(batch) for batch in archive.read(manifest))

    mine = Shifts()
    sum_shifts(read(pair.first), read(pair.second), mine, grid)
    total.join(mine)
    return {
        "scan": pair.scan.scan,
        "label": pair.label,
        "first_key": pair.first.key,
        "second_key": pair.second.key,
        **asdict(mine.statistics()),
    }


def _draw(out: Path, title: str, total: Shifts, grid: ShiftGrid) -> None:
    from .comparison_picture import draw

    draw(out, title, total, grid)


class _Choice:
    """From the words A and B to derivations of scans."""

    def __init__(self, archive: Archive, recipe: str | None, calibration: str) -> None:
        self._archive = archive
        self._recipe_word = recipe
        self._calibration = calibration
        self._points = [m for m in archive.derivations() if m.kind == "points"]

    def side(self, word: str, scans: list[ScanSummary]) -> dict[str, DerivationManifest]:
        """Scan -> its points under what ``word`` names; scans without are absent."""
        if word in ("current", "recorded"):
            return self._planned(scans, self._recipe_word, word)
        if re.fullmatch(r"c-[0-9a-f]*", word):
            return self._by_calibration(word, scans)
        if re.fullmatch(r"r-[0-9a-f]+", word):
            return self._newest(m for m in self._points if m.recipe.startswith(word))
        found = re.fullmatch(r"(?:k-)?([0-9a-f]{4,64})", word)
        if found:
            return self._by_key(word, found[1])
        return self._planned(scans, word, self._calibration)

    def _by_key(self, word: str, prefix: str) -> dict[str, DerivationManifest]:
        fitting = [m for m in self._points if m.key.startswith(prefix)]
        if len({m.key for m in fitting}) != 1:
            what = f"{len(fitting)} points tables fit" if fitting else "no points table has"
            raise NotFoundError(
                f"{what} the key {word}",
                hint="turnscan query \"SELECT key, scan FROM derivations WHERE kind = 'points'\"",
            )
        return self._newest(iter(fitting))

    def _by_calibration(self, word: str, scans: list[ScanSummary]) -> dict[str, DerivationManifest]:
        name = self._archive.calibration(word).calibration_id()
        recipe = chosen_recipe(self._archive, self._recipe_word).recipe_id()
        stored = self._newest(m for m in self._points if m.calibration == name and m.recipe == recipe)
        # Tables of another calibration with the same parts are this one's, too: keys know.
        return {**stored, **self._planned(scans, self._recipe_word, name)}

    def _planned(
        self, scans: list[ScanSummary], recipe: str | None, calibration: str
    ) -> dict[str, DerivationManifest]:
        chosen_one = load_recipe(recipe) if recipe else self._archive.recipe()
        plans = self._archive.plan(scans, chosen_one, calibration)
        return {
            p.scan.scan: p.points
            for p in plans
            if not isinstance(p, TurnscanError) and p.points is not None
        }

    def _newest(self, manifests: Iterator[DerivationManifest]) -> dict[str, DerivationManifest]:
        """The newest of each scan."""
        return {m.scan: m for m in sorted(manifests, key=lambda m: m.created_ns)}
