"""The cost of quality levels: milliseconds per pose on one core, microseconds per block, memory and storage."""

import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import psutil

from server.acoustics.geometry import Pose
from server.acoustics.spherical_harmonics import harmonic_count
from server.bench.machine import processor
from server.core.bounded_cache import BoundedCache
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.field.node_responses import NODE_CACHE_BYTES, NodeCache
from server.rendering.hrtf import HeadFilters, kemar
from server.rendering.renderer import Renderer
from server.rendering.sources import ClipPlayer
from server.responses.direct_sound import DirectSound
from server.responses.emitter_state import EmitterState
from server.responses.ir_request import composed_irs
from server.scene.bundle import Bundle
from server.scene.manifest import Cost, QualityLevel
from server.streaming.calibration import Listener
from training.frontier.walk import POSES_PER_S, walk

SEGMENT_S = 5
_FEW_POSES = 12
_SEGMENTS_OF_MISSES = 12
_WARM_UP = 3
_TURN_RAD = math.radians(30)
_EMITTERS = 4
_BLOCKS = 48
_ROUNDS = 5


@contextmanager
def one_core() -> Iterator[None]:
    """Restricts the process to one of its cores, if the system allows it."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


@dataclass(frozen=True)
class Times:
    """Milliseconds: `walk` (pose,) on a walk that begins with an empty cache, `miss` (pose,) for poses that are not in
    the cache, and `turn` (pose,) for a head that has only turned. `block_us` is microseconds per block and emitter;
    `kept_mb` is the final size of the cache."""

    walk: npt.NDArray[np.float64]
    miss: npt.NDArray[np.float64]
    turn: npt.NDArray[np.float64]
    block_us: float
    kept_mb: float


def measure(
    levels: FieldsByLevel,
    *,
    walk_s: float,
    budget_s: float,
    seed: int = 0,
    advance: Callable[[], None] = lambda: None,
) -> dict[str, Times]:
    """The time per pose at each level, on a walk of `walk_s` through the scene.

    The time is the CPU time of this thread, which does all the computing, so that other processes have little
    influence. The levels take turns, a few seconds each: changes of the machine's speed then affect all levels, and
    each level finds its data in the processor's caches, as in a stream. For a level that computes every response anew,
    all poses take the same time. It computes the first few poses of each segment, and none after its `budget_s`, but at
    least three segments.
    """
    poses = walk(levels.bundle, duration_s=walk_s, seed=seed)
    filters = kemar(levels.default.sample_rate)
    listeners = {name: _alone(field, filters) for name, field in levels.items()}
    times: dict[str, list[float]] = {name: [] for name in levels}
    misses: dict[str, list[float]] = {name: [] for name in levels}
    turns: dict[str, list[float]] = {name: [] for name in levels}
    for listener in listeners.values():
        for pose in poses[:_WARM_UP]:
            listener.time_ms(pose)
        listener.forget()
    rng = np.random.default_rng(seed)
    segment = SEGMENT_S * POSES_PER_S
    starts = range(0, len(poses), segment)
    for start in starts:
        for name in rng.permutation(list(levels)):
            listener = listeners[name]
            if levels[name].kind.reuses_responses:
                times[name] += [listener.time_ms(pose) for pose in poses[start : start + segment]]
            elif math.fsum(times[name]) <= 1000 * budget_s or start < 3 * segment:
                times[name] += [listener.time_ms(pose) for pose in poses[start : start + _FEW_POSES]]
            pose = poses[start]
            listener.time_ms(pose)
            turns[name].append(listener.time_ms(Pose.from_yaw(pose.position, pose.yaw + _TURN_RAD)))
        advance()
    kept_mb = {name: listener.kept_bytes / 1e6 for name, listener in listeners.items()}
    for start in starts[:: len(starts) // _SEGMENTS_OF_MISSES or 1]:
        for name, level in levels.items():
            if level.kind.reuses_responses:
                for pose in poses[start : start + _FEW_POSES]:
                    listeners[name].forget()
                    misses[name].append(listeners[name].time_ms(pose))
    block_us = _block_us(levels, filters)
    return {
        name: Times(
            np.array(times[name]),
            np.array(misses[name] or times[name]),
            np.array(turns[name]),
            block_us[name],
            kept_mb[name],
        )
        for name in levels
    }


def _block_us(levels: FieldsByLevel, filters: HeadFilters) -> dict[str, float]:
    """Microseconds per block and emitter of streams of `_EMITTERS` emitters, at rest; levels take turns."""
    streams = {name: _at_rest(field, filters) for name, field in levels.items()}
    times_s: dict[str, list[float]] = {name: [] for name in levels}
    for _ in range(_ROUNDS + 1):
        for name, renderer in streams.items():
            started_s = time.thread_time()
            for _ in range(_BLOCKS):
                renderer.process()
            times_s[name].append(time.thread_time() - started_s)
    # The first round warms up.
    return {name: 1e6 * float(np.median(times[1:])) / _BLOCKS / _EMITTERS for name, times in times_s.items()}


def _at_rest(field: AcousticField, filters: HeadFilters) -> Renderer:
    """A renderer with the responses of emitters at the scene's start."""
    start, bus = field.bundle.manifest.start, field.level.bus
    channels = 2 if bus is None else harmonic_count(bus)
    direct_sound = DirectSound.of(field.bundle, filters)
    renderer = direct_sound.renderer(
        block_size=256,
        ir_samples=field.ir_samples,
        sample_rate=field.sample_rate,
        max_emitters=_EMITTERS,
        switches_tail=field.kind.shares_tail,
        buses=[] if bus is None else [bus],
    )
    renderer.set_channels(channels)
    renderer.share(field.kind.sharing)
    emitter, listener = EmitterState(Pose(start.emitter)), Pose(start.listener)
    (response,) = composed_irs(field, direct_sound, listener, [emitter], channels)
    clip = np.random.default_rng(0).standard_normal(field.sample_rate).astype(np.float32)
    for number in range(_EMITTERS):
        renderer.add_emitter(str(number), ClipPlayer(0.01 * clip, loop=True))
        renderer.set_ir(str(number), response)
        for paths in direct_sound.ways_from([(str(number), emitter)]) if direct_sound.is_heard_apart else ():
            renderer.set_paths([str(number)], *paths.find(listener))
    return renderer


def _alone(field: AcousticField, filters: HeadFilters) -> Listener:
    """A listener with its own cache of responses."""
    cache: NodeCache = BoundedCache(NODE_CACHE_BYTES)
    alone = AcousticField(field.bundle, field.level, field.graph, node_cache=cache)
    return Listener(alone, filters, node_cache=cache, time_s=time.thread_time)


def cost_of(bundle: Bundle, level: QualityLevel, times: Times, memory_mb: float) -> Cost:
    """`memory_mb` is that of the level's field."""
    file = bundle.manifest.fields[level.field].file
    return Cost(
        ms_p50=float(np.median(times.walk)),
        ms_p99=float(np.percentile(times.walk, 99)),
        ms_mean=float(np.mean(times.walk)),
        ms_miss=float(np.median(times.miss)),
        ms_turn=float(np.median(times.turn)),
        block_us=times.block_us,
        storage_mb=len(bundle.models[file]) / 1e6,
        memory_mb=memory_mb + times.kept_mb,
        host=processor(),
    )


def memory_mb(folder: Path, levels: Sequence[str]) -> dict[str, float]:
    """The memory in MB that serving each level adds to a new process."""
    context = multiprocessing.get_context("spawn")
    added = {}
    for level in levels:
        with context.Pool(1) as pool:
            added[level] = pool.apply(_added_mb, (folder, level))
    return added


def _added_mb(folder: Path, level: str) -> float:
    bundle = Bundle.load(folder)
    # One level is served before the measurement, so that libraries and compiled code do not count.
    first = _serving(bundle, None)
    before = psutil.Process().memory_info().rss
    second = _serving(bundle, level)
    added = psutil.Process().memory_info().rss - before
    del first, second
    return max(0.0, float(added) / 1e6)


def _serving(bundle: Bundle, level: str | None) -> AcousticField:
    field = AcousticField.load(bundle, level=level)
    start = bundle.manifest.start
    field.impulse_responses([start.listener], [start.emitter], [0.0])
    return field
