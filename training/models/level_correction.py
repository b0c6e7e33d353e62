"""By how much predicted levels are too low on average: a regression on the logarithm of magnitude predicts the mean of
logarithms, 2.5 dB below the logarithm of the mean power for noise, and less or more wherever it is unsure.

Axes: B pairs, n levels (natural logarithms of magnitude).
"""

import math
from collections.abc import Callable, Iterable

import torch
from torch import Tensor, nn

from training.models.cells import Cells

# A level that is raised is heard in the cells beside it too: after one step a twentieth of the error of a reverberation
# time is left, after three less than a hundredth.
_STEPS = 3


class LevelsInterpolated(nn.Module):
    """What is heard of predicted levels, in the layout that they are predicted in.

    A cell's level is the mean power of its frames and bins, and whoever decodes it draws straight lines from the centre
    of one cell to that of the next. Of sound that decays by x nepers of amplitude in half a cell, the mean power lies
    by the factor sinh(2x) / 2x above that of its centre: read as it is, late sound decays too slowly where cells widen.
    """

    _to_bins: Tensor
    _of_bins: Tensor
    _to_frames: Tensor
    _of_frames: Tensor

    def __init__(self, cells: Cells, channels: int) -> None:
        super().__init__()
        self._fine = (channels, cells.codec.bins, cells.fine_frames)
        self._late = (channels, cells.bands.cells, cells.late_frames.cells)
        for name, matrix in (
            ("to_bins", cells.bands.spread().T),
            ("of_bins", cells.bands.pool().T),
            ("to_frames", cells.all_frames.spread()[:, cells.fine_frames :]),
            ("of_frames", cells.late_frames.pool()),
        ):
            self.register_buffer(f"_{name}", torch.tensor(matrix.copy()), persistent=False)

    def forward(self, levels: Tensor) -> Tensor:
        """(B, n) levels of fine frames and of late cells, to as many."""
        fine, late = torch.split(levels, [math.prod(self._fine), math.prod(self._late)], dim=1)
        columns = torch.cat([fine.unflatten(1, self._fine), self._to_bins @ late.unflatten(1, self._late)], dim=-1)
        power = self._of_bins @ torch.exp(2 * (columns @ self._to_frames)) @ self._of_frames
        return torch.cat([fine, 0.5 * torch.log(power).flatten(1)], dim=1)


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


def level_correction(
    examples: Callable[[], Iterable[tuple[Tensor, Tensor, Tensor]]],
    heard: Callable[[Tensor], Tensor],
    areas: Tensor,
) -> Tensor:
    """(2, n) what to add to predicted levels, out of sight and in sight, so that what is `heard` of them has the power
    of the true ones.

    examples: anew at every call the same batches of true and predicted levels (B, n) and `sight` (B, 1).
    """
    correction = areas.new_zeros(2, len(areas))
    for _ in range(_STEPS):
        balance = PowerBalance(areas)
        for true, predicted, sight in examples():
            corrected = predicted + torch.lerp(correction[0], correction[1], sight)
            balance.add(true, heard(corrected), sight)
        correction += balance.missing()
    return correction
