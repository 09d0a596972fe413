"""``turnscan report``: pages about scans. ``denoise`` is the paper's Table 1."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ..schemas.errors import ConflictError, InputError, StorageError, UsageError
from .output import (
    Format,
    FormatOption,
    JsonOption,
    chosen,
    counted,
    current_session,
    emit,
    emit_object,
)
from .places import ScanArgument, chosen_recipe, open_archive
from .recipes import RecipeOption

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from ..process.denoise_table import FilterTable, Reference
    from ..process.pairing import LitFrame
    from ..schemas.manifests import ScanSummary
    from ..schemas.recipe import Recipe
    from ..store import Archive

    Image = npt.NDArray[Any]
    Truth = Callable[[float], Image]

#: Frames of one pose that are averaged, at most: they are held in memory together.
_MOST_OF_A_POSE = 32
#: Mean of |frame - truth| over the noise that the simulation says, 4 at most so that impulses do not count:
#: sqrt(2 / pi) = 0.80 for a normal distribution.
_LIKE_THE_ROOM = (0.7, 0.9)

report_app = typer.Typer(
    no_args_is_help=True,
    help="Reports about scans.",
    epilog="Example: turnscan report denoise latest -o denoise.html",
)


@report_app.command(epilog="Example: turnscan report denoise latest --frames 20 -o denoise.html")
def denoise(
    scan: ScanArgument,
    frames: Annotated[
        int, typer.Option("--frames", min=1, help="Frames to filter, spread over the scan's poses.")
    ] = 8,
    recipe: RecipeOption = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Also write a page: .html")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace FILE.")] = False,
    style: FormatOption = Format.table,
    as_json: JsonOption = False,
) -> None:
    """Measure what each filter does to a scan's frames: PSNR, MSE, SNR, as the paper's Table 1.

    Each figure stands against three references. unfiltered is the paper's: doing nothing scores
    infinity there. truth is the noise-free frame of a simulated scan; temporal_mean the mean of the
    other frames at the same pose, of a scan that has any. Frames are greyed as the recipe says.
    """
    if out is not None:
        if out.suffix.lower() != ".html":
            raise UsageError(f"{out}: cannot write a page as {out.suffix!r}", hint="give a .html file")
        if out.exists() and not overwrite:
            raise ConflictError(f"{out} exists already", hint="--overwrite replaces it")
    chosen_style = chosen(style, as_json)
    archive = open_archive()
    summary = archive.scan(scan)
    table, meaning = measure(archive, summary, chosen_recipe(archive, recipe), frames)
    rows = table.rows()
    session = current_session()
    value = {
        "scan": summary.scan,
        "frames": table.frames,
        "peak_dn": table.peak_dn,
        "references": meaning,
        "rows": rows,
    }
    if chosen_style is Format.json:
        emit_object(value, chosen_style)
    else:
        columns = [c for c in rows[0] if not c.startswith("snr_") or c == "snr_vs_unfiltered_db"]
        shown = [{c: _cell(r[c], c) for c in columns} for r in rows]
        emit(shown, columns, chosen_style)
    session.say(f"{counted(table.frames, 'frame')} of {summary.scan}, peak {table.peak_dn:g} DN")
    for name, text in meaning.items():
        session.say(f"vs_{name}: {text}")
    if out is not None:
        from .report_page import denoise_page

        try:
            out.write_text(denoise_page(value), encoding="utf-8")
        except OSError as error:
            raise StorageError(f"cannot write {out}: {error.strerror}") from error
        session.say(f"wrote {out}")


def _cell(value: Any, column: str) -> Any:
    if value is None:
        return "no truth" if "truth" in column else "no repeats"
    return round(value, 4) if isinstance(value, float) else value


@dataclass(frozen=True)
class _Pose:
    """Frames (by number) that follow one another at one angle with the same lasers lit."""

    angle_rad: float
    lasers_on: tuple[int, ...]
    frames: list[int]


def measure(
    archive: Archive, summary: ScanSummary, recipe: Recipe, frames: int
) -> tuple[FilterTable, dict[str, str]]:
    """The filled table of a scan, and what each of its references is, or why there is none.

    Raises
    ------
    InputError
        No frame has a laser lit, or the log lacks angles.
    """
    from ..process.denoise_table import FilterTable
    from ..process.grey import to_grey
    from ..schemas.recipe import Grey

    poses = _poses(archive, summary)
    if not poses:
        raise InputError(
            f"scan {summary.scan} has no frame with a laser lit",
            hint="the report compares frames that show the stripe",
        )
    repeated = [p for p in poses if len(p.frames) > 1]
    # Only where poses are repeated is there a mean to judge by: those are taken then.
    usable = repeated or poses
    count = min(frames, len(usable))
    picked = [usable[i * len(usable) // count] for i in range(count)]
    grey = next((s for s in recipe.stages if isinstance(s, Grey)), Grey())
    truth = _room_truth(summary)
    table = FilterTable()
    wanted = {n: i for i, p in enumerate(picked) for n in p.frames[:_MOST_OF_A_POSE]}
    held: list[list[Image]] = [[] for _ in picked]
    unlike = 0
    with current_session().progress("filtering") as advance:
        for lit in _lit(archive, summary, wanted.__contains__):
            at = wanted[lit.frame]
            pose = picked[at]
            held[at].append(to_grey(lit.image, grey))
            if len(held[at]) < min(len(pose.frames), _MOST_OF_A_POSE):
                continue
            first, *others = held[at]
            held[at] = []
            references: dict[Reference, Image] = {}
            if others:
                references["temporal_mean"] = sum(o.astype(float) for o in others) / len(others)
            if truth is not None:
                clean = truth(pose.angle_rad)
                if _is_of(first, clean):
                    references["truth"] = clean
                else:
                    unlike += 1
            table.add(first, references)
            advance(table.frames, count)
    if table.has("truth") and unlike:
        raise InputError(
            f"scan {summary.scan}: {unlike} of {table.frames} frames are not the simulated room's",
            hint="the scan mixes rendered frames with others, so that it has no one truth",
        )
    return table, _meaning(table, repeated, unlike)


def _meaning(table: FilterTable, repeated: list[_Pose], unlike: int) -> dict[str, str]:
    fewest = min((min(len(p.frames), _MOST_OF_A_POSE) for p in repeated), default=0) - 1
    no_truth = "the scan carries no truth"
    if unlike:
        no_truth = "the calibration is that of the simulated room, but the frames are not"
    return {
        "unfiltered": "the unfiltered frame, as in the paper: tells how much a filter changes, not how "
        "good it is; doing nothing scores infinity",
        "truth": "the simulated frame without noise, rounded to whole DN"
        if table.has("truth")
        else f"none: {no_truth}",
        "temporal_mean": f"the mean of the other frames at the same pose, {fewest} or more; its own noise "
        f"adds up to 1/{fewest} of a frame's noise power to each MSE"
        if table.has("temporal_mean")
        else "none: no pose has two frames",
    }


@dataclass(frozen=True)
class _Unread:
    """A frame of which only the pose is wanted."""

    frame: int
    t_ns: int
    lasers_on: tuple[int, ...]

    def decode(self) -> Image:
        import numpy as np

        return np.empty((0, 0), np.uint8)


def _poses(archive: Archive, summary: ScanSummary) -> list[_Pose]:
    """Every run of lit frames at one pose, in time order; no image is decoded."""
    out: list[_Pose] = []
    for lit in _lit(archive, summary, None):
        last = out[-1] if out else None
        if last and last.angle_rad == lit.angle_rad and last.lasers_on == lit.lasers_on:
            last.frames.append(lit.frame)
        else:
            out.append(_Pose(lit.angle_rad, lit.lasers_on, [lit.frame]))
    return out


def _lit(
    archive: Archive, summary: ScanSummary, wanted: Callable[[int], bool] | None
) -> Iterator[LitFrame]:
    """The lit frames that are wanted, of the first camera, with their angles; undecoded with None."""
    from ..process.pairing import pair_frames
    from ..schemas.events import TurntableAngle
    from ..store.log_reader import LogFrame

    def items() -> Iterator[Any]:
        for item in archive.log(summary.scan).items():
            if isinstance(item, TurntableAngle):
                yield item
            elif isinstance(item, LogFrame) and item.camera == summary.cameras[0]:
                if wanted is None:
                    yield _Unread(item.frame, item.t_ns, item.lasers_on)
                elif wanted(item.frame):
                    yield item

    return pair_frames(items(), with_background=False)


def _room_truth(summary: ScanSummary) -> Truth | None:
    """What renders the noise-free frame at an angle, if the scan was made in the simulated room."""
    from ..ingest.room.demo import demo_calibration, demo_scene
    from ..ingest.room.render import Light, render
    from ..ingest.room.rig import SimulatedRig

    calibration = demo_calibration()
    if summary.calibration != calibration.calibration_id():
        return None
    rig, scene, light = SimulatedRig(calibration), demo_scene(), Light(noise_dn=0.0, shot_dn_per_dn=0.0)
    return lambda angle_rad: render(scene, rig, angle_rad, seed=0, light=light).image


def _is_of(frame: Image, clean: npt.NDArray[np.uint8]) -> bool:
    """Whether a frame differs from the rendered one by the simulation's own noise: nothing is taken on trust."""
    import numpy as np

    from ..ingest.room.render import Light

    if frame.shape != clean.shape or frame.dtype != clean.dtype:
        return False
    light = Light()
    sigma = np.sqrt(light.noise_dn**2 + light.shot_dn_per_dn * clean + 1.0 / 6.0)
    low, high = _LIKE_THE_ROOM
    return low < float(np.minimum(np.abs(frame - clean.astype(float)) / sigma, 4.0).mean()) < high
