"""By how much predicted levels are too low on average: a regression on the logarithm of magnitude predicts the mean of
logarithms, 2.5 dB below the logarithm of the mean power for noise, and less or more wherever it is unsure.

Axes: B pairs, n levels (natural logarithms of magnitude).
"""

import torch
from torch import Tensor


class PowerBalance:
    """The power of targets and of predictions, of pairs out of sight and of those in sight.

    Round a corner the first frames are all but silent and hard to tell, in sight they are loud and easy: one correction
    for both would make them too loud there. Power counts as a share of its pair's, so that a pair near its emitter
    counts as much as one far from it, and nothing counts for being far off where it is not heard.
    """

    def __init__(self, areas: Tensor) -> None:
        """`areas` (n,): steps of time and frequency that each level stands for."""
        self._areas = areas
        self._true, self._predicted = areas.new_zeros(2, len(areas)), areas.new_zeros(2, len(areas))

    def add(self, true: Tensor, predicted: Tensor, sight: Tensor) -> None:
        """Levels (B, n) of pairs that see each other (1) or not (0), `sight` (B, 1)."""
        kinds = torch.cat([1 - sight, sight], dim=1).T
        power = torch.exp(2 * true)
        whole = (power @ self._areas)[:, None]
        self._true += kinds @ (power / whole)
        self._predicted += kinds @ (torch.exp(2 * predicted) / whole)

    def missing(self) -> Tensor:
        """(2, n) what to add to predicted levels, out of sight and in sight; of all pairs for a kind without any."""
        is_there = (self._true > 0).any(dim=1, keepdim=True)
        true, predicted = (torch.where(is_there, power, power.sum(dim=0)) for power in (self._true, self._predicted))
        return 0.5 * torch.log(true / predicted)
