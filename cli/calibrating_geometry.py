"""What the commands calibrate plane, axis and laser-centre share: options, inputs, what they say."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .calibration_inputs import Picture, pictures
from .output import current_session

if TYPE_CHECKING:
    from ..schemas.quality import EstimationInput, LeftOut, Quality

CalibrationInOption = Annotated[
    Path,
    typer.Option(
        "--calibration",
        "-c",
        metavar="FILE",
        help="Holds the camera; other parts are kept as they are.",
    ),
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Of the random search.")]


class ChannelWord(StrEnum):
    """Channels that a stripe may be looked for in."""

    auto = "auto"
    luma = "luma"
    red = "red"
    green = "green"
    blue = "blue"
    max = "max"
    red_minus_others = "red-minus-others"


ChannelOption = Annotated[
    ChannelWord, typer.Option("--grey", help="Channel with the stripe; auto tries them.")
]


def read_inputs(
    images: list[str] | None, scans: list[str] | None, every: int
) -> tuple[list[Picture], list[LeftOut]]:
    """All inputs in order, and those that cannot be decoded as left out."""
    from ..schemas.quality import LeftOut

    found = list(pictures(images, scans, every))
    return found, [LeftOut(what=p.name, why=p.problem) for p in found if p.image is None]


def used_inputs(found: Sequence[Picture], used: set[str]) -> list[EstimationInput]:
    """The inputs that were used, with their digests."""
    from ..schemas.quality import EstimationInput

    return [EstimationInput(name=p.name, sha256=p.sha256) for p in found if p.name in used]


def judged_fields(quality: Quality) -> dict[str, Any]:
    """A quality as fields of the JSON output."""
    return {
        "verdict": quality.verdict,
        "gates": [g.model_dump(mode="json") for g in quality.gates],
        "left_out": [item.model_dump(mode="json") for item in quality.left_out],
        "notes": list(quality.notes),
    }


def say_quality(quality: Quality) -> None:
    """Gates and notes, a line each, on stderr."""
    session = current_session()
    for gate in quality.gates:
        session.say(f"{'passed' if gate.passed else 'FAILED'}: {gate.sentence()}")
    for text in quality.notes:
        session.say(f"note: {text}")
