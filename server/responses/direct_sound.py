"""The paths of the direct sound in a scene. Renderers follow them (`server.streaming.direct_path_tracker`), and
responses include the direct sound of emitters at rest. Where a scene computes first reflections from geometry, they are
here too.

Lengths are in metres; positions and directions are in the world's axes.
"""

import copy
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Generic, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import amplitude_to_db, db_to_amplitude
from server.acoustics.directivity import OMNIDIRECTIONAL
from server.acoustics.geometry import FloorPlan, Pose
from server.acoustics.sound_path import PlanPathFinder, SoundPathFinder, SoundPaths
from server.acoustics.surroundings import Surroundings
from server.field.field import AcousticField
from server.rendering.direct_path import NEAR_LIMIT_M
from server.rendering.head_decoder import HeadDecoder
from server.rendering.hrtf import HeadFilters, NoHead
from server.rendering.limiter import CEILING
from server.rendering.renderer import Renderer
from server.rendering.still_paths import StillPaths
from server.responses.binaural import Binauralization
from server.responses.early_reflections import EarlyReflections
from server.responses.emitter_state import EmitterState
from server.responses.radiation import departure_gain_db, reverberation_gain
from server.scene.bundle import Bundle

_Floats = npt.NDArray[np.float64]
Key = TypeVar("Key")

_SILENT_DB = -100.0
_IN_THE_OPEN = FloorPlan(((0.0, 0.0), (1.0, 0.0), (0.0, 1.0)), 1.0)
"""A floor plan without a corner to bend round: every path is straight."""


class FoundPaths(NamedTuple):
    """Paths from n emitters: lengths (n,), directions of arrival (n, 3), and gains (n, band) in dB without distance and
    air."""

    length_m: _Floats
    arrival: _Floats
    gain_db: _Floats


class PathBatch(Generic[Key]):
    """Paths from emitters that share a path finder, valid as long as the emitters and their states stay the same."""

    def __init__(self, finder: SoundPathFinder, emitters: Sequence[tuple[Key, EmitterState]]) -> None:
        self.keys = [key for key, _ in emitters]
        self._finder = finder
        self._places = np.array([emitter.pose.position for _, emitter in emitters])
        self._paths = SoundPaths.empty(len(emitters))
        self._unbent = [row for row, (_, emitter) in enumerate(emitters) if not emitter.effects.diffraction]
        self._beaming = [
            (row, emitter) for row, (_, emitter) in enumerate(emitters) if emitter.directivity is not OMNIDIRECTIONAL
        ]
        gains = dict.fromkeys(gain for _, emitter in emitters for gain in emitter.effects.path_gains)
        self._gains = [
            (gain, [row for row, (_, emitter) in enumerate(emitters) if gain in emitter.effects.path_gains])
            for gain in gains
        ]

    def find(self, listener: Pose) -> FoundPaths:
        """Find the paths to a listener, in the order of `keys`. The arrays are reused by the next call."""
        paths = self._finder.find(np.array(listener.position), self._places, self._paths)
        more_db = [(rows, gain_of(paths)[rows]) for gain_of, rows in self._gains]
        gain_db = paths.screen_db
        for row in self._unbent:
            gain_db[row] = 0.0 if paths.in_sight[row] else _SILENT_DB
        for row, emitter in self._beaming:
            gain_db[row] += departure_gain_db(emitter, paths.departure[row])
        for rows, row_db in more_db:
            gain_db[rows] += row_db
        return FoundPaths(paths.length_m, paths.arrival, gain_db)


class DirectSound:
    """The direct sound in one scene, through one head or, with an `order`, as ambisonic channels in world axes;
    `air_db_per_m` has a value for each
    octave band, and may have one for the octave above.

    Everything here is at the sample rate of `filters`, that of a stream. `field_filters` are the same head at the rate
    of the scene's fields; by default they are `filters`.

    `early_reflections` are computed here if the responses of the scene's fields leave them out; otherwise None. If the
    fields include the direct sound, a renderer has none to add and there are no `filters`; if those fields are also
    mono, `binauralization` renders them for the listener's ears, at the fields' own rate. `field_gain` is the linear
    factor from the fields' responses to unit pressure at one metre from an emitter.
    """

    def __init__(
        self,
        surroundings: Surroundings,
        *,
        speed_of_sound: float,
        air_db_per_m: npt.NDArray[np.float64],
        filters: HeadFilters | None,
        early_reflections: EarlyReflections | None = None,
        early_without_head: EarlyReflections | None = None,
        binauralization: Binauralization | None = None,
        field_gain: float = 1.0,
        order: int | None = None,
        field_filters: HeadFilters | None = None,
    ) -> None:
        self.early_reflections = early_reflections
        self.early_without_head = early_without_head
        self.binauralization = binauralization
        self.field_gain = field_gain
        self.order = order
        self._finder = surroundings.sound_paths(speed_of_sound)
        self._straight = PlanPathFinder(_IN_THE_OPEN, speed_of_sound)
        self._speed_of_sound = speed_of_sound
        self._air_db_per_m = air_db_per_m
        self._filters = filters
        self._field_filters = filters if field_filters is None else field_filters

    @classmethod
    def of(
        cls,
        bundle: Bundle,
        filters: HeadFilters,
        *,
        order: int | None = None,
        field_filters: HeadFilters | None = None,
    ) -> "DirectSound":
        """The direct sound at the rate of `filters`. Where that is not the scene's, `field_filters` are those of the
        same head at the scene's rate."""
        manifest = bundle.manifest
        return cls(
            bundle.surroundings,
            speed_of_sound=manifest.speed_of_sound,
            air_db_per_m=manifest.air.filter_db_per_m,
            filters=filters if manifest.direct_sound == "geometry" else None,
            early_reflections=EarlyReflections.of(bundle, filters),
            early_without_head=EarlyReflections.of(bundle, NoHead(filters.sample_rate)),
            binauralization=Binauralization.of(bundle, filters if field_filters is None else field_filters),
            field_gain=float(db_to_amplitude(-manifest.reference_level_db)),
            order=order,
            field_filters=field_filters,
        )

    def within(self, surroundings: Surroundings) -> "DirectSound":
        """The same in other surroundings of the same materials: where doors have moved."""
        moved = copy.copy(self)
        moved._finder = surroundings.sound_paths(self._speed_of_sound)
        for name in ("early_reflections", "early_without_head"):
            early: EarlyReflections | None = getattr(self, name)
            setattr(moved, name, None if early is None else early.within(surroundings))
        return moved

    def renderer(
        self,
        *,
        block_size: int,
        ir_samples: int,
        sample_rate: int,
        max_emitters: int,
        shared_tail: bool = False,
        switches_tail: bool = False,
        outputs: int = 2,
        has_head: bool = True,
        buses: Iterable[int] = (),
    ) -> Renderer:
        """`buses` are the orders of ambisonic responses that the head may hear by a bus."""
        decoders = []
        if self._filters is not None and self.order is None:
            decoders = [HeadDecoder.of(self._filters, order) for order in buses]
        # guard: a session's sound is limited
        return Renderer(
            block_size=block_size,
            ir_samples=ir_samples,
            sample_rate=sample_rate,
            filters=self._filters,
            speed_of_sound=self._speed_of_sound,
            air_db_per_m=self._air_db_per_m,
            max_emitters=max_emitters,
            shared_tail=shared_tail,
            switches_tail=switches_tail,
            ceiling=CEILING,
            outputs=outputs,
            has_head=has_head,
            order=self.order,
            decoders=decoders,
        )

    def heard(self, field: AcousticField, channels: int) -> AcousticField:
        """The field heard through the head of this direct sound or, for more channels than two, as ambisonic ones."""
        if channels > 2:
            return field.encoded(round(channels**0.5) - 1)
        return field if self._filters is None or self._field_filters is None else field.through(self._field_filters)

    def early(self, channels: int) -> EarlyReflections | None:
        """The first reflections for two ears, for one channel without a head, or for ambisonic channels."""
        return self.early_reflections if channels == 2 else self.early_without_head

    def add(self, responses: npt.NDArray[np.float32], listener: Pose, emitters: Sequence[EmitterState]) -> None:
        """Add the direct sound of each emitter at `listener` to its response (B, channel, sample), for emitters whose
        direct sound is baked into the response; sample 0 is emission.

        A renderer multiplies these responses by the emitter's `reverberation_gain`, which is divided out here.
        """
        if self._filters is None:
            return
        listener = self.axes_for(listener, responses.shape[1])
        for ways in self.ways_from(enumerate(emitters)):
            for row, length_m, arrival, gain_db in zip(ways.keys, *ways.find(listener), strict=True):
                emitter = emitters[row]
                effects = emitter.effects
                gain = gain_db - amplitude_to_db(reverberation_gain(emitter.directivity))
                if not effects.distance_attenuation:
                    gain = gain + amplitude_to_db(max(length_m, NEAR_LIMIT_M))
                still = self._still(responses.shape[1], has_air=effects.air_absorption)
                still.add(
                    np.array([length_m]), arrival[np.newaxis], gain[np.newaxis], listener.orientation, responses[row]
                )

    @staticmethod
    def axes_for(listener: Pose, channels: int) -> Pose:
        """The pose whose axes responses have: the listener's, or for ambisonic channels those of the world."""
        return listener if channels <= 2 else Pose(listener.position)

    @property
    def is_heard_apart(self) -> bool:
        """Whether the direct sound is rendered apart from the fields' responses."""
        return self._filters is not None

    @property
    def leaves_field_as_it_is(self) -> bool:
        """Whether the field's responses to ears are heard as the field gives them."""
        return self.binauralization is None and self.field_gain == 1.0

    def ways_from(self, emitters: Iterable[tuple[Key, EmitterState]]) -> list["PathBatch[Key]"]:
        """Return path batches for emitters, each given with a key. Paths of emitters with occlusion may bend round
        corners; those of the others are straight."""
        hidden: list[tuple[Key, EmitterState]] = []
        open_: list[tuple[Key, EmitterState]] = []
        for each in emitters:
            (hidden if each[1].effects.occlusion else open_).append(each)
        return [PathBatch(finder, some) for finder, some in ((self._finder, hidden), (self._straight, open_)) if some]

    def _still(self, channels: int, *, has_air: bool) -> StillPaths:
        return self._still_paths[channels == 2][has_air]

    @cached_property
    def _still_paths(self) -> tuple[tuple[StillPaths, StillPaths], tuple[StillPaths, StillPaths]]:
        """Renderers of resting paths without a head and for two ears, each without air absorption and with it."""
        assert self._filters is not None
        airless = np.zeros_like(self._air_db_per_m)
        one, two = (
            tuple(
                StillPaths(ears, speed_of_sound=self._speed_of_sound, air_db_per_m=air)
                for air in (airless, self._air_db_per_m)
            )
            for ears in (NoHead(self._filters.sample_rate), self._filters)
        )
        return (one[0], one[1]), (two[0], two[1])
