"""Chooses a scene's frozen noise: of several random draws, the one whose responses come nearest to simulated ones.

All responses of a scene share one noise, and with it its random properties: the correlation between its two signals (a
few hundredths of interaural cross-correlation in every response) and the level of its first milliseconds. Simulated
responses have such random properties too, each its own. So no property of the noise alone can decide which draw is
best.

Draws are compared on the same pairs, a few pairs at a time. A draw that is behind the best by more than chance explains
is dropped, so most draws need only a part of the pairs.
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import numpy.typing as npt
from rich.progress import Progress

from server.acoustics.phase import FrozenNoise
from server.core.errors import FieldError
from server.field.field import AcousticField
from server.field.graph import open_graph
from server.field.graphs import graph_of
from server.scene.bundle import Bundle
from training.data.dataset import Dataset
from training.frontier.accuracy import Estimate, SampledPairs, Scores
from training.models.frozen_noise import even_noise

DRAWS = 16
_PAIRS, _YAWS = 80, 3
_ROUND_PAIRS = 10
_BEHIND_ERRORS = 3.0
"""Standard errors of the mean difference from the best draw."""


def choose_noise(
    bundle: Bundle, dataset: Dataset, *, seed: int, progress: Progress | None = None
) -> npt.NDArray[np.float32]:
    """(2, sample) the best of DRAWS draws: it has the least mean audible error of the bundle's first quality level over
    pairs from the training set. A draw with which fewer parameters can be measured is never the best. If no draw gives
    finite responses, the first is returned."""
    progress = progress or Progress(disable=True)
    manifest = bundle.manifest
    codec = manifest.codec.codec
    level = manifest.levels[0]
    graph = graph_of(bundle, level.field, open_graph(bundle, manifest.fields[level.field].file))
    sample = SampledPairs(dataset, codec, pairs=_PAIRS, yaws=_YAWS, seed=seed, held_out=False)
    draws = [even_noise(codec, draw) for draw in np.random.default_rng([seed, 6]).spawn(DRAWS)]
    fields = [AcousticField(bundle, level, graph, FrozenNoise.from_signal(codec, noise)) for noise in draws]
    order = np.random.default_rng([seed, 9]).permutation(len(sample.entries))
    rounds = [order[start : start + _ROUND_PAIRS] for start in range(0, len(order), _ROUND_PAIRS)]
    return draws[race([partial(_errors, sample, Estimate(field)) for field in fields], rounds, progress)]


def race(
    contestants: Sequence[Callable[[npt.NDArray[np.int64]], Scores]],
    rounds: Sequence[npt.NDArray[np.int64]],
    progress: Progress,
) -> int:
    """The number of the contestant with the least mean error, among those with the smallest missing share. Contestants
    compute the scores of the pairs of one round after the other, until they are dropped."""
    running = list(range(len(contestants)))
    scores: list[list[Scores]] = [[] for _ in contestants]
    with ThreadPoolExecutor(os.cpu_count(), "noise") as pool:
        for pairs in progress.track(rounds, description="choosing the noise"):
            found = pool.map(lambda number, pairs=pairs: contestants[number](pairs), running)
            for number, each in zip(running, found, strict=True):
                scores[number].append(each)
            running = _still_running({number: Scores.joined(scores[number]) for number in running})
            if len(running) == 1:
                break
    return running[0]


def _still_running(scores: dict[int, Scores]) -> list[int]:
    """The best contestant, and those that are not certainly worse."""
    best = min(scores, key=lambda number: (scores[number].missing, scores[number].mean))
    if not np.isfinite(scores[best].mean):
        return sorted(scores)[:1]
    behind = {number: each.behind(scores[best]) for number, each in scores.items() if number != best}
    return [best, *(number for number, errors in behind.items() if errors < _BEHIND_ERRORS)]


def _errors(sample: SampledPairs, estimate: Estimate, pairs: npt.NDArray[np.int64]) -> Scores:
    try:
        return sample.scores_of(estimate, pairs)
    except FieldError:
        return Scores.unmeasurable(len(pairs))
