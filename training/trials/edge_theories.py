"""What is known of diffraction at edges, to compare the knife-edge law of `server.acoustics.diffraction` with.

The field of an infinite rigid wedge as an integral over its edge (Svensson, Fred and Vanderkooy, "An analytic secondary
source model of edge diffraction impulse responses", J. Acoust. Soc. Am. 106, 1999, after Biot and Tolstoy, 1957, and
Medwin, 1981); the uniform theory of diffraction (Kouyoumjian and Pathak, Proc. IEEE 62, 1974), which is the former's
asymptote and can also leave out what the wedge's faces reflect; and Maekawa's measurements.

Angles are counted from one face; the air is n pi wide, and a half-plane has n = 2. `before` and `after` the edge are
metres, frequencies Hz.
"""

from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import fresnel

from training.data.dataset import SPEED_OF_SOUND

_Floats = npt.NDArray[np.float64]
_Complex = npt.NDArray[np.complex128]

MAEKAWA_LOSS_DB: Final = {
    -0.3: 0.0,
    -0.1: 2.8,
    0.0: 5.0,
    0.1: 7.5,
    0.5: 11.0,
    1.0: 13.0,
    3.0: 17.5,
    10.0: 23.0,
    100.0: 33.0,
}
"""Losses by Fresnel number, read off the measured curve of Maekawa, "Noise reduction by screens", Applied Acoustics 1
(1968), figure 3."""


def edge_integral(frequency: float, before: float, after: float, towards: float, away: float, n: float) -> complex:
    """Complex pressure of a point source of unit pressure at one metre, by way of the edge."""
    wavenumber, order = 2 * np.pi * frequency / SPEED_OF_SOUND, 1 / n
    steps = np.linspace(-9, 9, 200_001)  # dense where the path over the edge is shortest
    along = np.sinh(steps) * np.sqrt(before * after) / 20
    first, second = np.hypot(before, along), np.hypot(after, along)
    spread = np.cosh(order * np.arccosh(np.maximum(1, (first * second + along**2) / (before * after))))
    directivity = np.zeros(len(along))
    for sign in (1, -1):
        for other in (1, -1):
            angle = order * (np.pi + sign * towards + other * away)
            directivity += np.sin(angle) / (spread - np.cos(angle))
    length = first + second
    # The far ends of the edge cancel by phase, and are faded out before the steps get too long for it.
    fade = np.exp(-(((length - before - after) * wavenumber / 2000) ** 2))
    integrand = directivity * np.exp(-1j * wavenumber * length) / (first * second) * fade
    return complex(-order / (4 * np.pi) * np.trapezoid(integrand, along))


def uniform_theory(
    frequency: float, before: _Floats, after: _Floats, towards: _Floats, away: _Floats, n: float, *, reflecting: bool
) -> _Complex:
    """(pair,) the same, relative to the pressure of a source in the clear at the length of the bent path."""
    wavenumber = 2 * np.pi * frequency / SPEED_OF_SOUND
    distance = before * after / (before + after)

    def transition(x: _Floats) -> _Complex:
        sine, cosine = fresnel(np.sqrt(2 * x / np.pi))
        tail = np.sqrt(np.pi / 2) * ((0.5 - cosine) - 1j * (0.5 - sine))
        return np.asarray(2j * np.sqrt(x) * np.exp(1j * x) * tail)

    def term(sign: int, angle: _Floats) -> _Complex:
        turns = np.round((angle + sign * np.pi) / (2 * np.pi * n))
        nearness = 2 * np.cos((2 * np.pi * n * turns - angle) / 2) ** 2
        half = (np.pi + sign * angle) / (2 * n)
        return np.asarray(np.cos(half) / np.sin(half) * transition(wavenumber * distance * nearness))

    terms = term(1, away - towards) + term(-1, away - towards)
    if reflecting:
        terms = terms + term(1, away + towards) + term(-1, away + towards)
    coefficient = -np.exp(-1j * np.pi / 4) / (2 * n * np.sqrt(2 * np.pi * wavenumber)) * terms
    return np.asarray(coefficient / np.sqrt(distance))


def hidden_places(count: int, n: float, rng: np.random.Generator) -> tuple[_Floats, _Floats, _Floats, _Floats]:
    """(pair,) distances of 0.5 to 4 m before and after the edge, and angles, of pairs well in the shadow."""
    before, after = rng.uniform(0.5, 4, (2, 60 * count))
    towards, away = rng.uniform(0.1, n * np.pi - 0.1, (2, 60 * count))
    hidden = np.flatnonzero(away - towards > np.pi + 0.05)[:count]
    if len(hidden) < count:
        raise ValueError(f"n: of a wedge of {n:g} pi, only {len(hidden)} of {count} pairs are hidden")
    return before[hidden], after[hidden], towards[hidden], away[hidden]
