"""By how much predicted levels are too low on average. A regression on log-magnitude predicts the mean of logarithms.
For noise, this is 2.5 dB below the logarithm of the mean power, and the gap also depends on how uncertain the field is.

Levels of cells are corrected for all pairs in sight alike, and for all others alike. But chance decides more about
single cells where two rooms are far apart, so sums over cells are still too low there. Levels of whole bands are
therefore corrected once more, pair by pair.

Axes: B pairs, n levels (natural logarithms of magnitude).
"""

import math
from collections.abc import Callable, Iterable

import numpy as np
import torch
from sklearn.linear_model import RidgeCV
from sklearn.preprocessing import StandardScaler
from torch import Tensor, nn

from training.models.cells import Cells

# Raising the level of one cell also raises its neighbours, by interpolation. One step leaves a twentieth of the error
# of a reverberation time, three steps less than a hundredth.
_STEPS = 3
_PENALTIES = np.logspace(0, 5, 6)
"""Penalties of the ridge regression to choose from, for features of unit variance."""


class InterpolatedLevels(nn.Module):
    """Predicted levels after decoding, in the layout in which they are predicted.

    The level of a cell is the mean power of its frames and bins, and decoding interpolates linearly between the centres
    of cells. For sound that decays by x nepers of amplitude in half a cell, the mean power is sinh(2x) / 2x times the
    power at the centre. Without a correction, late sound would therefore decay too slowly where cells widen.
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
        """(B, n) levels of fine frames and late cells, to the same number of decoded levels."""
        fine, late = torch.split(levels, [math.prod(self._fine), math.prod(self._late)], dim=1)
        columns = torch.cat([fine.unflatten(1, self._fine), self._to_bins @ late.unflatten(1, self._late)], dim=-1)
        power = self._of_bins @ torch.exp(2 * (columns @ self._to_frames)) @ self._of_frames
        return torch.cat([fine, 0.5 * torch.log(power).flatten(1)], dim=1)


class InterpolatedBands(nn.Module):
    """Predicted levels of octave bands after decoding, in the layout in which they are predicted. Along time they are
    those of `InterpolatedLevels`; a band's level is kept at its centre."""

    _to_frames: Tensor
    _of_frames: Tensor

    def __init__(self, cells: Cells) -> None:
        super().__init__()
        self.register_buffer("_to_frames", torch.tensor(cells.all_frames.spread()), persistent=False)
        self.register_buffer("_of_frames", torch.tensor(cells.all_frames.pool()), persistent=False)

    def forward(self, levels: Tensor) -> Tensor:
        """(B, n) levels of bands and cells, to the same number of decoded levels."""
        columns = levels.unflatten(1, (-1, len(self._to_frames)))
        return 0.5 * torch.log(torch.exp(2 * (columns @ self._to_frames)) @ self._of_frames).flatten(1)


class PowerBalance:
    """Compares the mean power of targets and predictions, separately for pairs out of sight and in sight.

    Round a corner, the first frames are almost silent and hard to predict; in sight they are loud and easy. A common
    correction would make the former too loud. Power counts as a share of the pair's total, so that pairs near and far
    from their emitter count alike, and errors where a response is almost silent hardly count.
    """

    def __init__(self, areas: Tensor) -> None:
        """`areas` (n,): number of time-frequency bins that each level stands for."""
        self._areas = areas
        self._true, self._predicted = areas.new_zeros(2, len(areas)), areas.new_zeros(2, len(areas))

    def add(self, true: Tensor, predicted: Tensor, sight: Tensor) -> None:
        """Adds levels (B, n) of pairs with `sight` (B, 1): 1 in sight, 0 out of sight."""
        kinds = torch.cat([1 - sight, sight], dim=1).T
        power = torch.exp(2 * true)
        whole = (power @ self._areas)[:, None]
        self._true += kinds @ (power / whole)
        self._predicted += kinds @ (torch.exp(2 * predicted) / whole)

    def deficit(self) -> Tensor:
        """(2, n) what to add to predicted levels, out of sight and in sight. A kind without pairs gets the value of all
        pairs."""
        is_there = (self._true > 0).any(dim=1, keepdim=True)
        true, predicted = (torch.where(is_there, power, power.sum(dim=0)) for power in (self._true, self._predicted))
        return 0.5 * torch.log(true / predicted)


def level_correction(
    examples: Callable[[], Iterable[tuple[Tensor, Tensor, Tensor]]],
    decode: Callable[[Tensor], Tensor],
    areas: Tensor,
) -> Tensor:
    """(2, n) what to add to predicted levels, out of sight and in sight, so that the levels after `decode` have the
    same mean power as the true ones.

    examples: at every call, yields the same batches of true levels and predicted levels (B, n) and `sight` (B, 1).
    """
    correction = areas.new_zeros(2, len(areas))
    for _ in range(_STEPS):
        balance = PowerBalance(areas)
        for true, predicted, sight in examples():
            corrected = predicted + torch.lerp(correction[0], correction[1], sight)
            balance.add(true, decode(corrected), sight)
        correction += balance.deficit()
    return correction


def band_levels(levels: Tensor, areas: Tensor, bands: Tensor) -> Tensor:
    """(B, band) half the logarithms of the energies of bands, whose levels are those with a 1 in `bands` (band, n)."""
    return 0.5 * torch.log((areas * torch.exp(2 * levels)) @ bands.T)


def band_correction(hidden: Tensor, lacking: Tensor) -> Tensor:
    """(band, 1 + feature) offsets and weights by which features `hidden` (B, feature) say what the levels of bands are
    `lacking` (B, band): a ridge regression, whose penalty of each band leaves the least error to pairs that are left
    out (`sklearn.linear_model.RidgeCV`)."""
    scaler = StandardScaler()
    features = scaler.fit_transform(hidden.double().cpu().numpy())
    fitted = RidgeCV(_PENALTIES, alpha_per_target=True).fit(features, lacking.double().cpu().numpy())
    weights = fitted.coef_ / scaler.scale_
    offsets = fitted.intercept_ - weights @ scaler.mean_
    return torch.from_numpy(np.column_stack([offsets, weights])).to(hidden)
