"""Which topics of a recording are the images, the angle, the laser and the camera."""

from __future__ import annotations

from dataclasses import dataclass

from ..schemas.calibration import Intrinsics
from ..schemas.errors import InputError
from .mcap_survey import Asked, Survey, Track


@dataclass(frozen=True)
class Choice:
    """The topics to import; every message on them has been looked at."""

    images: Track
    angles: Track
    laser: Track | None


def choose(survey: Survey, asked: Asked) -> Choice:
    """The topics that were asked for, else the only ones there are.

    Raises
    ------
    InputError
        A topic is not in the file or is not of the right kind; there is no candidate or more than
        one; the angle has no unit; or a message on a chosen topic cannot be used.
    """
    images = _one(survey, survey.images, asked.image_topic, "image", "--image-topic")
    angles = _one(survey, survey.angles, asked.angle_topic, "angle", "--angle-topic")
    laser = None
    if asked.laser_topic is not None or survey.lasers:
        laser = _one(survey, survey.lasers, asked.laser_topic, "laser", "--laser-topic")
    assert angles.path is not None
    if angles.path.unit is None and asked.angle_unit is None:
        field = ".".join(angles.path.path) or "the message itself"
        raise InputError(
            f"{survey.path}: {angles.topic} ({angles.schema or angles.encoding}): nothing says "
            f"whether {field} is in degrees",
            hint="give --angle-unit deg or --angle-unit rad",
        )
    return Choice(images, angles, laser)


def _one(survey: Survey, found: dict[str, Track], asked: str | None, what: str, option: str) -> Track:
    track = _found(survey, found, asked, what, option)
    if track.problem is not None:
        raise track.problem
    return track


def _found(survey: Survey, found: dict[str, Track], asked: str | None, what: str, option: str) -> Track:
    if asked is not None:
        if asked in found:
            return found[asked]
        there = survey.topics.get(asked)
        if there is None:
            raise InputError(
                f"{survey.path}: has no topic {asked}", hint=_listed(survey, found, what, option)
            )
        raise InputError(
            f"{survey.path}: {there.described()} is no {what} topic that can be read",
            hint=_listed(survey, found, what, option),
        )
    if len(found) != 1:
        number = "no topic" if not found else f"{len(found)} topics"
        verb = "is" if not found else "could be"
        raise InputError(
            f"{survey.path}: {number} {verb} the {what}", hint=_listed(survey, found, what, option)
        )
    return next(iter(found.values()))


def _listed(survey: Survey, found: dict[str, Track], what: str, option: str) -> str:
    names = [survey.topics[t].described() for t in found]
    if names:
        return f"give {option}, one of: {'; '.join(names)}"
    everything = [t.described() for t in survey.topics.values()][:20]
    rest = len(survey.topics) - len(everything)
    more = f"; and {rest} more" if rest else ""
    return f"{what} topics: none; the file has: {'; '.join(everything) or 'no message'}{more}"


def choose_camera(survey: Survey, width_px: int, height_px: int) -> tuple[Intrinsics | None, list[str]]:
    """The only camera of the recording that fits the images, and in words what became of the others."""
    fitting: list[tuple[str, Intrinsics]] = []
    said = []
    for topic, track in survey.cameras.items():
        if track.problem is not None:
            said.append(f"camera calibration on {topic} is ignored: {track.problem}")
        elif len(track.cameras) != 1:
            said.append(f"camera calibration on {topic} is ignored: it changes on the way")
        elif (track.cameras[0].width_px, track.cameras[0].height_px) != (width_px, height_px):
            camera = track.cameras[0]
            said.append(
                f"camera calibration on {topic} is ignored: it is for {camera.width_px} x "
                f"{camera.height_px}, the images are {width_px} x {height_px}"
            )
        else:
            fitting.append((topic, track.cameras[0]))
    if len(fitting) == 1:
        return fitting[0][1], [*said, f"camera calibration of {fitting[0][0]} kept as recorded"]
    if fitting:
        names = ", ".join(topic for topic, _ in fitting)
        said.append(f"camera calibrations on {names} are ignored: give one with --calibration")
    return None, said
