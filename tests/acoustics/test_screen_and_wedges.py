"""The knife-edge law against the exact field round wedges: walls' ends and right-angled corners, as rooms have them.

The oracles are those of `training.trials.edge_theories`, which share no code with the law.
"""

import numpy as np
import pytest

from server.acoustics import diffraction
from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.decibels import amplitude_to_db
from training.trials.edge_theories import edge_integral, hidden_places, uniform_theory

diffraction_gain_db = np.vectorize(diffraction.diffraction_gain_db, otypes=[float])
SPEED_OF_SOUND = 343.0
WALL_END, RIGHT_ANGLE = 2.0, 1.5


def law_db(frequency, before, after, towards, away):
    straight = np.sqrt(before**2 + after**2 - 2 * before * after * np.cos(away - towards))
    return diffraction_gain_db(2 * (before + after - straight) * frequency / SPEED_OF_SOUND)


@pytest.mark.parametrize("n", [WALL_END, RIGHT_ANGLE])
@pytest.mark.parametrize("frequency", [125.0, 1000.0, 8000.0])
def test_the_two_oracles_agree(n, frequency):
    places = hidden_places(12, n, np.random.default_rng(2))
    asymptote = amplitude_to_db(np.abs(uniform_theory(frequency, *places, n, reflecting=True)))
    exact = [abs(edge_integral(frequency, *place, n)) * (place[0] + place[1]) for place in zip(*places, strict=True)]
    np.testing.assert_allclose(asymptote, amplitude_to_db(np.array(exact)), atol=0.5)


@pytest.mark.parametrize("n", [WALL_END, RIGHT_ANGLE])
@pytest.mark.parametrize("frequency", OCTAVE_BANDS_HZ)
def test_the_law_lies_between_walls_that_reflect_everything_and_nothing(n, frequency):
    """It knows no angles and no absorption: beside rigid walls it is too quiet, beside absorbing ones too loud."""
    places = hidden_places(2000, n, np.random.default_rng(3))
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
