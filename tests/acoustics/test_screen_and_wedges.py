"""The knife-edge law against the exact field round wedges: walls' ends and right-angled corners, as rooms have them.

Oracles: the diffracted field of an infinite rigid wedge as an integral over its edge (Svensson, Fred and Vanderkooy,
"An analytic secondary source model of edge diffraction impulse responses", J. Acoust. Soc. Am. 106, 1999, after Biot
and Tolstoy, 1957, and Medwin, 1981), and the uniform theory of diffraction (Kouyoumjian and Pathak, Proc. IEEE 62,
1974), which is the former's asymptote and can also leave out what the wedge's faces reflect. Angles are counted from
one face; the air is n pi wide.
"""

import numpy as np
import pytest
from scipy.special import fresnel

from server.acoustics import diffraction
from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import amplitude_to_db

diffraction_gain_db = np.vectorize(diffraction.diffraction_gain_db, otypes=[float])
SPEED_OF_SOUND = 343.0
WALL_END, RIGHT_ANGLE = 2.0, 1.5


def edge_integral(frequency, before, after, towards, away, n):
    """Complex pressure of a point source of unit pressure at one metre, by way of the edge."""
    wavenumber, order = 2 * np.pi * frequency / SPEED_OF_SOUND, 1 / n
    steps = np.linspace(-9, 9, 200_001)  # dense where the path over the edge is shortest
    along = np.sinh(steps) * np.sqrt(before * after) / 20
    first, second = np.hypot(before, along), np.hypot(after, along)
    spread = np.cosh(order * np.arccosh(np.maximum(1, (first * second + along**2) / (before * after))))
    directivity = 0.0
    for sign in (1, -1):
        for other in (1, -1):
            angle = order * (np.pi + sign * towards + other * away)
            directivity = directivity + np.sin(angle) / (spread - np.cos(angle))
    length = first + second
    # The far ends of the edge cancel by phase, and are faded out before the steps get too long for it.
    fade = np.exp(-(((length - before - after) * wavenumber / 2000) ** 2))
    integrand = directivity * np.exp(-1j * wavenumber * length) / (first * second) * fade
    return -order / (4 * np.pi) * np.trapezoid(integrand, along)


def uniform_theory(frequency, before, after, towards, away, n, *, reflecting):
    """The same, relative to the pressure of a source in the clear at the length of the bent path; arrays."""
    wavenumber = 2 * np.pi * frequency / SPEED_OF_SOUND
    distance = before * after / (before + after)

    def transition(x):
        sine, cosine = fresnel(np.sqrt(2 * x / np.pi))
        tail = np.sqrt(np.pi / 2) * ((0.5 - cosine) - 1j * (0.5 - sine))
        return 2j * np.sqrt(x) * np.exp(1j * x) * tail

    def term(sign, angle):
        turns = np.round((angle + sign * np.pi) / (2 * np.pi * n))
        nearness = 2 * np.cos((2 * np.pi * n * turns - angle) / 2) ** 2
        half = (np.pi + sign * angle) / (2 * n)
        return np.cos(half) / np.sin(half) * transition(wavenumber * distance * nearness)

    terms = term(1, away - towards) + term(-1, away - towards)
    if reflecting:
        terms = terms + term(1, away + towards) + term(-1, away + towards)
    coefficient = -np.exp(-1j * np.pi / 4) / (2 * n * np.sqrt(2 * np.pi * wavenumber)) * terms
    return coefficient / np.sqrt(distance)


def hidden_places(count, n, seed):
    """Distances 0.5 to 4 m before and after the edge, and angles, of pairs well in the shadow."""
    rng = np.random.default_rng(seed)
    before, after = rng.uniform(0.5, 4, (2, 60 * count))
    towards, away = rng.uniform(0.1, n * np.pi - 0.1, (2, 60 * count))
    hidden = np.flatnonzero(away - towards > np.pi + 0.05)[:count]
    assert len(hidden) == count
    return before[hidden], after[hidden], towards[hidden], away[hidden]


def law_db(frequency, before, after, towards, away):
    straight = np.sqrt(before**2 + after**2 - 2 * before * after * np.cos(away - towards))
    return diffraction_gain_db(2 * (before + after - straight) * frequency / SPEED_OF_SOUND)


@pytest.mark.parametrize("n", [WALL_END, RIGHT_ANGLE])
@pytest.mark.parametrize("frequency", [125.0, 1000.0, 8000.0])
def test_the_two_oracles_agree(n, frequency):
    places = hidden_places(12, n, seed=2)
    asymptote = amplitude_to_db(np.abs(uniform_theory(frequency, *places, n, reflecting=True)))
    exact = [abs(edge_integral(frequency, *place, n)) * (place[0] + place[1]) for place in zip(*places, strict=True)]
    np.testing.assert_allclose(asymptote, amplitude_to_db(np.array(exact)), atol=0.5)


@pytest.mark.parametrize("n", [WALL_END, RIGHT_ANGLE])
@pytest.mark.parametrize("frequency", OCTAVE_BANDS_HZ)
def test_the_law_lies_between_walls_that_reflect_everything_and_nothing(n, frequency):
    """It knows no angles and no absorption: beside rigid walls it is too quiet, beside absorbing ones too loud."""
    places = hidden_places(2000, n, seed=3)
    law = law_db(frequency, *places)
    rigid, absorbing = (
        law - amplitude_to_db(np.abs(uniform_theory(frequency, *places, n, reflecting=reflecting)))
        for reflecting in (True, False)
    )
    assert -4.0 < rigid.mean() < -0.5
    assert 1.0 < absorbing.mean() < 3.0
    for difference, lowest, highest in ((rigid, -6.0, 3.0), (absorbing, -0.5, 4.0)):
        low, high = np.quantile(difference, (0.05, 0.95))
        assert low > lowest
        assert high < highest
