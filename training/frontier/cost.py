"""The cost of quality levels: milliseconds per pose on one core, memory and storage."""

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

from server.bench.machine import processor
from server.core.bounded_cache import BoundedCache
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.field.node_responses import NODE_CACHE_BYTES, NodeCache
from server.rendering.hrtf import HeadFilters, kemar
from server.scene.bundle import Bundle
from server.scene.manifest import Cost, QualityLevel
from server.streaming.calibration import Listener
from training.frontier.walk import POSES_PER_S, walk

SEGMENT_S = 5
_FEW_POSES = 12
_SEGMENTS_OF_MISSES = 12
_WARM_UP = 3


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
    """Milliseconds: `walk` (pose,) on a walk that begins with an empty cache, and `miss` (pose,) for poses that are not
    in the cache. `kept_mb` is the final size of the cache."""

    walk: npt.NDArray[np.float64]
    miss: npt.NDArray[np.float64]
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
        advance()
    kept_mb = {name: listener.kept_bytes / 1e6 for name, listener in listeners.items()}
    for start in starts[:: len(starts) // _SEGMENTS_OF_MISSES or 1]:
        for name, level in levels.items():
            if level.kind.reuses_responses:
                for pose in poses[start : start + _FEW_POSES]:
                    listeners[name].forget()
                    misses[name].append(listeners[name].time_ms(pose))
    return {name: Times(np.array(times[name]), np.array(misses[name] or times[name]), kept_mb[name]) for name in levels}


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
