import numpy as np
import pytest
import scipy.signal

from server.acoustics.audibility import ratio_in_jnd
from server.acoustics.difference import MOST_JND, audible_difference

RATE = 24_000
ONSET_S = 0.01


def response(*, direct: float = 1.0, reverberant: float = 0.3, t60_s: float = 0.5, seed: int = 0) -> np.ndarray:
    """A direct sound and noise that decays after it; `reverberant` is its energy."""
    time_s = np.arange(RATE) / RATE
    noise = np.random.default_rng(seed).standard_normal((2, RATE)) * 10 ** (-3 * (time_s - ONSET_S) / t60_s)
    noise[:, time_s < ONSET_S + 0.003] = 0
    noise *= np.sqrt(reverberant / np.maximum(np.sum(noise**2, axis=-1, keepdims=True), 1e-300))
    noise[:, round(ONSET_S * RATE)] += direct
    return noise


def difference(reference: np.ndarray, heard: np.ndarray) -> dict[str, float]:
    return audible_difference(reference, heard, RATE, onset_s=ONSET_S)


def test_nothing_differs_from_itself():
    assert set(difference(response(), response()).values()) == {0.0}


def test_a_decibel_of_level_is_one_jnd_of_level_and_of_every_third():
    louder = difference(response(), response() * 10 ** (1 / 20))
    assert louder["level"] == pytest.approx(1, abs=1e-6)
    assert louder["spectrum"] == pytest.approx(1, abs=1e-6)
    assert louder["drr"] == pytest.approx(0, abs=1e-6)


def test_a_ratio_counts_on_its_scale():
    heard = difference(response(reverberant=0.5), response(reverberant=0.25))
    low, high = (ratio_in_jnd("drr", -10 * np.log10(energy)) for energy in (0.5, 0.25))
    assert heard["drr"] == pytest.approx(high - low, rel=0.02)


def test_decays_count_in_twentieths():
    heard = difference(response(direct=0.3, t60_s=0.5), response(direct=0.3, t60_s=0.55))
    assert heard["t60"] == pytest.approx(2, rel=0.1)
    assert heard["edt"] > 1


def test_decays_that_are_not_heard_do_not_count():
    heard = difference(response(reverberant=0.001), response(reverberant=0.001, t60_s=0.8))
    assert not {"edt", "t60"} & set(heard)


def test_reverberation_twenty_two_decibels_down_is_not_missed_and_eighteen_down_is():
    for level_db, is_heard in ((-22, False), (-18, True)):
        with_it = response(reverberant=10 ** (level_db / 10))
        assert (difference(with_it, response(reverberant=0))["drr"] > 1) is is_heard


def test_one_band_is_found_by_the_spectrum():
    filtered = scipy.signal.sosfilt(
        scipy.signal.butter(2, (3_000, 5_000), "bandstop", output="sos", fs=RATE), response(), axis=-1
    )
    assert difference(response(), filtered)["spectrum"] > 6


def test_ears_that_hear_the_same_are_another_correlation():
    both = response(direct=0.0)
    heard = audible_difference(both, np.repeat(both[:1], 2, axis=0), RATE, onset_s=ONSET_S)
    assert heard["iacc"] > 5


def test_a_later_ear_is_tens_of_jnd():
    later = response(reverberant=0.0)
    later[1] = np.roll(later[1], 6)
    assert difference(response(reverberant=0.0), later)["itd"] == pytest.approx(6e6 / RATE / 10, abs=0.7)


def test_what_is_missing_is_many_jnd_and_no_infinity():
    heard = difference(response(), np.zeros((2, RATE)))
    assert heard["level"] == MOST_JND
    assert all(np.isfinite(jnd) for jnd in heard.values())


def test_one_microphone_has_no_ears_to_compare():
    heard = audible_difference(response()[:1], response(seed=1)[:1], RATE, onset_s=ONSET_S)
    assert not {"itd", "ild", "iacc"} & set(heard)


def test_other_shapes_are_refused():
    with pytest.raises(ValueError, match="cannot be compared"):
        difference(response(), response()[:, :-1])
