"""Time for an impulse response (IR) at each quality level: from a pose to a binaural IR, one at a time on one core. For
the default level also the time until it is ready to be convolved (`server.bench.responses`)."""

import math
import statistics
import time
from dataclasses import asdict
from typing import Any

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Pose, Vector3
from server.bench.machine import describe_machine
from server.bench.report import Goal
from server.bench.responses import judge, measure_responses
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.field.node_responses import NODE_CACHE_BYTES
from server.scene.manifest import NO_FIELD

Floats = npt.NDArray[np.float64]

GOAL = Goal("ms_p50 of the default level", 1.0, is_at_most=True)

_STEP_M = 0.1


def measure_levels(levels: FieldsByLevel, *, rounds: int, poses: int) -> dict[str, Any]:
    """Wall time of single IRs by level: the median of the rounds' medians, and the p99 of all. Also the part of it that
    the graph takes; the rest is decoding.

    The poses are those of a walking listener. Levels take turns from round to round, so that other load on the host
    affects all alike; within a round each level has the CPU caches to itself, as in a server. For levels that reuse
    responses, the store of kept responses is full from the beginning, as in a server that has run for minutes.
    """
    _fill_node_cache(levels)
    times_ms: dict[str, list[list[tuple[float, float]]]] = {name: [] for name in levels}
    for number in range(rounds + 1):
        walk = _walk(levels, number, poses)
        for name, field in levels.items():
            times = [_time(field, *pose) for pose in walk]
            if number:  # the first round warms up
                times_ms[name].append(times)
    default = levels.default
    walks = [
        [Pose.from_yaw(tuple(at.tolist()), yaw) for at, _, yaw in _walk(levels, number, poses)]
        for number in range(rounds + 1)
    ]
    responses = measure_responses(default, walks)
    summaries = [{"name": name, **_summary(times_ms[name])} for name in levels]
    return {
        "host": describe_machine(),
        "scene": levels.bundle.id,
        "ir_s": default.ir_samples / default.sample_rate,
        "rounds": rounds,
        "poses": poses,
        "levels": summaries,
        "responses": responses,
        "summary": [
            asdict(judgement)
            for judgement in (
                GOAL.judge(summaries[0]["ms_p50"]),
                *judge(responses, knows_directions=bool(responses) and default.knows_directions),
            )
        ],
    }


def _fill_node_cache(levels: FieldsByLevel) -> None:
    """Fill the cache with responses of the level that has the most nodes."""
    reusing = [field for field in levels.values() if field.kind.reuses_responses]
    if not reusing:
        return
    fitting = NODE_CACHE_BYTES // (np.dtype(np.float32).itemsize * reusing[0].channels * reusing[0].ir_samples)
    bounds, surroundings = levels.bundle.manifest.bounds, levels.bundle.surroundings
    rng = np.random.default_rng(0)
    poses: list[tuple[Vector3, Vector3, float]] = []
    for _ in range(2 * fitting):
        listener, emitter = rng.uniform(bounds.minimum, bounds.maximum, (2, 3))
        if np.all(surroundings.contains(np.stack([listener, emitter]))):
            poses.append((tuple(listener.tolist()), tuple(emitter.tolist()), rng.uniform(-math.pi, math.pi)))
    finest = max(reusing, key=lambda field: len({field.snap(*pose).node for pose in poses}))
    for listener, emitter, yaw in poses:
        finest.impulse_responses([listener], [emitter], [yaw])


def _summary(rounds: list[list[tuple[float, float]]]) -> dict[str, Any]:
    whole, graph = (np.array([[times[part] for times in each] for each in rounds]) for part in (0, 1))
    p50, graph_p50 = (statistics.median(np.median(part, axis=1).tolist()) for part in (whole, graph))
    return {
        "ms_p50": p50,
        "ms_p99": float(np.percentile(whole, 99)),
        "graph_ms_p50": graph_p50,
        "decode_ms_p50": max(0.0, p50 - graph_p50),
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
    bounds, surroundings = levels.bundle.manifest.bounds, levels.bundle.surroundings
    rng = np.random.default_rng(seed)
    walk: list[tuple[Floats, Floats, float]] = []
    while len(walk) < poses:
        start, end, emitter = rng.uniform(bounds.minimum, bounds.maximum, (3, 3))
        if not np.all(surroundings.contains(np.stack([start, end, emitter]))) or not surroundings.is_visible(
            start, end
        ):
            continue
        steps = math.ceil(np.linalg.norm(end - start) / _STEP_M)
        walk += [
            (start + (end - start) * step / steps, emitter, rng.uniform(-math.pi, math.pi))
            for step in range(min(steps, poses - len(walk)))
        ]
    return walk
