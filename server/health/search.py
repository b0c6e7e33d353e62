"""Search for the worst poses: from the worst of many poses, in ever smaller neighbourhoods."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.health.energies import Energies
from server.health.poses import EMITTER, LISTENER, YAW, Poses, allowed
from server.scene.bundle import Bundle

Floats = npt.NDArray[np.float64]

HALVINGS = 4
_ROUNDS, _CANDIDATES = 6, 8
NEIGHBOURS = _ROUNDS * _CANDIDATES
STEP_M = 0.01
STEP_RAD = np.radians(1.0)


def climb(
    bundle: Bundle,
    worth: Callable[[Poses], Floats],
    poses: Poses,
    rng: np.random.Generator,
) -> tuple[Poses, Floats]:
    """Maximise `worth` from each of the poses (n, 7). Returns the best poses found and their worth (n,). Every round
    tries eight neighbours of each pose; the neighbourhood begins at a metre and a quarter turn, and halves every
    round."""
    best, values = poses.copy(), known(worth(poses))
    for number in range(_ROUNDS):
        reach = np.array([1.0] * 6 + [np.pi / 2]) / 2**number
        shape = len(best), _CANDIDATES, 7
        # Half of the coordinates change at a time. A change of all of them is hardly ever an improvement.
        tried = best[:, None] + rng.uniform(-reach, reach, shape) * (rng.random(shape) < 0.5)
        flat = tried.reshape(-1, 7)
        found = np.full(len(flat), -np.inf)
        is_allowed = allowed(bundle, flat)
        if is_allowed.any():
            found[is_allowed] = known(worth(flat[is_allowed]))
        of_each = found.reshape(len(best), _CANDIDATES)
        at = np.argmax(of_each, axis=1)
        rows = np.arange(len(best))
        better = of_each[rows, at] > values
        best[better], values[better] = tried[rows, at][better], of_each[rows, at][better]
    return best, values


def moves(poses: Poses, rng: np.random.Generator) -> dict[str, Poses]:
    """Poses after sixteen steps of the listener, the emitter or the head, by what moves. Steps are a centimetre in a
    random direction, or a degree."""
    moved = {}
    for name, end in (("listener", LISTENER), ("emitter", EMITTER)):
        directions = rng.standard_normal((len(poses), 3))
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        moved[name] = poses.copy()
        moved[name][:, end] += 2**HALVINGS * STEP_M * directions
    moved["yaw"] = poses.copy()
    moved["yaw"][:, YAW] += 2**HALVINGS * STEP_RAD
    return moved


@dataclass(frozen=True, eq=False)
class Steps:
    """Poses (n, 7) before and after a step, with their energies."""

    poses: Poses
    moved: Poses
    before: Energies
    after: Energies


def steepest(
    bundle: Bundle,
    energies: Callable[[Poses], Energies],
    change: Callable[[Steps], Floats],
    poses: Poses,
    moved: Poses,
    *,
    kept: int,
) -> Steps:
    """Single steps with a large change. Of the moves of sixteen steps, the `kept` with the greatest change are halved
    again and again, each time keeping the half with more change. A jump anywhere on a move is in one of its halves."""
    surroundings = bundle.surroundings
    usable = allowed(bundle, poses) & allowed(bundle, moved)
    for part in (LISTENER, EMITTER):  # moves do not go through walls
        usable &= surroundings.is_visible(poses[:, part], moved[:, part])
    start, end = poses[usable], moved[usable]
    before, after = energies(start), energies(end)
    order = np.argsort(-known(change(Steps(start, end, before, after))))[:kept]
    start, end, before, after = start[order], end[order], before[order], after[order]
    for _ in range(HALVINGS):
        middle = (start + end) / 2
        between = energies(middle)
        halves = Steps(start, middle, before, between), Steps(middle, end, between, after)
        is_first = np.greater_equal(*(known(change(half)) for half in halves))
        rows, cubes = is_first[:, None], is_first[:, None, None, None]
        start, before = np.where(rows, start, middle), np.where(cubes, before, between)
        end, after = np.where(rows, middle, end), np.where(cubes, between, after)
    return Steps(start, end, before, after)


def known(values: Floats) -> Floats:
    """The values with NaN replaced by infinity, the worst value."""
    return np.where(np.isnan(values), np.inf, values)
