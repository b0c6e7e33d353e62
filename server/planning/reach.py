"""The paths of the direct sound within reach: at the present poses, and wherever emitters and listener can be before
the next plan.

Axes: n rows, each a position of one emitter and of the listener; e emitters, whose present positions are the first e
rows; bands are OCTAVE_BANDS_HZ. Lengths are in metres.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import COINCIDENT_M, axes_of
from server.acoustics.sound_path import SoundPathFinder, SoundPaths
from server.planning.scene_acoustics import SceneAcoustics, Situation

Floats = npt.NDArray[np.float64]

HORIZON_S = 3.0
"""How far ahead a plan looks."""

_COURSES = 8
_TURNS = np.array([(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)])
"""Directions ahead of an emitter that turns, beside it and behind it."""


@dataclass(frozen=True)
class Reach:
    """The paths of all rows. `owner` (n,) is the index of a row's emitter. `paths` go round obstacles, `straight` ones
    through them. `departure_db` (n, band) is the emitter's gain in the direction in which `paths` leave it, and
    `straight_departure_db` the one for `straight`."""

    owner: npt.NDArray[np.int64]
    listener: Floats
    emitter: Floats
    paths: SoundPaths
    straight: SoundPaths
    departure_db: Floats
    straight_departure_db: Floats

    @classmethod
    def of(cls, situation: Situation) -> "Reach":
        """Find the paths of a situation that has at least one emitter."""
        place, emitters = situation.place, list(situation.emitters.values())
        here = np.array([emitter.pose.position for emitter in emitters])
        listeners = _within_reach(np.array([situation.listener.pose.position]), [situation.listener.speed_m_s], place)
        movers = [number for number, emitter in enumerate(emitters) if emitter.speed_m_s > 0]
        elsewhere = _within_reach(here[movers], [emitters[number].speed_m_s for number in movers], place)
        turners = [number for number, each in enumerate(emitters) if each.turns and not each.is_omnidirectional]

        owner, at_listener, at_emitter = (
            [np.arange(len(emitters))],
            [np.repeat(listeners[0], len(here), axis=0)],
            [here],
        )
        for course, listener in enumerate(listeners[1:]):
            # Listener and moving emitters go opposite ways: over all courses they approach each other and part.
            at = np.concatenate([here, *([elsewhere[1 + (course + _COURSES // 2) % _COURSES]] if movers else [])])
            owner.append(np.concatenate([np.arange(len(emitters)), np.array(movers, np.int64)]))
            at_listener.append(np.repeat(listener, len(at), axis=0))
            at_emitter.append(at)
        for at in elsewhere[1:]:
            owner.append(np.array(movers, np.int64))
            at_listener.append(np.repeat(listeners[0], len(movers), axis=0))
            at_emitter.append(at)
        for _ in _TURNS:
            owner.append(np.array(turners, np.int64))
            at_listener.append(np.repeat(listeners[0], len(turners), axis=0))
            at_emitter.append(here[turners])
        rows, listener, emitter = np.concatenate(owner), np.concatenate(at_listener), np.concatenate(at_emitter)

        straight = _straight(listener, emitter)
        paths = straight if place.paths is None else _paths(place.paths, listener, emitter)
        departure_db, straight_departure_db = np.zeros((2, len(rows), len(OCTAVE_BANDS_HZ)))
        for number, each in enumerate(emitters):
            if not each.is_omnidirectional:
                of_it = np.flatnonzero(rows == number)
                axes = axes_of(each.pose.orientation)
                departure_db[of_it] = each.directivity.gain_db(paths.departure[of_it] @ axes.T)
                straight_departure_db[of_it] = each.directivity.gain_db(straight.departure[of_it] @ axes.T)
                if number in turners:
                    turned = each.directivity.gain_db(_TURNS)
                    departure_db[of_it[-len(_TURNS) :]] = turned
                    straight_departure_db[of_it[-len(_TURNS) :]] = turned
        return cls(rows, listener, emitter, paths, straight, departure_db, straight_departure_db)

    def most(self, values: Floats) -> Floats:
        """Reduce (v, n) to (v, e): the greatest value of each emitter's rows."""
        greatest = np.full((int(self.owner.max()) + 1, len(values)), -np.inf)
        np.maximum.at(greatest, self.owner, values.T)
        return greatest.T


def _within_reach(points: Floats, speeds_m_s: list[float], place: SceneAcoustics) -> Floats:
    """Return (1 + course, point, 3): the present points, and for each course how far they get within the bounds of the
    place.

    A point that would end in a wall goes half as far, or stays. If all points are at rest, there are only the present
    ones.
    """
    if not any(speeds_m_s):
        return points[np.newaxis]
    angle = 2 * np.pi / _COURSES * np.arange(_COURSES)
    courses = np.stack([np.cos(angle), np.sin(angle), np.zeros(_COURSES)], axis=-1)
    far = HORIZON_S * np.asarray(speeds_m_s)[:, None] * courses[:, None]
    ends, halfway = (np.clip(points + way, place.minimum, place.maximum) for way in (far, far / 2))
    if place.surroundings is not None:
        inside = place.surroundings.contains(np.stack([ends, halfway]))[..., None]
        ends = np.where(inside[0], ends, np.where(inside[1], halfway, points))
    return np.concatenate([points[np.newaxis], ends])


def _paths(finder: SoundPathFinder, listener: Floats, emitter: Floats) -> SoundPaths:
    found = SoundPaths.empty(len(listener))
    # Rows with the same position of the listener are adjacent.
    edges = np.flatnonzero(np.any(np.diff(listener, axis=0), axis=-1)) + 1
    for start, stop in zip([0, *edges], [*edges, len(listener)], strict=True):
        for whole, part in zip(
            vars(found).values(), vars(finder.find(listener[start], emitter[start:stop])).values(), strict=True
        ):
            whole[start:stop] = part
    return found


def _straight(listener: Floats, emitter: Floats) -> SoundPaths:
    """Return straight paths that ignore all obstacles."""
    straight_m, count = np.linalg.norm(listener - emitter, axis=-1), len(listener)
    towards = (emitter - listener) / np.maximum(straight_m, COINCIDENT_M)[:, None]
    silent = np.zeros((count, len(OCTAVE_BANDS_HZ)))
    return SoundPaths(straight_m, towards, -towards, np.zeros(count), np.ones(count, dtype=np.bool_), silent)
