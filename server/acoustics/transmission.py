"""Transmission loss of walls: the mass law at field incidence.

Above the lowest resonances of a limp panel and below its coincidence frequency, the loss at normal incidence depends
only on mass: 10 log10(1 + (pi f m / (rho c))**2) (London, "Transmission of reverberant sound through single walls", J.
Res. NBS 42, 1949; Bies & Hansen, Engineering Noise Control, 4th ed., 2009, sec. 8.2.3). In rooms sound comes from all
angles up to 78 degrees and loses 5.5 dB less in octave or third-octave bands.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import power_to_db
from server.acoustics.geometry import FloorPlan, Points
from server.acoustics.reflections import Reflections

_Floats = npt.NDArray[np.float64]

AIR_IMPEDANCE = 1.204 * 343.0
"""Density times speed of sound at 20 C, Pa s/m."""
FIELD_INCIDENCE_DB = 5.5


def normal_incidence_loss_db(surface_mass_kg_m2: float, frequencies_hz: npt.ArrayLike) -> _Floats:
    """(...) dB >= 0, at normal incidence. Raises ValueError for a mass that is negative or not finite."""
    if not 0 <= surface_mass_kg_m2 < np.inf:
        raise ValueError("surface mass must be a number of kg/m2, zero or more")
    frequency = np.asarray(frequencies_hz, dtype=np.float64)
    return power_to_db(1 + (np.pi * frequency * surface_mass_kg_m2 / AIR_IMPEDANCE) ** 2)


def transmission_loss_db(surface_mass_kg_m2: float, frequencies_hz: npt.ArrayLike) -> _Floats:
    """(...) dB >= 0, at field incidence. Coincidence, at which stiff panels transmit more, is not modelled.

    Raises ValueError for a mass that is negative or not finite.
    """
    return np.maximum(0.0, normal_incidence_loss_db(surface_mass_kg_m2, frequencies_hz) - FIELD_INCIDENCE_DB)


def walls_between(plan: FloorPlan, a: Points, b: Points) -> npt.NDArray[np.int64]:
    """(...,) number of walls that the straight line between points inside (..., xyz) goes through. Everything outside
    the polygon is wall, and the line enters and leaves each."""
    a, b = np.broadcast_arrays(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64))
    start, along = plan.walls[:, 0], plan.walls[:, 1] - plan.walls[:, 0]
    p, step = a[..., None, :2], (b - a)[..., None, :2]
    across = step[..., 0] * along[:, 1] - step[..., 1] * along[:, 0]
    offset = start - p
    parallel = across == 0
    safe = np.where(parallel, 1.0, across)
    on_line = (offset[..., 0] * along[:, 1] - offset[..., 1] * along[:, 0]) / safe
    on_wall = (offset[..., 0] * step[..., 1] - offset[..., 1] * step[..., 0]) / safe
    crossed = ~parallel & (on_line > 0) & (on_line < 1) & (on_wall >= 0) & (on_wall < 1)
    return np.asarray(crossed.sum(axis=-1) // 2)


class PathFinder(Protocol):
    """An object that finds paths from emitters to a listener, such as `ReflectionFinder`."""

    def find(self, listener: npt.ArrayLike, emitters: npt.ArrayLike) -> Reflections: ...


class WallLosses(Protocol):
    """What the walls between a listener and emitters take from sound that goes straight through them."""

    def between(self, listener: npt.ArrayLike, emitters: npt.ArrayLike) -> tuple[npt.NDArray[np.bool_], _Floats]:
        """Return whether walls stand between that let sound through (n,), and what all of them take, in dB (n, band),
        for a listener (3,) and emitters (n, 3)."""


@dataclass(frozen=True)
class PlanWallLosses:
    """The walls of a floor plan, each of which takes `wall_loss_db` (band,)."""

    plan: FloorPlan
    wall_loss_db: _Floats

    def between(self, listener: npt.ArrayLike, emitters: npt.ArrayLike) -> tuple[npt.NDArray[np.bool_], _Floats]:
        """As `WallLosses.between` says."""
        walls = walls_between(self.plan, np.asarray(listener), np.asarray(emitters))
        return walls > 0, walls[:, None] * self.wall_loss_db


class TransmittedPaths:
    """Adds the straight paths through walls to the paths of a finder. Safe to share between threads if the finder
    is."""

    def __init__(self, finder: PathFinder, walls: WallLosses) -> None:
        self._finder = finder
        self._walls = walls

    def find(self, listener: npt.ArrayLike, emitters: npt.ArrayLike) -> Reflections:
        """Paths to `listener` (3,) from `emitters` (n, 3), ordered by emitter."""
        found = self._finder.find(listener, emitters)
        here, places = np.asarray(listener, dtype=np.float64), np.asarray(emitters, dtype=np.float64)
        through, losses_db = self._walls.between(here, places)
        hidden = np.flatnonzero(through)
        offset = places[hidden] - here
        length_m = np.linalg.norm(offset, axis=-1)  # a wall stands between: never zero
        arrival = offset / length_m[:, None]
        emitter = np.concatenate([found.emitter, hidden])
        order = np.argsort(emitter, kind="stable")
        return Reflections(
            emitter[order],
            np.concatenate([found.length_m, length_m])[order],
            np.concatenate([found.arrival, arrival])[order],
            np.concatenate([found.departure, -arrival])[order],
            np.concatenate([found.gain_db, -losses_db[hidden]])[order],
        )
