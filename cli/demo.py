"""``turnscan demo``: a simulated rig in a room, from recording to accuracy, PLY and picture."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..schemas.errors import ConflictError, StorageError
from .output import Format, FormatOption, JsonOption, chosen, current_session, emit

if TYPE_CHECKING:
    import numpy as np

    from ..schemas.manifests import DerivationManifest
    from ..store import Archive

#: The paper's ranges and the errors that it reports for them (Xiao et al. 2015, table 2), in mm.
RANGES_MM = ((400, 1000, 5), (1000, 3000, 20), (3000, 5000, 30), (5000, 7000, 50))
#: A point whose range is off by more than this part of it sits beside a depth edge, or is plain wrong.
GROSS = 0.1
_MARK = "turnscan-demo.txt"


def demo(
    folder: Annotated[
        Path, typer.Argument(metavar="DIR", help="Where rig file, archive and results go.")
    ] = Path("demo-output"),
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the folder of an earlier demo.")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", help="Of the frames' noise.")] = 1,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Record a room with a simulated rig, process it, and show how exact it is.

    The controller is an emulator on a serial port of its own, and the frames are rendered by a forward
    model of their own, so the numbers are a real test of everything between.
    """
    from ..ingest.devices.building import read_rig
    from ..process.pipeline import derive
    from ..schemas.recipe import BUILT_IN
    from ..store import Archive
    from .recording import order_for, run

    session = current_session()
    began = time.monotonic()
    make_folder(folder, overwrite=overwrite)
    rig_file = _write_rig(folder, seed)
    archive = Archive.init(folder / "archive")
    rig = read_rig(rig_file)
    order = order_for(archive, rig, None, label="demo", tags={})
    row = run(archive, rig, order, BUILT_IN["default"], rig_file)
    summary = archive.scan(str(row["scan"]))
    rows = []
    for recipe in BUILT_IN.values():
        with session.progress(f"processing with {recipe.name}") as advance:
            for outcome in derive(archive, [summary], recipe, advance=advance):
                if outcome.error:
                    raise outcome.error
        made = next(p.points for p in archive.plan([summary], recipe) if not isinstance(p, Exception))
        assert made is not None
        session.say(f"recipe {recipe.name}: {made.rows} points")
        rows += accuracy_rows(archive, made, recipe.name)
    _write_results(archive, folder, summary.scan)
    columns = [
        "recipe",
        "range_m",
        "points",
        "bias_mm",
        "rms_mm",
        "p95_mm",
        "gross_percent",
        "paper_mm",
    ]
    emit(rows, columns, chosen(style, as_json))
    session.say(
        f"wrote {folder / 'room.ply'} and {folder / 'room.png'} in {time.monotonic() - began:.1f} s"
    )
    session.say(f"try: turnscan --archive {folder / 'archive'} scan show latest")


#: The paper's rig, with a motor that a simulation need not wait for.
_RIG = """\
format = "turnscan.rig"
version = 1
name = "demo"

[turntable]
driver = "simulated"
dialect = "turnscan"
gear_ratio = 60        # the motor turns 60 times for one turn of the table
settle_ms = 0

[[lasers]]
number = 0
output = 1

[camera]
driver = "simulated"

[scan]
to_deg = 360
step_deg = 2

[simulated]
scene = "room"
seed = {seed}
time_scale = 30        # the simulated table turns 30 times faster than it is told
"""


def _write_rig(folder: Path, seed: int) -> Path:
    path = folder / "rig.toml"
    try:
        path.write_text(_RIG.format(seed=seed))
    except OSError as error:
        raise StorageError(f"cannot write {path}: {error.strerror}") from error
    return path


def make_folder(folder: Path, *, overwrite: bool) -> None:
    """An empty folder with the demo's mark; only one that bears the mark is ever replaced."""
    if folder.exists() and any(folder.iterdir()):
        if not (folder / _MARK).exists():
            raise ConflictError(f"{folder} is not empty", hint="give another folder")
        if not overwrite:
            raise ConflictError(f"{folder} holds an earlier demo", hint="--overwrite replaces it")
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / _MARK).write_text("made by turnscan demo; --overwrite may delete this folder\n")


def accuracy_rows(archive: Archive, points: DerivationManifest, recipe: str) -> list[dict[str, Any]]:
    """Range errors against the simulated surfaces, for the ranges of the paper's table 2."""
    import numpy as np

    from ..ingest.room.demo import demo_calibration, demo_scene
    from ..ingest.room.rig import SimulatedRig
    from ..ingest.room.truth import range_errors_mm

    rig, scene = SimulatedRig(demo_calibration()), demo_scene()
    errors, ranges = [], []
    for columns in _columns(archive, points):
        frame = columns["frame"]
        for n in np.unique(frame):
            mine = frame == n
            xyz = np.stack([columns[f"{a}_mm"][mine].astype(np.float64) for a in "xyz"], axis=1)
            angle = float(columns["angle_rad"][mine][0])
            error, true = range_errors_mm(scene, rig, angle, xyz)
            errors.append(error)
            ranges.append(true)
    error, true = np.concatenate(errors), np.concatenate(ranges)
    gross = np.abs(error) > GROSS * true
    rows = []
    for low, high, paper in RANGES_MM:
        here = (true >= low) & (true < high)
        good = error[here & ~gross]
        if not len(good):
            continue
        rows.append(
            {
                "recipe": recipe,
                "range_m": f"{low / 1000:g}-{high / 1000:g}",
                "points": int(here.sum()),
                "bias_mm": round(float(np.mean(good)), 3),
                "rms_mm": round(float(np.sqrt(np.mean(good**2))), 3),
                "p95_mm": round(float(np.percentile(np.abs(good), 95)), 3),
                "gross_percent": round(100 * float((here & gross).sum() / here.sum()), 3),
                "paper_mm": paper,
            }
        )
    return rows


def _columns(archive: Archive, points: DerivationManifest) -> list[dict[str, np.ndarray[Any, Any]]]:
    return [
        {n: b.column(i).to_numpy() for i, n in enumerate(b.schema.names)} for b in archive.read(points)
    ]


def _write_results(archive: Archive, folder: Path, scan: str) -> None:
    from .exporting import export_to
    from .picture import draw_cloud

    export_to(archive, [scan], folder / "room.ply", "default", "current", overwrite=True)
    cloud = archive.points(recipe="default").select("x_mm", "y_mm", "z_mm").collect()
    draw_cloud(
        cloud["x_mm"].to_numpy(),
        cloud["y_mm"].to_numpy(),
        cloud["z_mm"].to_numpy(),
        folder / "room.png",
        title="turnscan demo: simulated room, recipe default",
    )
