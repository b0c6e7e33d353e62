import numpy as np
import pytest

from training.listening.loudness import loudness_lufs
from training.listening.sounds import TARGET_LUFS, auralised, common_loudness, has_low_pass, low_passed, matched

RATE = 24_000


def test_music_through_an_impulse_is_the_music_in_both_ears_until_it_fades():
    music = np.random.default_rng(1).standard_normal(RATE)
    response = np.zeros((1, 100))
    response[0, 10] = 1.0
    sound = auralised(music, response, RATE, RATE)
    assert sound.shape == (2, RATE)
    assert sound[:, 10:20_000] == pytest.approx(np.stack([music[:19_990]] * 2))
    assert np.abs(sound[:, -1]).max() < 1e-4


def test_the_low_pass_keeps_what_is_below_its_edge_and_removes_what_lies_above_4_khz():
    time_s = np.arange(RATE) / RATE
    for frequency_hz, gain_db in ((1_000, 0.0), (3_400, 0.0), (4_100, -55.0), (8_000, -55.0)):
        tone = np.stack([np.sin(2 * np.pi * frequency_hz * time_s)] * 2)
        heard = low_passed(tone, 3_500, RATE)[:, 2_000:-2_000]
        level_db = 10 * np.log10(np.mean(heard**2) / 0.5)
        assert level_db == pytest.approx(0, abs=0.1) if gain_db == 0 else level_db < gain_db
    assert not has_low_pass(3_500, 8_000)
    assert has_low_pass(3_500, 16_000)


def test_sounds_are_matched_and_never_clip():
    sound = np.random.default_rng(2).standard_normal((2, 3 * RATE)) * 0.001
    assert loudness_lufs(matched(sound, -30.0, RATE), RATE) == pytest.approx(-30.0, abs=0.01)
    assert common_loudness([0.5]) == TARGET_LUFS
    lowered = common_loudness([0.5, 2.0])
    assert 2.0 * 10 ** ((lowered - TARGET_LUFS) / 20) <= 10 ** (-1 / 20)
