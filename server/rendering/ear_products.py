"""What a head's two ears hear of sound whose directions are known as spherical harmonics.

A plane wave from a direction has a spectrum at each ear. Sound from many directions, with independent phases, has at a
frequency the power of the left ear, that of the right ear, and a cross-spectrum between both. All three are sums over
directions of the wave's power times a product of the two ears' spectra. So they are linear in the spherical harmonics
of the arriving power, and one small matrix per frequency says all about a head.

Directions in the head's frame: x ahead, y left, z up. Harmonics are ACN and SN3D (`server.acoustics.
spherical_harmonics`). Axes: bins from 0 to half the sample rate; products left power, right power, real and imaginary
part of left times conjugate right.
"""

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from server.acoustics.spherical_harmonics import even_directions, mean_squares, real_harmonics
from server.rendering.hrtf import HeadFilters
from server.rendering.sphere import find_triangle

_Floats = npt.NDArray[np.float64]

PRODUCTS = 4
_DIRECTIONS = 2000
_AT_ONCE = 250


@dataclass(frozen=True, eq=False)
class EarProducts:
    """The products (bin, product, k) by which powers in harmonics k become those of a head's ears, up to `order`."""

    order: int
    matrix: _Floats

    @classmethod
    def of(cls, filters: HeadFilters, *, bins: int, order: int) -> "EarProducts":
        """Compute the products of a head, a tenth of a second of work; for the same head they are kept.

        Raises ValueError for an order that `server.acoustics.spherical_harmonics` does not have.
        """
        kept = _KEPT.setdefault(filters, {})
        if (bins, order) not in kept:
            kept[bins, order] = cls(order, _project(filters, bins, order))
        return kept[bins, order]


_KEPT: "WeakKeyDictionary[HeadFilters, dict[tuple[int, int], EarProducts]]" = WeakKeyDictionary()


def _project(filters: HeadFilters, bins: int, order: int) -> _Floats:
    """(bin, product, k) the means over all directions of the ears' products times each harmonic, divided by the mean
    square of the harmonic. A function sum_k P_k Y_k / mean_square_k has the moments P_k."""
    directions = even_directions(_DIRECTIONS)
    harmonics = real_harmonics(directions, order) / mean_squares(order)
    total = np.zeros((bins, PRODUCTS, harmonics.shape[-1]))
    for start in range(0, len(directions), _AT_ONCE):
        part = slice(start, start + _AT_ONCE)
        left, right = np.moveaxis(wave_spectra(filters, directions[part], bins), 1, 0)
        cross = left * np.conj(right)
        products = np.stack([np.abs(left) ** 2, np.abs(right) ** 2, cross.real, cross.imag])
        total += np.einsum("pdf,dk->fpk", products, harmonics[part], optimize=True)
    return total / len(directions)


def wave_spectra(filters: HeadFilters, directions: _Floats, bins: int) -> npt.NDArray[np.complex128]:
    """(direction, ear, bin) spectra of waves from these directions: interpolated minimum phase and delay."""
    mesh = filters.triangulation
    weights = np.empty((len(directions), 3))
    corners = np.empty((len(directions), 3), dtype=np.int64)
    triangle = 0
    for row, direction in enumerate(directions):
        triangle = find_triangle(mesh.across, mesh.inverses, direction, triangle, weights[row])
        corners[row] = mesh.triangles[triangle]
    cepstra = np.einsum("dc,dcet->det", weights, filters.cepstra[corners])
    delays = np.einsum("dc,dce->de", weights, filters.delays_s[corners]) * filters.sample_rate
    n_fft = 2 * (bins - 1)
    size = n_fft * -(-filters.taps // n_fft)  # a multiple, so that every step-th bin is one of ours
    logarithms = np.fft.rfft(cepstra, size)[..., :: size // n_fft]
    turns = np.exp(-2j * np.pi / n_fft * np.arange(bins) * delays[..., None])
    return np.asarray(np.exp(logarithms) * turns)
