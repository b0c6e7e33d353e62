"""A scene's first reflections as part of impulse responses: paths by way of one wall, the floor or the ceiling.

They arrive a few milliseconds after the direct sound and interfere with it. Their phase changes with the poses faster
than a field can follow, and geometry gives it exactly. They are computed here for scenes whose manifest leaves them out
of the field (`image_order` 1).

A reflection appears or vanishes when the listener passes the end of a wall. That makes no click: it is part of an
impulse response, and impulse responses are crossfaded.

Axes: B poses; responses (B, ear, sample). Lengths are in metres; positions and directions are in the world's axes.
"""

import copy
import itertools
import math
from collections.abc import Hashable, Sequence

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import amplitude_to_db, db_to_power
from server.acoustics.directivity import OMNIDIRECTIONAL
from server.acoustics.geometry import Pose
from server.acoustics.surroundings import Surroundings
from server.core.bounded_cache import BoundedCache
from server.rendering.direct_path import NEAR_LIMIT_M
from server.rendering.fractional_delay import TAPS
from server.rendering.hrtf import HeadFilters, NoHead
from server.rendering.still_paths import StillPaths
from server.responses.emitter_state import EmitterState
from server.responses.radiation import departure_gain_db, reverberation_gain
from server.scene.bundle import Bundle
from server.scene.geometry import Material
from server.scene.surfaces import mirror_gains_db, wall_losses_db

_Floats = npt.NDArray[np.float64]
_Paths = tuple[_Floats, _Floats, _Floats]
_KEPT_PAIRS = 256
"""Pairs of listener and emitter whose paths are kept, at most some 6 kB each."""


class EarlyReflections:
    """First reflections in one scene, through one head. `air_db_per_m` has a value for each octave band, and may have
    one for the octave above. Safe to share between threads.

    Without a head, responses have one channel, or several ambisonic ones in the axes of the listener.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        surfaces: Sequence[Material],
        *,
        speed_of_sound: float,
        air_db_per_m: _Floats,
        filters: HeadFilters | NoHead,
        transmission: bool = False,
    ) -> None:
        """`surfaces` are the materials of the surroundings. With `transmission`, sound that goes straight through
        walls, attenuated by their mass, is added as well."""
        self.filters = filters
        self._gains_and_losses_db = mirror_gains_db(surfaces), wall_losses_db(surfaces) if transmission else None
        self._finder = surroundings.first_reflections(*self._gains_and_losses_db)
        # Each of the two legs of a path is at most as long as the diagonal of the place.
        low, high = surroundings.bounds_m
        longest_s = 2 * math.hypot(*(high - low)) / speed_of_sound
        self.end_samples = math.ceil((longest_s + filters.longest_delay_s) * filters.sample_rate) + filters.taps + TAPS
        """The sample of a response from which on it contains no reflection."""
        self._air_db_per_m = air_db_per_m
        self._kept = _new_cache()
        self._paths = StillPaths(filters, speed_of_sound=speed_of_sound, air_db_per_m=air_db_per_m)

    @classmethod
    def of(cls, bundle: Bundle, filters: HeadFilters | NoHead) -> "EarlyReflections | None":
        """Return the first reflections of a bundle's scene; None if the responses of its fields include them."""
        manifest = bundle.manifest
        if manifest.image_order == 0 or bundle.surfaces is None:
            return None
        return cls(
            bundle.surroundings,
            bundle.surfaces,
            speed_of_sound=manifest.speed_of_sound,
            air_db_per_m=manifest.air.filter_db_per_m,
            filters=filters,
            transmission=manifest.transmission,
        )

    def within(self, surroundings: Surroundings) -> "EarlyReflections":
        """The same in other surroundings, as large and of the same materials: where doors have moved."""
        moved = copy.copy(self)
        moved._finder = surroundings.first_reflections(*self._gains_and_losses_db)
        moved._kept = _new_cache()
        return moved

    def add(
        self,
        responses: npt.NDArray[np.float32],
        listener: Pose,
        emitters: Sequence[EmitterState],
        *,
        remember: bool = False,
    ) -> None:
        """Add the first reflections of each emitter at `listener` to its response (B, channel, sample); sample 0 is
        emission. With `remember`, paths are kept for when the head turns and nothing else moves.

        A renderer multiplies these responses by the emitter's `reverberation_gain`, which is right for diffuse sound.
        Here it is divided out, and each path has the gain of its own direction.
        """
        find = self._remembered if remember else self.paths
        for response, paths in zip(responses, find(listener, emitters), strict=True):
            self._paths.add(*paths, listener.orientation, response)

    def paths(self, listener: Pose, emitters: Sequence[EmitterState]) -> list[_Paths]:
        """For each emitter the n paths that `add` adds: lengths (n,), arrivals (n, 3), and gains (n, band) in dB
        without distance and air."""
        found = self._finder.find(listener.position, [emitter.pose.position for emitter in emitters])
        starts = _starts(found.emitter, len(emitters))
        parts = [slice(start, stop) for start, stop in itertools.pairwise(starts)]
        for emitter, part in zip(emitters, parts, strict=True):
            if emitter.directivity == OMNIDIRECTIONAL:
                continue
            played_db = amplitude_to_db(reverberation_gain(emitter.directivity))
            for gain_db, departure in zip(found.gain_db[part], found.departure[part], strict=True):
                gain_db += departure_gain_db(emitter, departure) - played_db
        return [(found.length_m[part], found.arrival[part], found.gain_db[part]) for part in parts]

    def _remembered(self, listener: Pose, emitters: Sequence[EmitterState]) -> list[_Paths]:
        keys = [(listener.position, *_departure_of(emitter)) for emitter in emitters]
        known = [self._kept.get(key) for key in keys]
        missing = [row for row, paths in enumerate(known) if paths is None]
        if missing:
            found = self.paths(listener, [emitters[row] for row in missing])
            for row, paths in zip(missing, found, strict=True):
                known[row] = paths
                self._kept.put(keys[row], paths if len(missing) == 1 else _copied(paths), 1)
        return [paths for paths in known if paths is not None]

    def band_power(self, listeners: _Floats, emitter: npt.ArrayLike) -> _Floats:
        """Return the squared pressure (B, band) of the reflections at `listeners` (B, 3) from one omnidirectional
        emitter (3,)."""
        # A path is the same in both directions, and here many listeners share one emitter.
        found = self._finder.find(emitter, listeners)
        air_db_per_m = self._air_db_per_m[: len(OCTAVE_BANDS_HZ)]
        levels_db = found.gain_db - found.length_m[:, None] * air_db_per_m
        power = np.zeros((len(listeners), levels_db.shape[-1]))
        spread = np.maximum(found.length_m, NEAR_LIMIT_M)[:, None] ** 2
        np.add.at(power, found.emitter, db_to_power(levels_db) / spread)
        return power


def _departure_of(emitter: EmitterState) -> tuple[Hashable, ...]:
    """What of an emitter decides how its sound departs."""
    pose, directivity = emitter.pose, emitter.directivity
    return (pose.position,) if directivity is OMNIDIRECTIONAL else (pose.position, pose.orientation, directivity)


def _new_cache() -> BoundedCache[Hashable, _Paths]:
    return BoundedCache(_KEPT_PAIRS)


def _copied(paths: _Paths) -> _Paths:
    """The same paths in arrays of their own, so that no larger ones are kept."""
    length_m, arrival, gain_db = paths
    return length_m.copy(), arrival.copy(), gain_db.copy()


def _starts(emitter: npt.NDArray[np.int64], count: int) -> Sequence[int]:
    """(count + 1,) the number of the first path of each emitter, and that of all paths. `emitter` is that of each path,
    in ascending order."""
    if count == 1:  # as most often, and a search takes as long as finding the paths
        return (0, len(emitter))
    starts: list[int] = np.searchsorted(emitter, np.arange(count + 1)).tolist()
    return starts
