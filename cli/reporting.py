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
    import numpy.typing as npt

    from ..process.denoise_table import FilterTable, Reference
    from ..process.pairing import LitFrame
    from ..schemas.events import StripeTruth
    from ..schemas.manifests import ScanSummary
    from ..schemas.recipe import Grey, Recipe
    from ..store import Archive

    Image = npt.NDArray[Any]

#: Frames of one pose that are averaged, at most: they are held in memory together.
_MOST_OF_A_POSE = 32

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
    table = FilterTable()
    truths: dict[int, list[StripeTruth]] = {}
    wanted = {n: p for p in picked for n in p.frames[:_MOST_OF_A_POSE]}
    held: list[LitFrame] = []
    colour = False
    with current_session().progress("filtering") as advance:
        for lit in _lit(archive, summary, wanted.__contains__, truths):
            # What the log says of a frame stands beside it: it is complete when the next frame is seen.
            if held and wanted[held[0].frame] is not wanted[lit.frame]:
                colour = _add(table, held, grey, truths)
                advance(table.frames, count)
            held.append(lit)
        colour = _add(table, held, grey, truths)
    return table, _meaning(table, repeated, colour=colour)


def _add(
    table: FilterTable, held: list[LitFrame], grey: Grey, truths: dict[int, list[StripeTruth]]
) -> bool:
    """Add the first of the ``held`` frames of one pose, and let go of them.

    Returns whether its truth is left out, being that of a colour frame: how much of the laser's light
    is in each channel is not in the log.
    """
    import numpy as np

    from ..process.denoise_truth import clean_frame
    from ..process.grey import to_grey
    from ..schemas.truth import unpacked_truth

    first, *others = (to_grey(lit.image, grey) for lit in held)
    references: dict[Reference, Image] = {}
    if others:
        references["temporal_mean"] = np.mean(others, axis=0)
    known = truths.get(held[0].frame, [])
    colour = held[0].image.ndim == 3
    if known and not colour:
        references["truth"] = clean_frame(first, [(t.stripe, unpacked_truth(t)) for t in known])
    table.add(first, references)
    for lit in held:
        truths.pop(lit.frame, None)
    held.clear()
    return bool(known) and colour


def _meaning(table: FilterTable, repeated: list[_Pose], *, colour: bool) -> dict[str, str]:
    fewest = min((min(len(p.frames), _MOST_OF_A_POSE) for p in repeated), default=0) - 1
    return {
        "unfiltered": "the unfiltered frame, as in the paper: tells how much a filter changes, not how "
        "good it is; doing nothing scores infinity (null in JSON)",
        "truth": "the simulated stripes without noise, as the log's /truth says, on the frame's own "
        "ambient light (a fitted plane)"
        if table.has("truth")
        else "none: "
        + (
            "its truth is that of grey frames, these are colour"
            if colour
            else "the scan carries no truth"
        ),
        "temporal_mean": f"the mean of the other frames at the same pose, {fewest} or more; its own "
        f"noise adds up to 1/{fewest} of a frame's noise power to each MSE"
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
    for lit in _lit(archive, summary, None, {}):
        last = out[-1] if out else None
        if last and last.angle_rad == lit.angle_rad and last.lasers_on == lit.lasers_on:
            last.frames.append(lit.frame)
        else:
            out.append(_Pose(lit.angle_rad, lit.lasers_on, [lit.frame]))
    return out


def _lit(
    archive: Archive,
    summary: ScanSummary,
    wanted: Callable[[int], bool] | None,
    truths: dict[int, list[StripeTruth]],
) -> Iterator[LitFrame]:
    """The lit frames that are wanted, of the first camera, with their angles; undecoded with None.

    What the log says of the truth of these frames is put into ``truths`` as it comes by.
    """
    from ..process.pairing import pair_frames
    from ..schemas.events import StripeTruth, TurntableAngle
    from ..store.log_reader import LogFrame

    def items() -> Iterator[Any]:
        for item in archive.log(summary.scan).items():
            if isinstance(item, TurntableAngle):
                yield item
            elif isinstance(item, StripeTruth):
                if wanted is not None and wanted(item.frame) and item.camera == summary.cameras[0]:
                    truths.setdefault(item.frame, []).append(item)
            elif isinstance(item, LogFrame) and item.camera == summary.cameras[0]:
                if wanted is None:
                    yield _Unread(item.frame, item.t_ns, item.lasers_on)
                elif wanted(item.frame):
                    yield item

    return pair_frames(items(), with_background=False)
