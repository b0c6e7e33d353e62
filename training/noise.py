"""Which frozen noise a scene is given: of several draws, the one with which responses come nearest to simulated ones.

All responses of a scene share one noise, and with it what that happens to be like: how much its two signals have in
common (a few hundredths of interaural cross-correlation, on every response alike) and how loud its first milliseconds
are. Simulated responses have such chance in them too, each its own, so that no property of noise by itself would do to
choose by.
"""

import math

import numpy as np
import numpy.typing as npt
from rich.progress import Progress

from server.acoustics.phase import FrozenNoise
from server.errors import FieldError
from server.field.field import AcousticField
from server.field.graph import FieldGraph, open_graph
from server.scene.bundle import Bundle
from training.dataset import Dataset
from training.frontier.accuracy import Estimate, SampledPairs
from training.models.frozen_noise import even_noise

DRAWS = 16
_PAIRS, _YAWS = 80, 3


def choose_noise(
    bundle: Bundle, dataset: Dataset, *, seed: int, progress: Progress | None = None
) -> npt.NDArray[np.float32]:
    """(2, sample) of DRAWS: that with the least mean audible error of the bundle's first level over pairs that training
    saw; of those with which more could not be measured, none. The first, where responses are finite with none."""
    progress = progress or Progress(disable=True)
    manifest = bundle.manifest
    codec = manifest.codec.codec
    level = manifest.levels[0]
    graph = FieldGraph(bundle, level.field, open_graph(bundle, manifest.fields[level.field].file))
    sample = SampledPairs(dataset, codec, pairs=_PAIRS, yaws=_YAWS, seed=seed, held_out=False)

    def error(noise: npt.NDArray[np.float32]) -> tuple[float, float]:
        field = AcousticField(bundle, level, graph, FrozenNoise.from_signal(codec, noise))
        try:
            return sample.audible_of(Estimate(field))
        except FieldError:
            return 1.0, math.inf

    draws = progress.track(np.random.default_rng([seed, 6]).spawn(DRAWS), description="choosing the noise")
    return min((even_noise(codec, draw) for draw in draws), key=error)
