"""How much the sound changes between two poses that are a centimetre from each other.

It changes little if every response is computed anew. If poses share responses, it jumps at the border of a cell.
"""

import itertools

import numpy as np
import numpy.typing as npt

from server.acoustics.audibility import in_jnd
from server.acoustics.geometry import Pose
from server.acoustics.metrics import parameter_errors
from server.acoustics.room_parameters import measure
from server.field.field import AcousticField
from server.responses.full_response import FullResponse
from training.frontier.heard_by_bus import HeardByBus, full_response
from training.frontier.walk import SPEED_M_PER_S, walk

STEP_M = 0.01
_WALK_S = 60.0


def largest_steps(field: AcousticField, *, count: int, seed: int) -> dict[str, float]:
    """For each metric, the largest change in JND over `count` steps of a walk, or over those that lead to another node.

    The steps are evenly spread over the walk or, if the level reuses responses, over the steps that lead to another
    node. DRR counts if the emitter is in sight of both poses.
    """
    emitter = field.bundle.manifest.start.emitter
    poses = walk(field.bundle, duration_s=_WALK_S, poses_per_s=SPEED_M_PER_S / STEP_M, seed=seed)
    steps = list(itertools.pairwise(poses))
    if field.kind.reuses_responses:
        nodes = [field.snap(pose.position, emitter, pose.yaw) for pose in poses]
        steps = [step for step, (one, other) in zip(steps, itertools.pairwise(nodes), strict=True) if one != other]
    spread = np.linspace(0, len(steps) - 1, min(count, len(steps))).astype(int) if steps else np.array([], int)
    chosen = np.unique(spread)
    whole = full_response(field)
    largest: dict[str, float] = {}
    for number in chosen:
        before, after = (measure(_response(whole, pose), field.sample_rate) for pose in steps[number])
        errors = parameter_errors(before, after)
        places = np.array([pose.position for pose in steps[number]])
        if not np.all(field.bundle.surroundings.is_visible(places, np.array(emitter))):
            del errors["drr"]
        for metric, change in in_jnd(errors, before).items():
            if np.isfinite(change):
                largest[metric] = max(largest.get(metric, 0.0), float(change))
    return largest


def _response(whole: FullResponse | HeardByBus, pose: Pose) -> npt.NDArray[np.float32]:
    emitter = whole.bundle.manifest.start.emitter
    return np.asarray(whole.impulse_responses([pose.position], [emitter], [pose.yaw])[0])
