"""What effects cost on this host, measured in a fraction of a second with renderers with and without each effect.

Results are microseconds of one core per block and emitter, and bytes per emitter. They are medians of rounds in which
all renderers take turns, in CPU time of the measuring thread, so that other load has little influence. A caller that
measures beside running streams passes `rest`: it is called every few milliseconds between timed sections, and may
pause.
"""

import statistics
import time
from collections import deque
from collections.abc import Callable, Hashable
from functools import lru_cache
from typing import TypeVar

import numpy as np

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import Pose
from server.acoustics.spherical_harmonics import harmonic_count
from server.field.field import AcousticField
from server.planning.catalogue import CATALOGUE
from server.planning.cost import STILL, Costs, Measured, Variant, variants_of
from server.rendering.convolver import FloatArray
from server.rendering.head_decoder import HeadDecoder
from server.rendering.hrtf import kemar
from server.rendering.renderer import Renderer
from server.rendering.sources import ClipPlayer
from server.responses.direct_sound import DirectSound
from server.responses.effect_flags import EmitterEffects
from server.responses.emitter_state import EmitterState
from server.responses.ir_request import composed_irs

RESPONSES_PER_S = 30.0
"""New responses per second while the emitter or the listener moves."""

_EMITTERS = 4
_BLOCKS = 48
_ROUNDS = 5
_LONGEST_S = 0.25
_Key = TypeVar("_Key", bound=Hashable)

Rest = Callable[[], None]


def _no_rest() -> None:
    pass


class _Lane:
    """A renderer that plays emitters with the effects of a variant."""

    def __init__(
        self, field: AcousticField, block_size: int, variant: Variant, *, emitters: int, rest: Rest = _no_rest
    ) -> None:
        manifest, rate = field.bundle.manifest, field.sample_rate
        effects, channels, bus = variant.effects, _channels(field, variant), field.level.bus
        self._renderer = Renderer(
            block_size=block_size,
            ir_samples=field.ir_samples,
            sample_rate=rate,
            filters=kemar(rate),
            speed_of_sound=manifest.speed_of_sound,
            air_db_per_m=manifest.air.filter_db_per_m,
            max_emitters=emitters,
            shared_tail=not variant.shared.own_tails,
            outputs=variant.shared.channels,
            has_head=variant.shared.head,
            decoders=() if bus is None else [HeadDecoder.of(kemar(rate), bus)],
        )
        self._renderer.set_channels(channels)
        rng = np.random.default_rng(0)
        decay = 10 ** (-3 * np.arange(field.ir_samples) / field.ir_samples)
        self._names = [str(number) for number in range(emitters)]
        self._moves, self._block = variant.moves, 0
        self._exchanged: list[FloatArray] = []
        self._blocks_per_response = max(1, round(rate / block_size / RESPONSES_PER_S))
        for name in self._names:
            clip = rng.standard_normal(rate).astype(np.float32)
            self._renderer.add_emitter(name, ClipPlayer(clip, loop=True), awaits_ir=effects.late)
            if effects.late:
                noise = (rng.standard_normal((channels, field.ir_samples)) * decay).astype(np.float32)
                self._renderer.set_ir(name, noise)
                if variant.exchanges:
                    self._exchanged.append(noise)
            self._renderer.enable_direct(
                name,
                is_heard=effects.direct_path,
                distance=effects.distance_attenuation,
                air=effects.air_absorption,
            )
            rest()
        self._walk()

    def play(self) -> None:
        for block in range(_BLOCKS):
            if self._moves:
                self._walk()
            if block % self._blocks_per_response == 0:
                for name, response in zip(self._names, self._exchanged, strict=False):
                    self._renderer.set_ir(name, self._renderer.prepare(response))
            self._renderer.process()

    def _walk(self) -> None:
        """Move all paths by about a centimetre and turn them a little, once per block."""
        self._block += 1
        count = len(self._names)
        angle = 0.02 * self._block + np.arange(count)
        arrivals = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=-1)
        lengths_m = 3 + np.sin(0.01 * self._block) + np.arange(count)
        self._renderer.set_paths(self._names, lengths_m, arrivals, np.zeros((count, len(OCTAVE_BANDS_HZ))))


def _channels(field: AcousticField, variant: Variant) -> int:
    """Return the number of channels of responses at the field's level."""
    bus = field.level.bus
    return variant.shared.channels if bus is None or not variant.shared.head else harmonic_count(bus)


@lru_cache(maxsize=16)
def measured_costs(field: AcousticField, block_size: int = 256) -> Costs:
    """Return the costs in a field's scene, at the field's level, measured once."""
    return measure_costs(field, block_size)


def measure_costs(field: AcousticField, block_size: int = 256, *, rest: Rest = _no_rest) -> Costs:
    """Measure the costs in a field's scene, at the field's level: half a second of work, and longer in the first run of
    all."""
    has_field = bool(field.bundle.manifest.fields)
    variants = variants_of([effect.costs_in for effect in CATALOGUE.values() if effect.costs_in], has_field=has_field)
    lanes = {
        (variant, count): _Lane(field, block_size, variant, emitters=count, rest=rest)
        for variant in variants
        for count in (1, _EMITTERS)
    }
    us = _time_in_turns({key: lane.play for key, lane in lanes.items()}, per=_BLOCKS, rest=rest)
    still = STILL if has_field else STILL.without_responses()
    late_us, early_us = _response_us(field, meanwhile=lanes[still, _EMITTERS].play, rest=rest)
    works = {
        name: effect.per_pose(field.bundle, _EMITTERS)
        for name, effect in CATALOGUE.items()
        if effect.per_pose is not None
    }
    measured = Measured(
        emitters=_EMITTERS,
        us=us,
        memory_bytes={variant: _bytes(lanes[variant, _EMITTERS]) for variant in variants},
        per_pose_us=_time_in_turns(works, per=_EMITTERS),
        late_us=late_us,
        early_us=early_us,
        responses_per_block=RESPONSES_PER_S * block_size / field.sample_rate,
        has_field=has_field,
        has_bus=field.level.bus is not None,
    )
    return {name: effect.cost(measured) for name, effect in CATALOGUE.items()}


def _bytes(thing: object, seen: set[int] | None = None) -> int:
    """Return the bytes of all arrays that an object refers to, each counted once."""
    seen = set() if seen is None else seen
    if id(thing) in seen:
        return 0
    seen.add(id(thing))
    match thing:
        case np.ndarray():
            return _bytes(thing.base, seen) if isinstance(thing.base, np.ndarray) else thing.nbytes
        case dict():
            return sum(_bytes(each, seen) for each in thing.values())
        case list() | tuple() | set() | deque():
            return sum(_bytes(each, seen) for each in thing)
        case _ if type(thing).__module__.startswith("server."):
            return sum(_bytes(each, seen) for each in vars(thing).values())
        case _:
            return 0


def _response_us(field: AcousticField, *, meanwhile: Callable[[], None], rest: Rest) -> tuple[float, float]:
    """Return the times to compute the two parts of a response: the field's, and the first reflections. Blocks are
    rendered between two responses, as in streams, so that caches hold other data."""
    start = field.bundle.manifest.start
    direct = DirectSound.of(field.bundle, kemar(field.sample_rate))
    times_us: dict[bool, list[float]] = {False: [], True: []}
    for turn in range(_ROUNDS + 1):
        listener = Pose.from_yaw(start.listener, 0.1 * turn)
        for has_early, of_it in times_us.items():
            effects = EmitterEffects(early=has_early, late=bool(field.bundle.manifest.fields))
            rest()
            meanwhile()
            started_s = time.thread_time()
            emitter = EmitterState(Pose(start.emitter), effects=effects)
            composed_irs(field, direct, listener, [emitter], _channels(field, STILL))
            of_it.append(1e6 * (time.thread_time() - started_s))
        if turn and sum(map(sum, times_us.values())) > 1e6 * _LONGEST_S:
            break
    late_us, whole_us = (statistics.median(of_it[1:]) for of_it in times_us.values())
    return late_us, max(0.0, whole_us - late_us)


def _time_in_turns(lanes: dict[_Key, Callable[[], object]], *, per: int, rest: Rest = _no_rest) -> dict[_Key, float]:
    """Return the microseconds of each lane, divided by `per`; a first round warms up."""
    times_s: dict[_Key, list[float]] = {name: [] for name in lanes}
    for _ in range(_ROUNDS + 1):
        for name, lane in lanes.items():
            rest()
            started_s = time.thread_time()
            lane()
            times_s[name].append(time.thread_time() - started_s)
    return {name: 1e6 * statistics.median(times[1:]) / per for name, times in times_s.items()}
