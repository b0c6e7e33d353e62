"""The shortest paths through a floor plan in NumPy, for all emitters and corners at once."""

from dataclasses import fields

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import amplitude_to_db
from server.acoustics.diffraction import CLEAR_FRESNEL_NUMBER, GRAZING_LOSS_DB, SMALL_ARGUMENT
from server.acoustics.geometry import COINCIDENT_M, FloorPlan
from server.acoustics.sound_path import DescribedPaths, SoundPaths
from server.acoustics.sound_path_kernel import PENUMBRA_M, SOFTENED_M

Floats = npt.NDArray[np.float64]


def diffraction_gain_db(fresnel_number: npt.ArrayLike) -> Floats:
    """(...) gain in dB, 0 or less, for Fresnel numbers (...)."""
    number = np.asarray(fresnel_number, dtype=np.float64)
    x = np.sqrt(2 * np.pi * np.abs(np.maximum(number, CLEAR_FRESNEL_NUMBER)))
    safe = np.maximum(x, SMALL_ARGUMENT)
    bent = np.where(x < SMALL_ARGUMENT, 1.0, np.where(number > 0, safe / np.tanh(safe), safe / np.tan(safe)))
    return np.where(number > CLEAR_FRESNEL_NUMBER, np.minimum(0.0, -(GRAZING_LOSS_DB + amplitude_to_db(bent))), 0.0)


class NumpySoundPathFinder:
    """See `server.acoustics.sound_path.PlanPathFinder`."""

    def __init__(self, plan: FloorPlan, speed_of_sound: float) -> None:
        self._plan = plan
        self._wavelengths_m = speed_of_sound / np.asarray(OCTAVE_BANDS_HZ, dtype=np.float64)
        self._bends = plan.bend_corners
        self._bend_lengths_m = plan.bend_lengths_m

    def find(self, listener: npt.ArrayLike, emitters: npt.ArrayLike, into: SoundPaths | None = None) -> SoundPaths:
        listener, emitters = np.asarray(listener, np.float64), np.asarray(emitters, np.float64)
        paths = self._find(listener, emitters)
        if into is None:
            return paths
        for field in fields(SoundPaths):
            getattr(into, field.name)[...] = getattr(paths, field.name)
        return into

    def describe(self, listeners: npt.ArrayLike, emitters: npt.ArrayLike) -> DescribedPaths:
        pairs = zip(np.asarray(listeners, np.float64), np.asarray(emitters, np.float64), strict=True)
        lengths, described = zip(*(self._describe(*pair) for pair in pairs), strict=True)
        return DescribedPaths(np.array(lengths), np.array(described, dtype=np.float32))

    def _describe(self, listener: Floats, emitter: Floats) -> tuple[float, Floats]:
        here, there = listener[:2], emitter[:2]
        straight = level = float(np.linalg.norm(there - here))
        after, before = there, here
        if len(self._bends) and not self._plan.is_visible(listener, emitter):
            via = self._to_bends_m(listener)[:, None] + self._bend_lengths_m
            over = np.min(via, axis=0) + self._to_bends_m(emitter)
            last = int(np.argmin(over))
            if np.isfinite(over[last]):
                level, after, before = float(over[last]), self._bends[np.argmin(via[:, last])], self._bends[last]
        length = float(np.hypot(level, emitter[2] - listener[2]))
        sight = np.exp(min(0.0, straight - level) / PENUMBRA_M)
        legs = [leg / (np.linalg.norm(leg) + SOFTENED_M) for leg in (after - here, before - there)]
        return length, np.concatenate([[length, sight], *legs])

    def _find(self, listener: Floats, emitters: Floats) -> SoundPaths:
        offset = emitters - listener
        rise, straight = offset[:, 2], np.linalg.norm(offset, axis=-1)
        coincident = straight < COINCIDENT_M
        towards = np.where(coincident[:, None], (1.0, 0.0, 0.0), offset / np.where(coincident, 1.0, straight)[:, None])
        if not len(self._bends):
            count = len(emitters)
            silent = np.zeros((count, len(OCTAVE_BANDS_HZ)))
            return SoundPaths(straight, towards, -towards, np.zeros(count), np.ones(count, dtype=np.bool_), silent)

        from_listener, from_emitters = self._to_bends_m(listener), self._to_bends_m(emitters)
        via = from_listener[:, None] + self._bend_lengths_m
        first, to_bend = np.argmin(via, axis=0), np.min(via, axis=0)
        last = np.argmin(to_bend + from_emitters, axis=-1)
        around = np.min(to_bend + from_emitters, axis=-1)
        in_sight = self._plan.is_visible(listener, emitters) | ~np.isfinite(around)
        around = np.where(in_sight, 1.0, around)
        length = np.where(in_sight, straight, np.hypot(around, rise))
        excess = np.where(in_sight, 0.0, np.maximum(0.0, length - straight))

        def leg(points: Floats, bends: npt.NDArray[np.intp], climb: Floats) -> Floats:
            plan = self._bends[bends] - points[..., :2]
            apart = np.linalg.norm(plan, axis=-1)
            level = around / np.where(apart < COINCIDENT_M, 1.0, apart)
            unfolded = np.concatenate([plan * level[:, None], climb[:, None]], axis=-1)
            return np.asarray(unfolded / np.hypot(around, climb)[:, None])

        arrival = np.where(in_sight[:, None], towards, leg(listener, first[last], rise))
        departure = np.where(in_sight[:, None], -towards, leg(emitters, last, -rise))
        detour = np.where(in_sight, -self._clearance_m(listener, emitters, from_listener), excess)
        return SoundPaths(
            length, arrival, departure, excess, in_sight, diffraction_gain_db(2 * detour[:, None] / self._wavelengths_m)
        )

    def _to_bends_m(self, points: Floats) -> Floats:
        """(..., corner) distance in plan to each corner in sight, infinite to others and to one that is here."""
        level = np.concatenate([self._bends, np.zeros((len(self._bends), 1))], axis=-1)
        distance = np.linalg.norm(points[..., None, :2] - self._bends, axis=-1)
        reached = self._plan.is_visible(points[..., None, :], level) & (distance >= COINCIDENT_M)
        return np.where(reached, distance, np.inf)

    def _clearance_m(self, listener: Floats, emitters: Floats, from_listener: Floats) -> Floats:
        """(n,) how much farther than the straight line it is over the nearest corner, for emitters in sight."""
        from_emitters = np.linalg.norm(emitters[:, None, :2] - self._bends, axis=-1)
        seen = np.isfinite(from_listener) & (from_emitters >= COINCIDENT_M)
        from_listener = np.where(seen, from_listener, 1.0)
        ahead = -np.sum((listener[:2] - self._bends) * (emitters[:, None, :2] - self._bends), axis=-1)
        cosine = np.where(seen, ahead, 0.0) / (from_listener * np.where(seen, from_emitters, 1.0))
        offset = emitters - listener
        longer = np.hypot(from_listener + from_emitters, offset[:, 2:]) - np.linalg.norm(offset, axis=-1)[:, None]
        detour = np.maximum(0.0, longer) / np.where(cosine > 0, cosine, 1.0)
        return np.asarray(np.min(np.where(cosine > 0, detour, np.inf), axis=-1, initial=np.inf))
