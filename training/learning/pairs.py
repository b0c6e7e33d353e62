"""Which responses a run trains on, and which it validates on to notice overfitting."""

import numpy as np
import numpy.typing as npt

from training.data.dataset_check import DatasetError
from training.data.responses import SAME_POINT_M, ResponseSet

_VALIDATION_SHARE = 0.05


def split(responses: ResponseSet, *, share: float, seed: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Rows to train on (a `share` of the pairs) and validation rows (both directions of a twentieth of all couples of
    points). Rows count the responses that are not held out. The pairs of a smaller share are among those of a larger
    one, and the validation rows are the same for all shares.

    Held-out pairs are for the evaluation only; no run sees them. Raises DatasetError if nothing is left to train on.
    """
    trainable = np.flatnonzero(~responses.held_out)
    ends = np.stack([responses.emitter[trainable], responses.listener[trainable]], axis=1)
    _, point = np.unique(np.round(ends.reshape(-1, 3) / SAME_POINT_M).astype(np.int64), axis=0, return_inverse=True)
    couples, couple = np.unique(np.sort(point.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    rng = np.random.default_rng([seed, 3])
    # guard: a twentieth of few couples is one
    wanted = max(1, round(_VALIDATION_SHARE * len(couples)))
    # guard: the same place measured twice is one place
    validation = np.isin(couple.reshape(-1), rng.choice(len(couples), wanted, replace=False))
    pairs = responses.pair[trainable]
    candidates = rng.permutation(np.unique(pairs[~validation]))
    used = np.isin(pairs, candidates[: max(1, round(share * len(candidates)))])
    # guard: too few places are told
    if not (used & ~validation).any():
        raise DatasetError(
            f"{responses.file}: nothing is left to train on: {len(trainable)} responses are not held out, between "
            f"{len(couples)} couples of points, and one couple is needed for validation; measure or simulate more"
        )
    return np.flatnonzero(used & ~validation), np.flatnonzero(validation)
