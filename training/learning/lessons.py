"""What a trained `naf` teaches a factorised field: levels of responses at poses that nobody measured.

Its spectrograms have another codec than the factorised field's targets, so they are given noise for a phase,
synthesised, and read again like any response. Phases and interaural coherence, of which a `naf` knows nothing, are not
taught.
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
_BESIDE_M = 0.5


@dataclass(frozen=True)
class DistillationTargets:
    """Poses (lesson, 3), yaws (lesson,) and flat targets (lesson, heads.size), whose levels alone count."""

    listener: npt.NDArray[np.float32]
    emitter: npt.NDArray[np.float32]
    yaw: npt.NDArray[np.float32]
    flat: npt.NDArray[np.float16]


@torch.no_grad()
def lessons_of(teacher: NafLearner, cells: Cells, count: int, seed: int) -> DistillationTargets:
    """Of poses beside those measured, within half a metre in plan where that is inside the room."""
    rng = np.random.default_rng([seed, 9])
    responses, plan = teacher.responses, teacher.site.plan
    chosen = rng.choice(np.flatnonzero(~responses.held_out), count)
    ends = []
    for measured in (responses.listener[chosen], responses.emitter[chosen]):
        beside = measured + rng.uniform(-_BESIDE_M, _BESIDE_M, measured.shape) * (1, 1, 0)
        inside = np.array([bool(plan.contains(point)) for point in beside])
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
