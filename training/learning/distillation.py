"""Distillation: a trained `naf` predicts levels of responses at unmeasured poses, as further targets for a factorised
field.

Spectrograms of a `naf` have another resolution than the factorised field's targets. So they get the phase of noise, are
synthesised, and transformed like any response. Phase and interaural coherence are not distilled, because a `naf` does
not predict them.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch

from training.learning.naf import NafLearner
from training.models.cells import Cells
from training.models.frozen_noise import even_noise
from training.models.naf_graph import NafGraph
from training.models.targets import flat_targets

_NOISE_ITERATIONS = 60
_LARGEST_MOVE_M = 0.5


@dataclass(frozen=True)
class DistillationTargets:
    """Poses (row, 3), yaws (row,) and flat targets (row, heads.size), of which only the levels are valid."""

    listener: npt.NDArray[np.float32]
    emitter: npt.NDArray[np.float32]
    yaw: npt.NDArray[np.float32]
    flat: npt.NDArray[np.float16]


@torch.no_grad()
def distillation_targets(teacher: NafLearner, cells: Cells, count: int, seed: int) -> DistillationTargets:
    """Targets at `count` poses near measured ones: both ends are moved by up to half a metre along x and y, where the
    new position is inside the room."""
    rng = np.random.default_rng([seed, 9])
    responses, surroundings = teacher.responses, teacher.site.surroundings
    chosen = rng.choice(np.flatnonzero(~responses.held_out), count)
    ends = []
    for measured in (responses.listener[chosen], responses.emitter[chosen]):
        beside = measured + rng.uniform(-_LARGEST_MOVE_M, _LARGEST_MOVE_M, measured.shape) * (1, 1, 0)
        inside = surroundings.contains(beside)
        ends.append(np.where(inside[:, None], beside, measured).astype(np.float32))
    listener, emitter = ends
    yaw = responses.yaw[chosen].astype(np.float32)
    graph = NafGraph(teacher.field, teacher.codec, tabled=True).eval()
    noise = teacher.codec.transform(even_noise(teacher.codec, rng, iterations=_NOISE_ITERATIONS))
    noise = noise[: responses.channels]
    phasors = noise / np.maximum(np.abs(noise), 1e-12)
    flats = []
    for row in range(count):
        pose = (torch.from_numpy(part[row : row + 1]) for part in (listener, emitter, yaw))
        magnitude = teacher.codec.magnitude(graph(*pose)[0][0].double().numpy())
        flats.append(flat_targets(teacher.codec.synthesise(magnitude * phasors), cells))
    return DistillationTargets(listener, emitter, yaw, np.stack(flats))
