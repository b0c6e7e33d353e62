"""One late tail for all receivers of a room, where late reverberation is the same at every place.

Energies have the axes (direction, band, bin), with bins of HISTOGRAM_BIN_S, as in `training.simulation.tracing`.
Receivers share the energies and their directions; the noise that a response is drawn with is its own.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from training.data.scene_file import HISTOGRAM_BIN_S

_Floats = npt.NDArray[np.float64]
_Singles = npt.NDArray[np.float32]

# Crossfade from a receiver's own sound to the shared tail, at constant power.
FADE_S = 0.010


def shared_power(times_s: _Floats, start_s: float) -> _Floats:
    """(...,) the share of the power that comes from the shared tail at each time."""
    return np.asarray(np.sin(np.pi / 2 * np.clip((times_s - start_s) / FADE_S, 0, 1)) ** 2)


@dataclass(frozen=True)
class SharedTail:
    """`energies` (take, direction, band, bin) are the same for each receiver and have the same directions at all times.
    They are used from `start_s` on."""

    start_s: float
    energies: _Singles

    @classmethod
    def of(cls, energies: _Floats, start_s: float) -> "SharedTail":
        """The tail of traced `energies` (take, direction, band, bin), of which the part before `start_s` is not used.
        Directions are those of all takes together, because few rays bring the end."""
        late = energies[..., int(start_s / HISTOGRAM_BIN_S) :].sum(axis=(0, -1))
        total = late.sum(axis=0)
        directional = np.divide(late, total, out=np.full_like(late, 1 / len(late)), where=total > 0)
        of_all = energies.sum(axis=1)
        return cls(start_s, (directional[..., None] * of_all[:, None]).astype(np.float32))

    def join(self, take: int, own: _Singles) -> _Singles:
        """(direction, band, bin) energy of the whole response, from the `own` energy of its first bins."""
        tail = self.energies[take]
        share = shared_power((np.arange(tail.shape[-1]) + 0.5) * HISTOGRAM_BIN_S, self.start_s).astype(np.float32)
        energy = tail * share
        known = own.shape[-1]
        energy[..., :known] += own * (1 - share[:known])
        return energy
