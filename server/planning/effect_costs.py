"""What effects cost on this host: renderers with and without each, side by side, for a fraction of a second.

Microseconds of one core, per block and emitter. Bytes per emitter. They are medians of rounds in which all take turns,
in time of the thread that measures, so that what else runs meanwhile counts little. Whoever measures beside streams
hands in `rest`, called every few milliseconds between what is timed, which may take a break.
"""

import statistics
import time
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import replace
from functools import lru_cache
from typing import Any, TypeVar

import numpy as np

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.directivity import CARDIOID
from server.acoustics.geometry import Pose
from server.acoustics.sound_path import SoundPathFinder
from server.field.field import AcousticField
from server.planning.planner import Cost, Costs
from server.rendering.convolver import FloatArray
from server.rendering.renderer import Renderer
from server.rendering.sources import ClipPlayer
from server.responses.direct_sound import DirectSound
from server.responses.effect_flags import EmitterEffects
from server.responses.emitter_state import EmitterState
from server.responses.full_response import kemar
from server.responses.ir_request import composed_irs
from server.responses.radiation import departure_gain_db
from server.scene.effects import EffectName

RESPONSES_PER_S = 30.0
"""Of an emitter that moves, or a listener."""

_EMITTERS = 4
_BLOCKS = 48
_ROUNDS = 5
_LONGEST_S = 0.25
_Key = TypeVar("_Key", bound=Hashable)

Rest = Callable[[], None]


def _no_rest() -> None:
    pass


class _Lane:
    """A renderer that plays emitters with some effects, of which some may be walked past."""

    def __init__(
        self,
        field: AcousticField,
        block_size: int,
        *,
        emitters: int = _EMITTERS,
        head: bool = True,
        response: bool = True,
        direct: bool = True,
        shared_tail: bool = False,
        moves: bool = False,
        exchanges: bool = False,
        distance: bool = True,
        air: bool = True,
        rest: Rest = _no_rest,
    ) -> None:
        manifest, rate = field.bundle.manifest, field.sample_rate
        channels = 2 if head else 1
        self._renderer = Renderer(
            block_size=block_size,
            ir_samples=field.ir_samples,
            sample_rate=rate,
            filters=kemar(rate),
            speed_of_sound=manifest.speed_of_sound,
            air_db_per_m=manifest.air.absorption_db_per_m,
            max_emitters=emitters,
            shared_tail=shared_tail,
            outputs=channels,
            has_head=head,
        )
        rng = np.random.default_rng(0)
        decay = 10 ** (-3 * np.arange(field.ir_samples) / field.ir_samples)
        self._names = [str(number) for number in range(emitters)]
        self._moves, self._block = moves, 0
        self._exchanged: list[FloatArray] = []
        self._blocks_per_response = max(1, round(rate / block_size / RESPONSES_PER_S))
        for name in self._names:
            clip = rng.standard_normal(rate).astype(np.float32)
            self._renderer.add_emitter(name, ClipPlayer(clip, loop=True), awaits_ir=response)
            if response:
                noise = (rng.standard_normal((channels, field.ir_samples)) * decay).astype(np.float32)
                self._renderer.set_ir(name, noise)
                if exchanges:
                    self._exchanged.append(noise)
            self._renderer.enable_direct(name, is_heard=direct, distance=distance, air=air)
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
        """A centimetre on, and a little turned, block by block."""
        self._block += 1
        count = len(self._names)
        angle = 0.02 * self._block + np.arange(count)
        arrivals = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=-1)
        lengths_m = 3 + np.sin(0.01 * self._block) + np.arange(count)
        self._renderer.set_paths(self._names, lengths_m, arrivals, np.zeros((count, len(OCTAVE_BANDS_HZ))))


@lru_cache(maxsize=16)
def measured_costs(field: AcousticField, block_size: int = 256) -> Costs:
    """Of a field's scene, measured once."""
    return measure_costs(field, block_size)


def measure_costs(field: AcousticField, block_size: int = 256, *, rest: Rest = _no_rest) -> Costs:
    """Of a field's scene, now: half a second of work, and longer where nothing is compiled yet."""
    made: dict[str, dict[str, Any]] = {
        "still": {},
        "without direct": {"direct": False},
        "one ear": {"head": False},
        "moving": {"moves": True},
        "without air": {"moves": True, "air": False},
        "without distance": {"moves": True, "distance": False},
    }
    if field.bundle.manifest.fields:
        made |= {
            "without response": {"response": False},
            "shared": {"shared_tail": True},
            "exchanging": {"exchanges": True},
        }
    else:
        made = {name: {**options, "response": False} for name, options in made.items()}
    lanes = {
        (name, count): _Lane(field, block_size, emitters=count, rest=rest, **options)
        for name, options in made.items()
        for count in (1, _EMITTERS)
    }
    us = _time_in_turns({key: lane.play for key, lane in lanes.items()}, per=_BLOCKS, rest=rest)
    responses_per_block = RESPONSES_PER_S * block_size / field.sample_rate
    late_us, early_us = _response_us(field, meanwhile=lanes["still", _EMITTERS].play, rest=rest)

    def between(more: str, less: str) -> tuple[float, float]:
        """Of each emitter, and of there being any."""
        one, all_ = (us[more, count] - us[less, count] for count in (1, _EMITTERS))
        each = max(0.0, (all_ - one) / (_EMITTERS - 1))
        return each, max(0.0, one - each)

    def bytes_between(more: str, less: str) -> int:
        most, least = (_bytes(lanes[name, _EMITTERS]) for name in (more, less))
        return max(0, most - least) // _EMITTERS

    def while_moving(more: str, less: str) -> Cost:
        each, first = between(more, less)
        return Cost(0.0, 0, moving_us=each, moving_first_us=first)

    finding = _finders(field)
    nothing = Cost(0.0, 0)
    direct_us, first_direct_us = between("still", "without direct")
    head_us, first_head_us = between("still", "one ear")
    following = while_moving("moving", "still")
    costs = dict.fromkeys(EffectName, nothing) | {
        EffectName.DIRECT_PATH: Cost(direct_us, 0, first_us=first_direct_us),
        EffectName.DISTANCE_ATTENUATION: while_moving("moving", "without distance"),
        EffectName.PROPAGATION_DELAY: replace(
            following, turning_us=following.moving_us, turning_first_us=following.moving_first_us
        ),
        EffectName.AIR_ABSORPTION: while_moving("moving", "without air"),
        # The path that is searched tells what its edges take, too: diffraction costs nothing beside it.
        EffectName.OCCLUSION: Cost(0.0, 0, moving_us=finding["occlusion"]),
        EffectName.DIRECTIVITY: Cost(0.0, 0, moving_us=finding["directivity"]),
        EffectName.HRTF: Cost(head_us, bytes_between("still", "one ear"), first_us=first_head_us),
        EffectName.EARLY_REFLECTIONS: Cost(0.0, 0, moving_us=early_us * responses_per_block),
    }
    if field.bundle.manifest.fields:
        late, tail = between("still", "without response"), between("still", "shared")
        exchange_us, first_exchange_us = between("exchanging", "still")
        response_us = late_us * responses_per_block + exchange_us
        costs |= {
            EffectName.LATE_REVERBERATION: Cost(
                late[0],
                bytes_between("still", "without response"),
                moving_us=response_us,
                first_us=late[1],
                moving_first_us=first_exchange_us,
            ),
            EffectName.PER_SOURCE_TAIL: Cost(tail[0], bytes_between("still", "shared"), first_us=tail[1]),
            # Responses of where one walks are of where one looks.
            EffectName.HEAD_ROTATION: Cost(0.0, 0, turning_us=response_us, turning_first_us=first_exchange_us),
        }
    return costs


def _bytes(thing: object, seen: set[int] | None = None) -> int:
    """Of all arrays that something holds, each once."""
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


def _finders(field: AcousticField) -> dict[str, float]:
    """Microseconds per emitter of what is computed of geometry for each pose."""
    bundle = field.bundle
    manifest = bundle.manifest
    listener, emitters = np.array(manifest.start.listener), np.tile(manifest.start.emitter, (_EMITTERS, 1))
    finder = SoundPathFinder(bundle.floor_plan, manifest.speed_of_sound)
    beam, departure = EmitterState(Pose((0.0, 0.0, 0.0)), CARDIOID), np.array([0.6, 0.8, 0.0])
    computed: dict[str, Callable[[], object]] = {
        "occlusion": lambda: finder.find(listener, emitters),
        "directivity": lambda: [departure_gain_db(beam, departure) for _ in range(_EMITTERS)],
    }
    return _time_in_turns(computed, per=_EMITTERS)


def _response_us(field: AcousticField, *, meanwhile: Callable[[], None], rest: Rest) -> tuple[float, float]:
    """What one response takes before it is made ready and faded in: of what the field holds, and of the first
    reflections. Between one and the next sound is rendered, as in streams, so that caches hold something else."""
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
            composed_irs(field, direct, listener, [EmitterState(Pose(start.emitter), effects=effects)])
            of_it.append(1e6 * (time.thread_time() - started_s))
        if turn and sum(map(sum, times_us.values())) > 1e6 * _LONGEST_S:
            break
    late_us, whole_us = (statistics.median(of_it[1:]) for of_it in times_us.values())
    return late_us, max(0.0, whole_us - late_us)


def _time_in_turns(lanes: dict[_Key, Callable[[], object]], *, per: int, rest: Rest = _no_rest) -> dict[_Key, float]:
    """Microseconds of each, divided by `per`; a first round warms up."""
    times_s: dict[_Key, list[float]] = {name: [] for name in lanes}
    for _ in range(_ROUNDS + 1):
        for name, lane in lanes.items():
            rest()
            started_s = time.thread_time()
            lane()
            times_s[name].append(time.thread_time() - started_s)
    return {name: 1e6 * statistics.median(times[1:]) / per for name, times in times_s.items()}
