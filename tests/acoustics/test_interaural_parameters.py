"""Parameters of what two ears hear, of noise whose correlation and delay are known in closed form."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from server.acoustics.room_parameters import (
    UnmeasurableError,
    interaural_cross_correlation,
    interaural_time_difference_s,
    level_db,
    onset_sample,
)
from tests.acoustics.decays import RATE, decaying_noise, measured


class TestInterauralCrossCorrelation:
    def test_of_identical_ears_is_one_also_when_delayed_or_inverted(self) -> None:
        left = decaying_noise(0.4, shape=())
        for right in (left, -2.0 * left, np.concatenate([np.zeros(20), left[:-20]])):
            assert_allclose(interaural_cross_correlation(np.stack([left, right]), RATE), 1.0, atol=1e-3)

    def test_is_bounded_to_one_millisecond(self) -> None:
        left = decaying_noise(0.4, shape=())
        right = np.concatenate([np.zeros(30), left[:-30]])  # 1.25 ms
        assert interaural_cross_correlation(np.stack([left, right]), RATE) < 0.2

    def test_of_independent_ears_is_small(self) -> None:
        assert interaural_cross_correlation(decaying_noise(1.0, shape=(10, 2)), RATE).mean() < 0.08

    @pytest.mark.parametrize("coherence", [0.3, 0.6, 0.9])
    def test_of_mixed_ears_is_their_coherence(self, coherence: float) -> None:
        first, second = np.moveaxis(decaying_noise(1.0, shape=(40, 2)), 1, 0)
        right = coherence * first + np.sqrt(1.0 - coherence**2) * second
        values = interaural_cross_correlation(np.stack([first, right], axis=1), RATE)
        assert_allclose(values.mean(), coherence, atol=0.02)

    @pytest.mark.parametrize(("start_s", "end_s"), [(0.0, None), (0.0, 0.080), (0.080, None)])
    def test_agrees_with_the_definition(self, start_s: float, end_s: float | None) -> None:
        ir = decaying_noise(0.3, seed=3)
        ir[1] = 0.5 * ir[1] + 0.5 * np.roll(ir[0], 7)
        begin = int(onset_sample(ir).min()) + round(start_s * RATE)
        stop = None if end_s is None else begin + round((end_s - start_s) * RATE)
        left, right = ir[:, begin:stop]
        correlation = np.correlate(right, left, mode="full")
        middle = len(left) - 1
        expected = np.abs(correlation[middle - 24 : middle + 25]).max() / np.sqrt((left @ left) * (right @ right))
        assert_allclose(interaural_cross_correlation(ir, RATE, start_s=start_s, end_s=end_s), expected, rtol=1e-9)

    def test_of_a_deaf_ear_is_refused(self) -> None:
        ir = decaying_noise(0.3)
        ir[1] = 0.0
        with pytest.raises(UnmeasurableError):
            interaural_cross_correlation(ir, RATE)


class TestInterauralTimeDifference:
    @pytest.mark.parametrize("expected_s", [-6e-4, -1.7e-4, 0.0, 2.3e-4, 6.4e-4])
    def test_of_a_delayed_pulse(self, expected_s: float) -> None:
        time_s = np.arange(4_800) / RATE
        pulse = np.exp(-0.5 * np.square((time_s[np.newaxis] - 0.05 - np.array([[0.0], [expected_s]])) / 1.2e-4))
        assert_allclose(interaural_time_difference_s(pulse, RATE), expected_s, atol=4e-6)

    def test_of_the_direct_sound_and_not_of_what_returns_soon_after(self) -> None:
        time_s = np.arange(4_800) / RATE
        pulses = np.zeros((2, len(time_s)))
        for at_s, itd_s, gain in ((0.05, 3e-4, 1.0), (0.0529, -5e-4, 1.6)):
            arrivals_s = np.array([[at_s], [at_s + itd_s]])
            pulses += gain * np.exp(-0.5 * np.square((time_s - arrivals_s) / 1.2e-4))
        assert_allclose(interaural_time_difference_s(pulses, RATE), 3e-4, atol=1e-5)

    def test_follows_a_measured_head(self) -> None:
        """Woodworth: a sphere of 8.75 cm at 90 degrees has 656 microseconds."""
        names = ["left_90", "left_45", "ahead", "right_45", "right_90"]
        responses = [measured(f"iosr_room_a_{name}.flac") for name in names]
        times_s = np.array([interaural_time_difference_s(ir, rate) for ir, rate in responses])
        assert_allclose(times_s, -times_s[::-1], atol=7e-5)
        assert_allclose(times_s[[0, 1, 2]], [6.56e-4, 3.8e-4, 0.0], atol=8e-5)

    def test_is_given_to_the_ear_nearer_to_the_loudspeaker(self) -> None:
        ir, rate = measured("rostock_head_left_40.flac")
        assert interaural_time_difference_s(ir, rate) < -2e-4
        left, right = level_db(ir)
        assert right > left + 3.0
