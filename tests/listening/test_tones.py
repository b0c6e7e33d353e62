"""The tones of the screening are those of Woods et al. (2017)."""

import numpy as np
import pytest

from server.listening.plan import ANTIPHASE, PLAIN, QUIET
from server.listening.tones import PAUSE_S, RATE_HZ, TONE_S, three_tones


def test_one_tone_is_6_db_quieter_and_one_has_its_channels_in_opposite_phase():
    kinds = (PLAIN, QUIET, ANTIPHASE)
    sound = three_tones(kinds).astype(float)
    step, length = round((TONE_S + PAUSE_S) * RATE_HZ), round(TONE_S * RATE_HZ)
    tones = {kind: sound[:, at * step : at * step + length] for at, kind in enumerate(kinds)}
    power = {kind: np.mean(tone**2, axis=1) for kind, tone in tones.items()}
    assert 10 * np.log10(power[PLAIN] / power[QUIET]) == pytest.approx([6, 6], abs=1e-3)
    assert power[ANTIPHASE] == pytest.approx(power[PLAIN])
    assert tones[ANTIPHASE][0] == pytest.approx(-tones[ANTIPHASE][1])
    assert tones[PLAIN][0] == pytest.approx(tones[PLAIN][1])
    # Between loudspeakers, where both channels meet, it vanishes.
    assert np.abs(tones[ANTIPHASE].sum(axis=0)).max() == 0
    spectrum = np.abs(np.fft.rfft(tones[PLAIN][0]))
    assert np.argmax(spectrum) * RATE_HZ / length == 200


def test_every_order_has_the_same_length():
    assert three_tones((QUIET, PLAIN, ANTIPHASE)).shape == three_tones((ANTIPHASE, QUIET, PLAIN)).shape
