"""Which responses a run trains on, and which it looks at to notice when it stops learning anything general."""

import numpy as np
import numpy.typing as npt

from training.data.dataset_check import DatasetError
from training.data.responses import SAME_POINT_M, ResponseSet

_HELD_BACK_SHARE = 0.05


def split(responses: ResponseSet, *, share: float, seed: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Rows to train on, a share of the pairs, and rows held back, those of a twentieth of all couples of points in both
    directions; both count the rows that are not held out. The pairs of a smaller share are among those of a larger one,
    and what is held back is the same for all.

    (What is held out belongs to the evaluation, and no run ever sees it.) Raises DatasetError where nothing is left to
    train on.
    """
    trainable = np.flatnonzero(~responses.held_out)
    ends = np.stack([responses.emitter[trainable], responses.listener[trainable]], axis=1)
    _, point = np.unique(np.round(ends.reshape(-1, 3) / SAME_POINT_M).astype(np.int64), axis=0, return_inverse=True)
    couples, couple = np.unique(np.sort(point.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    rng = np.random.default_rng([seed, 3])
    wanted = max(1, round(_HELD_BACK_SHARE * len(couples)))
    held_back = np.isin(couple.reshape(-1), rng.choice(len(couples), wanted, replace=False))
    pairs = responses.pair[trainable]
    candidates = rng.permutation(np.unique(pairs[~held_back]))
    used = np.isin(pairs, candidates[: max(1, round(share * len(candidates)))])
    if not (used & ~held_back).any():
        raise DatasetError(
            f"{responses.file}: nothing is left to train on: {len(trainable)} responses are not held out, between "
            f"{len(couples)} couples of points, and one couple is held back; measure or simulate more"
        )
    return np.flatnonzero(used & ~held_back), np.flatnonzero(held_back)
