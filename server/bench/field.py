"""Time for an impulse response (IR) at each quality level, from a pose to a binaural IR, and of what a stream asks of
the default level: from a pose to partitions ready for convolution. One at a time on one core."""

import math
import statistics
import time
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Pose, Vector3
from server.bench.machine import describe_machine
from server.bench.report import Goal, Judgement
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.field.node_responses import NODE_CACHE_BYTES
from server.rendering.hrtf import kemar
from server.scene.manifest import NO_FIELD
from server.streaming.calibration import Listener

Floats = npt.NDArray[np.float64]

GOAL = Goal("ms_p50 of the default level", 1.0, is_at_most=True)
MOVED = "a moved listener"
TURNED = "a head that only turned"
AMBISONIC = "a moved listener, ambisonics of order 1"
_WIDE_VECTORS = "AVX-512"
MOVED_GOALS = {
    is_wide: Goal(f"ms_p50 to partitions, {MOVED}", limit_ms, stretch_ms, is_at_most=True)
    for is_wide, limit_ms, stretch_ms in ((False, 0.25, 0.12), (True, 0.15, 0.07))
}
"""By whether the processor has AVX-512."""
TURNED_GOAL = Goal(f"ms_p50 to partitions, {TURNED}", 0.05, is_at_most=True)

_STEP_M = 0.1


def measure_levels(levels: FieldsByLevel, *, rounds: int, poses: int) -> dict[str, Any]:
    """Wall time of single IRs by level: the median of the rounds' medians, and the p99 of all. Also the part of it that
    the graph takes; the rest is decoding. Then the same of partitions at the default level, with first reflections, as
    a stream asks for them: for a listener who moved, for a head that only turned, and for ambisonics if the field knows
    directions.

    The poses are those of a walking listener. Levels take turns from round to round, so that other load on the host
    affects all alike; within a round each level has the CPU caches to itself, as in a server. For levels that reuse
    responses, the store of kept responses is full from the beginning, as in a server that has run for minutes.
    """
    _fill_node_cache(levels)
    times_ms: dict[str, list[list[tuple[float, float]]]] = {name: [] for name in levels}
    listeners = _listeners(levels.default)
    prepared_ms: dict[str, list[list[float]]] = {name: [] for name in listeners}
    for number in range(rounds + 1):
        walk = _walk(levels, number, poses)
        for name, listener in listeners.items():
            taken_ms = [listener.time_ms(pose) for pose in _asked(name, walk)]
            if number:
                prepared_ms[name].append(taken_ms)
        for name, field in levels.items():
            times = [_time(field, *pose) for pose in walk]
            if number:  # the first round warms up
                times_ms[name].append(times)
    default = levels.default
    summaries = [{"name": name, **_summary(times_ms[name])} for name in levels]
    prepared = [{"name": name, **_percentiles(times)} for name, times in prepared_ms.items()]
    host = describe_machine()
    return {
        "host": host,
        "scene": levels.bundle.id,
        "ir_s": default.ir_samples / default.sample_rate,
        "rounds": rounds,
        "poses": poses,
        "levels": summaries,
        "prepared": prepared,
        "summary": [
            asdict(GOAL.judge(summaries[0]["ms_p50"])),
            *(asdict(judgement) for judgement in _judge_prepared(prepared, host["instruction_set"])),
        ],
    }


def _judge_prepared(prepared: list[dict[str, Any]], instruction_set: str) -> list[Judgement]:
    found = {row["name"]: row["ms_p50"] for row in prepared}
    return [
        MOVED_GOALS[instruction_set == _WIDE_VECTORS].judge(found[MOVED]),
        TURNED_GOAL.judge(found[TURNED]),
    ]


def _listeners(field: AcousticField) -> dict[str, Listener]:
    filters = kemar(field.sample_rate)
    listeners = {name: Listener(field, filters) for name in (MOVED, TURNED)}
    if field.knows_directions:
        listeners[AMBISONIC] = Listener(field, filters, order=1)
    return listeners


def _asked(name: str, walk: list[tuple[Floats, Floats, float]]) -> list[Pose]:
    """The poses of a walk; for a head that only turns, its headings at the first place."""
    still = walk[0][0]
    return [Pose.from_yaw(tuple((still if name == TURNED else place).tolist()), yaw) for place, _, yaw in walk]


def _fill_node_cache(levels: FieldsByLevel) -> None:
    """Fill the cache with responses of the level that has the most nodes."""
    reusing = [field for field in levels.values() if field.kind.reuses_responses]
    if not reusing:
        return
    fitting = NODE_CACHE_BYTES // (np.dtype(np.float32).itemsize * reusing[0].channels * reusing[0].ir_samples)
    bounds, plan = levels.bundle.manifest.bounds, levels.bundle.floor_plan
    rng = np.random.default_rng(0)
    poses: list[tuple[Vector3, Vector3, float]] = []
    for _ in range(2 * fitting):
        listener, emitter = rng.uniform(bounds.minimum, bounds.maximum, (2, 3))
        if np.all(plan.contains(np.stack([listener, emitter]))):
            poses.append((tuple(listener.tolist()), tuple(emitter.tolist()), rng.uniform(-math.pi, math.pi)))
    finest = max(reusing, key=lambda field: len({field.snap(*pose).node for pose in poses}))
    for listener, emitter, yaw in poses:
        finest.impulse_responses([listener], [emitter], [yaw])


def _summary(rounds: list[list[tuple[float, float]]]) -> dict[str, Any]:
    whole, graph = (np.array([[times[part] for times in each] for each in rounds]) for part in (0, 1))
    found, graph_p50 = _percentiles(whole), _percentiles(graph)["ms_p50"]
    return {**found, "graph_ms_p50": graph_p50, "decode_ms_p50": max(0.0, found["ms_p50"] - graph_p50)}


def _percentiles(rounds: npt.ArrayLike) -> dict[str, float]:
    """The median of the rounds' medians, and the p99 of all times (round, pose)."""
    times_ms = np.asarray(rounds)
    return {
        "ms_p50": statistics.median(np.median(times_ms, axis=1).tolist()),
        "ms_p99": float(np.percentile(times_ms, 99)),
    }


def _time(field: AcousticField, listener: Floats, emitter: Floats, yaw: float) -> tuple[float, float]:
    """Milliseconds for an IR, and for the graph alone right after it; a scene without fields has none."""
    started_s = time.perf_counter()
    field.impulse_responses([listener], [emitter], [yaw], remember=True)
    done_s = time.perf_counter()
    if field.level.field == NO_FIELD:
        return (done_s - started_s) * 1000, 0.0
    field.graph.run([listener], [emitter], [yaw])
    return (done_s - started_s) * 1000, (time.perf_counter() - done_s) * 1000


def _walk(levels: FieldsByLevel, seed: int, poses: int) -> list[tuple[Floats, Floats, float]]:
    """Poses of walks, each from one random place straight to another that is visible from it, with one random emitter
    per walk."""
    bounds, plan = levels.bundle.manifest.bounds, levels.bundle.floor_plan
    rng = np.random.default_rng(seed)
    walk: list[tuple[Floats, Floats, float]] = []
    while len(walk) < poses:
        start, end, emitter = rng.uniform(bounds.minimum, bounds.maximum, (3, 3))
        if not np.all(plan.contains(np.stack([start, end, emitter]))) or not plan.is_visible(start, end):
            continue
        steps = math.ceil(np.linalg.norm(end - start) / _STEP_M)
        walk += [
            (start + (end - start) * step / steps, emitter, rng.uniform(-math.pi, math.pi))
            for step in range(min(steps, poses - len(walk)))
        ]
    return walk
