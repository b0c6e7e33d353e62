"""A loss on energies, from which clarity, decay times and levels follow.

Errors of single bins that have the same sign do not average out in a sum, and listeners hear sums. So the loss also
compares energies of runs of frames, and the energy still to come after each frame, by octave and over all octaves.

Axes: levels are natural logarithms of magnitude, flat in the heads' layout; energies are (B, channel, octave, step).
"""

from abc import ABC, abstractmethod

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from server.acoustics.bands import OCTAVE_BANDS_HZ
from training.models.basis_field import Layout
from training.models.cells import Cells

# For the Rayleigh-distributed magnitude of noise, the mean of ln |S| lies half of Euler's constant below the logarithm
# of the root mean square.
RAYLEIGH_DEFICIT = float(np.euler_gamma / 2)
_RUN = 4
_EVERY = 4
_TINY = 1e-12


class _ErrorOfSums(nn.Module, ABC):
    """Mean squared differences of energies, in squared nepers of amplitude.

    `deficit` is how far the predicted levels of single bins lie below those of their expected power.
    """

    def __init__(self, fine_frames: int, deficit: float) -> None:
        super().__init__()
        self._fine_frames, self._deficit = fine_frames // _RUN * _RUN, deficit

    def forward(self, predicted: Tensor, target: Tensor) -> Tensor:
        """(B,) the errors of flat levels (B, size of `heads.levels`) in physical units."""
        ours, theirs = self._energies(predicted, self._deficit), self._energies(target, 0.0)
        squared = [(a - b).square().flatten(1).mean(dim=1) for a, b in zip(ours, theirs, strict=True)]
        return torch.stack(squared).sum(dim=0)

    def _energies(self, flat: Tensor, deficit: float) -> list[Tensor]:
        """Half the logarithms of three kinds of energy: the energy still to come by octave, the same summed over
        octaves, and that of runs of fine frames by octave."""
        by_octave = self._by_octave(flat, deficit)
        to_come = by_octave.flip(-1).cumsum(-1).flip(-1)
        runs = by_octave[..., : self._fine_frames].unflatten(-1, (-1, _RUN)).sum(-1)
        picked = to_come[..., ::_EVERY]
        return [0.5 * torch.log(energy + _TINY) for energy in (picked, picked.sum(-2), runs)]

    @abstractmethod
    def _by_octave(self, flat: Tensor, deficit: float) -> Tensor:
        """Energies (B, ..., octave, step) of flat levels that lie `deficit` too low."""


class EnergyError(_ErrorOfSums):
    """The error at the ears, whose levels are those of bins."""

    _of_bins: Tensor
    _of_cells: Tensor
    _widths: Tensor

    def __init__(self, cells: Cells, heads: Layout, *, deficit: float) -> None:
        super().__init__(cells.fine_frames, deficit)
        self._shapes = {name: (heads.slices[name], heads.shapes[name]) for name in ("fine", "late")}
        codec = cells.codec
        bins_hz = np.arange(codec.bins) * codec.sample_rate / codec.n_fft
        centres = (cells.bands.edges[:-1] + cells.bands.edges[1:] - 1) / 2
        cells_hz = centres * codec.sample_rate / codec.n_fft
        for name, sums in (
            ("_of_bins", _octaves(bins_hz)),
            ("_of_cells", _octaves(cells_hz) * cells.bands.widths),
            ("_widths", cells.late_frames.widths),
        ):
            self.register_buffer(name, torch.tensor(np.asarray(sums, dtype=np.float32)), persistent=False)

    def _by_octave(self, flat: Tensor, deficit: float) -> Tensor:
        """(B, channel, octave, step)"""
        fine, late = (torch.exp(2 * flat[:, part].unflatten(1, shape)) for part, shape in self._shapes.values())
        return torch.cat([self._of_bins @ fine * np.exp(2 * deficit), self._of_cells @ late * self._widths], dim=-1)


class BandEnergyError(_ErrorOfSums):
    """The error of a directional field, whose levels are those of octave bands. Each band counts alike."""

    _widths: Tensor

    def __init__(self, cells: Cells) -> None:
        super().__init__(cells.fine_frames, 0.0)
        widths = torch.tensor(cells.all_frames.widths, dtype=torch.float32)
        self.register_buffer("_widths", widths, persistent=False)

    def _by_octave(self, flat: Tensor, deficit: float) -> Tensor:
        """(B, octave, step)"""
        return torch.exp(2 * (flat.unflatten(1, (-1, len(self._widths))) + deficit)) * self._widths


def _octaves(frequencies_hz: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
    """Return a matrix (octave, frequency) with 1 where the centre of this octave band is the nearest on a logarithmic
    scale, else 0."""
    distance = np.abs(np.log2(np.maximum(frequencies_hz, 1.0)) - np.log2(OCTAVE_BANDS_HZ)[:, None])
    return np.asarray(np.argmin(distance, axis=0) == np.arange(len(OCTAVE_BANDS_HZ))[:, None], dtype=np.float64)
