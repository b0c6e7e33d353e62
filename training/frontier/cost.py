"""What quality levels cost: milliseconds per binaural response on one core, memory and storage."""

import math
import multiprocessing
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import numpy.typing as npt
import psutil

from server.field.field import AcousticField
from server.scene.bundle import Bundle
from server.scene.manifest import Cost, QualityLevel

_STEP_M = 0.05
_WARM_UP = 3
_TURN = 8


@contextmanager
def one_core() -> Iterator[None]:
    """The process keeps to one of its cores, where the system lets it."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)


def measure_ms(
    fields: Mapping[str, AcousticField],
    *,
    rounds: int,
    budget_s: float,
    seed: int = 0,
    advance: Callable[[], None] = lambda: None,
) -> dict[str, npt.NDArray[np.float64]]:
    """Milliseconds of single responses by level, (response,).

    All levels take turns of several, so that whatever else the machine does meets all of them, and each finds its
    numbers in the processor's caches, as a stream does.

    A listener walks, through walls if need be, and asks for a response every 5 cm: warm starts live from that. A level
    that has had its `budget_s` sits out the remaining rounds, but for three.
    """
    rng = np.random.default_rng(seed)
    times: dict[str, list[float]] = {name: [] for name in fields}
    walks = {name: _walk(field, np.random.default_rng(seed)) for name, field in fields.items()}
    for name, field in fields.items():
        for _ in range(_WARM_UP):
            _time_ms(field, next(walks[name]))
    for _ in range(rounds):
        for name in rng.permutation(list(fields)):
            for _ in range(_TURN):
                if math.fsum(times[name]) <= 1000 * budget_s or len(times[name]) < _WARM_UP:
                    times[name].append(_time_ms(fields[name], next(walks[name])))
        advance()
    return {name: np.array(values) for name, values in times.items()}


def cost_of(bundle: Bundle, level: QualityLevel, times_ms: npt.NDArray[np.float64], memory_mb: float) -> Cost:
    file = bundle.manifest.fields[level.field].file
    return Cost(
        ms_p50=float(np.median(times_ms)),
        ms_p99=float(np.percentile(times_ms, 99)),
        storage_mb=len(bundle.models[file]) / 1e6,
        memory_mb=memory_mb,
        host=_processor(),
    )


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.machine())


def memory_mb(folder: Path, levels: Sequence[str]) -> dict[str, float]:
    """What serving each level adds to a fresh process, MB."""
    context = multiprocessing.get_context("spawn")
    added = {}
    for level in levels:
        with context.Pool(1) as pool:
            added[level] = pool.apply(_added_mb, (folder, level))
    return added


def _added_mb(folder: Path, level: str) -> float:
    bundle = Bundle.load(folder)
    # One level served before the count, so that libraries and compiled code are none of the cost.
    first = _serving(bundle, None)
    before = psutil.Process().memory_info().rss
    second = _serving(bundle, level)
    added = psutil.Process().memory_info().rss - before
    del first, second
    return max(0.0, added / 1e6)


def _serving(bundle: Bundle, level: str | None) -> AcousticField:
    field = AcousticField.load(bundle, level=level)
    _time_ms(field, next(_walk(field, np.random.default_rng(0))))
    return field


_Pose = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64], float]


def _walk(field: AcousticField, rng: np.random.Generator) -> Iterator[_Pose]:
    """Listener, emitter and yaw, for ever: a walk between random places, with the emitter where it is until it ends."""
    bounds = field.bundle.manifest.bounds
    while True:
        start, end, emitter = (_place(field, bounds.minimum, bounds.maximum, rng) for _ in range(3))
        steps = max(1, math.ceil(float(np.linalg.norm(end - start)) / _STEP_M))
        yaw = rng.uniform(-math.pi, math.pi)
        for share in np.linspace(0, 1, steps):
            place = start + share * (end - start)
            if field.bundle.floor_plan.contains(place):
                yield place, emitter, yaw


def _place(
    field: AcousticField, low: Sequence[float], high: Sequence[float], rng: np.random.Generator
) -> npt.NDArray[np.float64]:
    while True:
        place = rng.uniform(low, high)
        if field.bundle.floor_plan.contains(place):
            return np.asarray(place)


def _time_ms(field: AcousticField, pose: _Pose) -> float:
    listener, emitter, yaw = pose
    started_s = time.perf_counter()
    field.impulse_responses([listener], [emitter], [yaw])
    return 1000 * (time.perf_counter() - started_s)
