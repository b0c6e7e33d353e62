"""What an impulse response costs: from a pose to a binaural IR, one at a time on one core."""

import math
import statistics
import time
from typing import Any

import numpy as np

from server.field.field import AcousticField


def measure_field(field: AcousticField, *, rounds: int, poses: int) -> dict[str, Any]:
    """Wall time of single IRs between random places: the median of the rounds' medians, and p99 of all."""
    bounds = field.bundle.manifest.bounds
    rng = np.random.default_rng(0)
    places = rng.uniform(bounds.minimum, bounds.maximum, (10 * poses, 3))
    places = places[field.bundle.floor_plan.contains(places)]
    times_ms: list[list[float]] = []
    for _ in range(rounds + 1):
        times_ms.append([])
        for _ in range(poses):
            listener, emitter = rng.choice(places, 2)
            started_s = time.perf_counter()
            field.impulse_responses([listener], [emitter], [rng.uniform(-math.pi, math.pi)])
            times_ms[-1].append((time.perf_counter() - started_s) * 1000)
    measured = times_ms[1:]  # the first round warms up
    return {
        "ir_s": field.ir_samples / field.sample_rate,
        "rounds": rounds,
        "poses": poses,
        "median_ms": statistics.median(statistics.median(times) for times in measured),
        "p99_ms": float(np.percentile(np.concatenate(measured), 99)),
    }
