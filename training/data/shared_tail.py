"""One late tail for all receivers of a room, where late reverberation is the same at every place.

Energies have the axes (direction, band, bin), with bins of HISTOGRAM_BIN_S, as in `training.simulation.tracing`.
Receivers share the energies and their directions; the noise that a response is drawn with is its own. Pairs that are
trained on have a tail of their own, traced with other rays: what is learned from them must not be, bin by bin, what the
held-out pairs are compared with.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from training.data.scene_file import HISTOGRAM_BIN_S

_Floats = npt.NDArray[np.float64]
_Singles = npt.NDArray[np.float32]

TRAINING = 2
"""The number of the tail of pairs that are trained on; those before it are of the two takes of held-out pairs."""

# Crossfade from a receiver's own sound to the shared tail, at constant power.
FADE_S = 0.010


def shared_power(times_s: _Floats, start_s: float) -> _Floats:
    """(...,) the share of the power that comes from the shared tail at each time."""
    return np.asarray(np.sin(np.pi / 2 * np.clip((times_s - start_s) / FADE_S, 0, 1)) ** 2)


@dataclass(frozen=True)
class SharedTail:
    """`energies` (tail, direction, band, bin) are the same for each receiver and have the same directions at all times.
    They are used from `start_s` on. There is a tail for each take of the held-out pairs and one for the training pairs,
    which the two takes of older files lack."""

    start_s: float
    energies: _Singles

    @classmethod
    def of(cls, energies: _Floats, start_s: float) -> "SharedTail":
        """The tails of traced `energies` (tail, direction, band, bin), of which the part before `start_s` is not used.
        Directions are those of both takes together, because few rays bring the end; those of the training pairs' tail
        are its own."""
        first = int(start_s / HISTOGRAM_BIN_S)
        parts = [_one_direction_at_all_times(part, first) for part in (energies[:TRAINING], energies[TRAINING:])]
        return cls(start_s, np.concatenate(parts))

    def number(self, take: int, *, held_out: bool) -> int:
        """The number of the tail of a pair in one of the takes."""
        return take if held_out or len(self.energies) <= TRAINING else TRAINING

    def join(self, number: int, own: _Singles) -> _Singles:
        """(direction, band, bin) energy of the whole response with the tail of this number, from the `own` energy of
        its first bins."""
        tail = self.energies[number]
        share = shared_power((np.arange(tail.shape[-1]) + 0.5) * HISTOGRAM_BIN_S, self.start_s).astype(np.float32)
        energy = tail * share
        known = own.shape[-1]
        energy[..., :known] += own * (1 - share[:known])
        return energy


def _one_direction_at_all_times(energies: _Floats, first: int) -> _Singles:
    """(tail, direction, band, bin) the same energies, with the directions that those from bin `first` on have
    together."""
    late = energies[..., first:].sum(axis=(0, -1))
    total = late.sum(axis=0)
    directional = np.divide(late, total, out=np.full_like(late, 1 / len(late)), where=total > 0)
    return np.asarray(directional[..., None] * energies.sum(axis=1)[:, None], np.float32)
