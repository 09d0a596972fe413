"""``turnscan query`` and ``turnscan export``: get data out."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..schemas.errors import ConflictError, NotFoundError, UsageError
from ..schemas.software import SOFTWARE
from .output import Format, FormatOption, JsonOption, chosen, current_session, emit
from .places import CalibrationOption, chosen_recipe, chosen_scans, complete_scan, open_archive
from .recipes import RecipeOption

if TYPE_CHECKING:
    import pyarrow as pa

    from ..schemas.manifests import DerivationManifest
    from ..store import Archive
    from ..store.export import ExportInfo


#: scan_index is a 16-bit number.
_MOST_SCANS = 65_535


def query(
    sql: Annotated[str, typer.Argument(metavar="SQL", help="SELECT ... over the tables below.")],
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Run SQL over scans, calibrations, events, references, derivations, stripes, points.

    stripes and points hold every derivation; recipe_name, calibration and key tell them apart.
    """
    from ..store.query import run_query

    frame = run_query(open_archive(), sql)
    chosen_style = chosen(style, as_json)
    if chosen_style is Format.csv:
        # Written by ourselves, slice by slice: polars would make a plain error of a broken pipe.
        sys.stdout.write(frame.clear().write_csv())
        for part in frame.iter_slices(50_000):
            sys.stdout.write(part.write_csv(include_header=False))
        return
    emit(frame.to_dicts(), frame.columns, chosen_style)


def export(
    scans: Annotated[
        list[str],
        typer.Argument(
            metavar="SCAN... OUT", help="Scans, then the file.", autocompletion=complete_scan
        ),
    ],
    recipe: RecipeOption = None,
    calibration: CalibrationOption = "current",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT.")] = False,
) -> None:
    """Write points to a file, by its suffix.

    .ply .csv .parquet .pcd, .png (a picture); with extras .las .laz .e57, and .glb .stl .obj (a mesh
    of the sweep). Lengths are mm; metres in .las, .laz, .e57 and .glb, as those formats want.
    """
    if len(scans) < 2:
        raise UsageError(
            "export takes at least one SCAN and the file OUT", hint="turnscan export latest cloud.ply"
        )
    info = export_to(
        open_archive(), scans[:-1], Path(scans[-1]), recipe, calibration, overwrite=overwrite
    )
    current_session().say(f"wrote {info.rows} points to {scans[-1]}")


def export_to(
    archive: Archive,
    words: list[str],
    out: Path,
    recipe: str | None,
    calibration: str,
    *,
    overwrite: bool,
) -> ExportInfo:
    """Write the points of the named scans to ``out``; returns what the file says of itself."""
    from ..store.export import ExportInfo, Viewpoint, check_format, export_points

    picture = out.suffix.lower() == ".png"
    if not picture:
        check_format(out)
    made = points_of(archive, words, recipe, calibration)
    if len(made) > _MOST_SCANS:
        raise UsageError(
            f"{len(made)} scans do not fit one file", hint=f"export at most {_MOST_SCANS} at a time"
        )
    info = ExportInfo(
        scans=[m.scan for m in made],
        recipe=f"{made[0].recipe_document.get('name')} ({made[0].recipe})",
        calibrations=[str(m.calibration) for m in made],
        keys=[m.key for m in made],
        software=SOFTWARE,
        rows=sum(m.rows for m in made),
        viewpoints=[Viewpoint.of(archive.calibration(str(m.calibration))) for m in made],
    )
    if picture:
        _draw(archive, made, out, info, overwrite=overwrite)
        return info
    with current_session().progress("exporting") as advance:
        export_points(_batches(archive, made, advance), out, info, overwrite=overwrite)
    return info


def _draw(
    archive: Archive,
    made: list[DerivationManifest],
    out: Path,
    info: ExportInfo,
    *,
    overwrite: bool,
) -> None:
    """A picture instead of points, for those who would look rather than read."""
    import numpy as np

    from .picture import draw_cloud

    if out.exists() and not overwrite:
        raise ConflictError(f"{out} exists already", hint="--overwrite replaces it")
    names = ("x_mm", "y_mm", "z_mm")
    parts = [
        [b.column(n).to_numpy() for n in names] for manifest in made for b in archive.read(manifest)
    ]
    x, y, z = (np.concatenate([p[i] for p in parts]) if parts else np.zeros(0) for i in range(3))
    draw_cloud(x, y, z, out, title=f"{', '.join(info.scans)[:60]}, {info.recipe}", about=info.lines())


def points_of(
    archive: Archive, words: list[str], recipe: str | None, calibration: str
) -> list[DerivationManifest]:
    """The POINTS of the named scans under one recipe and calibration choice; all must exist."""
    picked = chosen_scans(archive, words, None)
    made = []
    for plan in archive.plan(picked, chosen_recipe(archive, recipe), calibration):
        if isinstance(plan, Exception):
            raise plan
        if plan.points is None:
            raise NotFoundError(
                f"scan {plan.scan.scan} has no points of recipe {plan.recipe.name} with calibration "
                f"{plan.calibration_id}",
                hint=f"turnscan process {plan.scan.scan}",
            )
        made.append(plan.points)
    return made


def _batches(
    archive: Archive, made: list[DerivationManifest], advance: Any
) -> Iterator[pa.RecordBatch]:
    """Rows of all derivations, with the index of their scan."""
    import numpy as np
    import pyarrow as pa

    done, total = 0, sum(m.rows for m in made)
    for index, manifest in enumerate(made):
        for batch in archive.read(manifest):
            number = pa.array(np.full(batch.num_rows, index, np.uint16))
            yield batch.append_column(pa.field("scan_index", pa.uint16()), number)
            done += batch.num_rows
            advance(done, total)
