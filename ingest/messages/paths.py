"""Dotted paths into a message: ``state.position.0``; and the angle or the laser state found there."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

from ...schemas.errors import InputError

Unit = Literal["deg", "rad"]

#: A hundred turns, as for other imports: what is beyond is a mistake in the unit.
MOST_RAD = 200 * math.pi


@dataclass(frozen=True)
class AnglePath:
    """Where the angle stands in a message, and its unit (None: nothing says it).

    ``both``: the message holds ``commanded_rad`` and ``reported_rad``, as turnscan's own do.
    """

    path: tuple[str, ...]
    unit: Unit | None
    both: bool = False


def split_path(text: str) -> tuple[str, ...]:
    """The steps of a path; ``.`` alone, or nothing, is the whole message."""
    return tuple(step for step in text.replace("[", ".").replace("]", "").split(".") if step)


def value_at(tree: Any, path: tuple[str, ...]) -> Any:
    """What stands at ``path``: keys of objects, numbers of list elements.

    A list beside a list ``name`` (sensor_msgs/JointState), or of objects with a ``name``
    (foxglove.JointStates), is also entered by that name.

    Raises
    ------
    InputError
        There is no such step; the message says what there is.
    """
    parent: Any = None
    here = tree
    for i, step in enumerate(path):
        parent, found = here, _step(parent, here, step)
        if found is None:
            raise InputError(
                f"it has no {'.'.join(path[: i + 1])}", hint=f"there is: {', '.join(_steps(here))}"
            )
        here = found[0]
    return here


def _step(parent: Any, here: Any, step: str) -> tuple[Any] | None:
    if isinstance(here, dict):
        return (here[step],) if step in here else None
    if not isinstance(here, (list, tuple)):
        return None
    if step.isascii() and step.isdigit():
        return (here[int(step)],) if int(step) < len(here) else None
    names = [e.get("name") for e in here if isinstance(e, dict)]
    if not names and isinstance(parent, dict):
        names = list(parent.get("name") or ())
    places = [i for i, name in enumerate(names[: len(here)]) if name == step]
    return (here[places[0]],) if len(places) == 1 else None


def _steps(here: Any) -> list[str]:
    if isinstance(here, dict):
        return [str(k) for k in here][:12]
    if isinstance(here, (list, tuple)):
        return [str(i) for i in range(min(len(here), 12))] or ["nothing: the list is empty"]
    return [f"only a {type(here).__name__}"]


def joint_names(tree: Any) -> list[str]:
    """Names of the joints in a JointState or JointStates; empty for anything else."""
    if not isinstance(tree, dict):
        return []
    if isinstance(tree.get("joints"), list):
        return [str(j.get("name")) for j in tree["joints"] if isinstance(j, dict)]
    if "position" in tree and isinstance(tree.get("name"), (list, tuple)):
        return [str(n) for n in tree["name"]]
    return []


def likely_angle(tree: Any) -> AnglePath | None:
    """Where a message of a known kind holds its angle, or None if it is of no known kind.

    Joint positions are radians by definition (sensor_msgs/JointState, foxglove.JointState). A bare
    number has no unit: the caller must be told it.
    """
    if _is_number(tree):
        return AnglePath((), None)
    if not isinstance(tree, dict):
        return None
    if "commanded_rad" in tree:
        return AnglePath(("commanded_rad",), "rad", both=True)
    positions = tree.get("position")
    if isinstance(positions, (list, tuple)) and len(positions) == 1 and "name" in tree:
        return AnglePath(("position", "0"), "rad")
    if isinstance(tree.get("joints"), list) and len(tree["joints"]) == 1:
        return AnglePath(("joints", "0", "position"), "rad")
    for name in ("angle_rad", "angle_deg", "angle", "position_rad", "position_deg"):
        if _is_number(tree.get(name)):
            return AnglePath((name,), unit_of((name,)))
    if _is_number(positions) and isinstance(tree.get("name"), str):
        return AnglePath(("position",), "rad")
    if set(tree) == {"data"} and isinstance(tree["data"], float):
        return AnglePath(("data",), None)
    return None


def unit_of(path: tuple[str, ...]) -> Unit | None:
    """The unit that the name of a field says."""
    last = path[-1] if path else ""
    if last.endswith("_rad"):
        return "rad"
    return "deg" if last.endswith("_deg") else None


def angle_rad(tree: Any, path: tuple[str, ...], unit: Unit) -> float:
    """The angle at ``path`` in radians.

    Raises
    ------
    InputError
        There is no number, it is not finite, or it is beyond a hundred turns.
    """
    value = value_at(tree, path)
    name = ".".join(path) or "message"
    if not _is_number(value):
        raise InputError(f"its {name} is {value!r:.40}, expected a number")
    angle = math.radians(value) if unit == "deg" else float(value)
    if not math.isfinite(angle):
        raise InputError(f"its {name} is {value}, expected a finite angle")
    if abs(angle) > MOST_RAD:
        raise InputError(
            f"its {name} is {value:g} {unit}, more than a hundred turns",
            hint="is --angle-unit right? steps of a motor are no angle",
        )
    return angle


def is_lit(tree: Any, path: tuple[str, ...]) -> bool:
    """Whether the laser is on: a truth value, or a number that is not zero."""
    value = value_at(tree, path)
    if isinstance(value, bool) or (_is_number(value) and math.isfinite(value)):
        return bool(value)
    raise InputError(f"its {'.'.join(path) or 'message'} is {value!r:.40}, expected on or off")


def likely_laser(tree: Any) -> tuple[str, ...] | None:
    """Where a message of a known kind says that the laser is on."""
    if isinstance(tree, (bool, int)):
        return ()
    names = ("data", "on", "laser_on", "lit")
    return next(((n,) for n in names if isinstance(tree, dict) and n in tree), None)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)
