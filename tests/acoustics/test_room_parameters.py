"""Room parameters against decays whose parameters are known in closed form, and against measured rooms."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from server.acoustics.decay import energy_decay
from server.acoustics.room_parameters import (
    UnmeasurableError,
    clarity_db,
    direct_to_reverberant_db,
    early_decay_time_s,
    energy_decay_db,
    interaural_cross_correlation,
    interaural_time_difference_s,
    level_db,
    measure,
    onset_sample,
    reverberation_time_s,
)
from tests.acoustics.decays import MEASURED, RATE, decaying_noise, envelope, measured


class TestReverberationTime:
    @pytest.mark.parametrize("t60_s", [0.1, 0.3, 0.6, 1.0])
    def test_of_a_smooth_exponential(self, t60_s: float) -> None:
        ir = envelope(t60_s)
        assert_allclose(reverberation_time_s(ir, RATE), t60_s, rtol=1e-3)
        assert_allclose(early_decay_time_s(ir, RATE), t60_s, rtol=1e-3)

    @pytest.mark.parametrize("t60_s", [0.15, 0.3, 0.6, 1.0])
    def test_of_decaying_noise(self, t60_s: float) -> None:
        times = reverberation_time_s(decaying_noise(t60_s, shape=(20, 2)), RATE)
        assert times.shape == (20, 2)
        assert_allclose(times, t60_s, rtol=0.04)
        assert_allclose(times.mean(), t60_s, rtol=0.01)

    @pytest.mark.parametrize("noise_db", [-50.0, -60.0, -80.0])
    def test_is_not_lengthened_by_background_noise(self, noise_db: float) -> None:
        ir = decaying_noise(0.4, shape=(20, 2))
        noise = np.random.default_rng(1).standard_normal(ir.shape) * 10.0 ** (noise_db / 20.0)
        assert_allclose(reverberation_time_s(ir + noise, RATE).mean(), 0.4, rtol=0.01)

    def test_is_refused_within_10_db_of_the_noise(self) -> None:
        ir = decaying_noise(0.4)
        noisy = ir + np.random.default_rng(1).standard_normal(ir.shape) * 10.0 ** (-40.0 / 20.0)
        assert_allclose(reverberation_time_s(noisy, RATE, decay_db=20.0), 0.4, rtol=0.05)
        with pytest.raises(UnmeasurableError, match=r"T30: needs -35 dB"):
            reverberation_time_s(noisy, RATE)

    def test_is_refused_where_the_response_ends_too_early(self) -> None:
        ir = decaying_noise(1.5)
        assert_allclose(reverberation_time_s(ir, RATE, decay_db=20.0), 1.5, rtol=0.05)
        with pytest.raises(UnmeasurableError):
            reverberation_time_s(ir, RATE)

    def test_is_not_shortened_by_truncation(self) -> None:
        """Plain backward integration of this response bends down and gives 0.95 s."""
        ir = decaying_noise(1.0, duration_s=0.6, shape=(20, 2))
        assert_allclose(reverberation_time_s(ir, RATE).mean(), 1.0, rtol=0.01)

    def test_of_stationary_noise_is_refused(self) -> None:
        with pytest.raises(UnmeasurableError):
            reverberation_time_s(np.random.default_rng(0).standard_normal((2, 16_800)), RATE)

    def test_follows_both_slopes_of_coupled_rooms(self) -> None:
        """The decay curve of a sum of exponential powers is the sum of their decay curves."""
        time_s = np.arange(16_800) / RATE
        fast, slow, share = 0.2, 0.8, 0.01
        power = 10.0 ** (-6.0 * time_s / fast) + share * 10.0 ** (-6.0 * time_s / slow)
        energy = fast * 10.0 ** (-6.0 * time_s / fast) + share * slow * 10.0 ** (-6.0 * time_s / slow)
        curve_db = 10.0 * np.log10(energy / energy[0])

        def fitted_s(upper_db: float, lower_db: float) -> float:
            inside = (curve_db <= upper_db) & (curve_db >= lower_db)
            return float(-60.0 / np.polyfit(time_s[inside], curve_db[inside], 1)[0])

        ir = np.sqrt(power)
        assert_allclose(early_decay_time_s(ir, RATE), fitted_s(0.0, -10.0), rtol=0.005)
        assert_allclose(reverberation_time_s(ir, RATE), fitted_s(-5.0, -35.0), rtol=0.005)
        assert_allclose(reverberation_time_s(ir, RATE, decay_db=20.0), fitted_s(-5.0, -25.0), rtol=0.005)
        assert reverberation_time_s(ir, RATE) > 1.5 * early_decay_time_s(ir, RATE)

    def test_survives_zero_padding(self) -> None:
        ir = decaying_noise(0.3, duration_s=0.3)
        padded = np.pad(ir, ((0, 0), (0, 9_000)))
        assert_allclose(reverberation_time_s(padded, RATE), reverberation_time_s(ir, RATE), rtol=1e-3)

    def test_survives_float16_storage(self) -> None:
        ir = 0.05 * decaying_noise(0.4)
        assert_allclose(reverberation_time_s(ir.astype(np.float16), RATE), reverberation_time_s(ir, RATE), rtol=1e-3)


class TestEarlyDecayTime:
    @pytest.mark.parametrize("t60_s", [0.2, 0.5, 1.2])
    def test_of_an_exponential_is_its_reverberation_time(self, t60_s: float) -> None:
        ir = np.tile(envelope(t60_s, 1.5 * t60_s), (2, 1))
        assert_allclose(early_decay_time_s(ir, RATE), t60_s, rtol=2e-3)

    def test_of_a_decay_that_begins_fast_is_the_fast_one(self) -> None:
        """Two slopes that cross far below -10 dB: 20 dB of the first are seen before the second takes over."""
        time_s = np.arange(round(1.2 * RATE)) / RATE
        energy = 10.0 ** (-6.0 * time_s / 0.2) + 1e-4 * 10.0 ** (-6.0 * time_s / 0.8)
        ir = np.tile(np.sqrt(energy), (2, 1))
        assert_allclose(early_decay_time_s(ir, RATE), 0.2, rtol=0.01)
        assert_allclose(reverberation_time_s(ir[:, RATE // 4 :], RATE), 0.8, rtol=0.05)

    def test_is_refused_where_the_direct_sound_is_all_there_is_above_10_db(self) -> None:
        """Ten times the energy of the rest in one sample: the curve leaps past -10 dB and has no slope."""
        ir = np.tile(envelope(0.5), (2, 1))
        ir[:, 0] = np.sqrt(11.0 * np.square(ir[0, 1:]).sum())
        with pytest.raises(UnmeasurableError):
            early_decay_time_s(ir, RATE)

    def test_of_a_response_cut_off_within_a_slow_tail(self) -> None:
        """A fast decay for 25 dB, then a tail that falls by less than 10 dB before the response ends, so that it could
        be noise: what happens above is known all the same, and the late decay is not."""
        time_s = np.arange(round(0.09 * RATE)) / RATE
        power = 10.0 ** (-6.0 * time_s / 0.03) + 1e-4 * 10.0 ** (-6.0 * time_s)
        ir = np.tile(np.sqrt(power), (2, 1))
        assert_allclose(early_decay_time_s(ir, RATE), 0.03, rtol=0.05)
        with pytest.raises(UnmeasurableError):
            reverberation_time_s(ir, RATE)


class TestClarity:
    @pytest.mark.parametrize("t60_s", [0.2, 0.5, 1.0])
    @pytest.mark.parametrize("early_s", [0.050, 0.080])
    def test_closed_form_of_an_exponential(self, t60_s: float, early_s: float) -> None:
        expected = 10.0 * np.log10(10.0 ** (6.0 * early_s / t60_s) - 1.0)
        assert_allclose(clarity_db(envelope(t60_s), RATE, early_s=early_s), expected, atol=0.02)

    def test_counts_from_the_onset(self) -> None:
        late = np.concatenate([np.zeros(5_000), envelope(0.5)])
        assert_allclose(clarity_db(late, RATE), clarity_db(envelope(0.5), RATE), atol=1e-6)

    def test_without_late_energy_is_refused(self) -> None:
        impulse = np.zeros((2, 4_800))
        impulse[:, 100] = 1.0
        with pytest.raises(UnmeasurableError, match="2 of 2"):
            clarity_db(impulse, RATE)


class TestDirectToReverberantRatio:
    @pytest.mark.parametrize("expected_db", [-12.0, 0.0, 9.0])
    def test_of_an_impulse_and_a_known_tail(self, expected_db: float) -> None:
        ir = np.zeros((2, 16_800))
        tail = decaying_noise(0.4)[:, : 16_800 - 700]
        ir[:, 700:] = tail / np.sqrt(np.square(tail).sum(axis=-1, keepdims=True))
        ir[:, 500] = 10.0 ** (expected_db / 20.0)  # 200 samples ahead of the tail
        assert_allclose(direct_to_reverberant_db(ir, RATE, onset=500), expected_db, atol=1e-3)
        assert_allclose(direct_to_reverberant_db(ir, RATE, onset=[530, 470]), expected_db, atol=1e-3)

    def test_the_direct_sound_lasts_as_long_as_stated(self) -> None:
        ir = np.zeros((1, 4_800))
        ir[0, 100] = 1.0
        ir[0, 100 + 48] = 0.5  # 2 ms later
        ir[0, 100 + 480] = 0.25
        assert_allclose(direct_to_reverberant_db(ir, RATE), 10.0 * np.log10(1.25 / 0.0625), atol=1e-6)
        assert_allclose(direct_to_reverberant_db(ir, RATE, direct_s=0.001), 10.0 * np.log10(1.0 / 0.3125), atol=1e-6)

    def test_a_louder_reflection_soon_after_is_no_direct_sound(self) -> None:
        ir = np.zeros((1, 4_800))
        ir[0, 100], ir[0, 100 + 70], ir[0, 100 + 480] = 0.5, 1.0, 0.25  # 2.9 ms later, and 20 ms
        expected_db = 10.0 * np.log10(0.25 / 1.0625)
        assert_allclose(direct_to_reverberant_db(ir, RATE, onset=100), expected_db, atol=1e-6)
        assert_allclose(direct_to_reverberant_db(ir, RATE, onset=130), expected_db, atol=1e-6)

    def test_without_a_direct_sound_where_it_is_expected_is_refused(self) -> None:
        ir = np.zeros((2, 16_800))
        ir[:, 5_000:] = decaying_noise(0.3)[:, :11_800]
        with pytest.raises(UnmeasurableError):
            direct_to_reverberant_db(ir, RATE, onset=500)


class TestOnset:
    @pytest.mark.parametrize("arrival", [0, 1, 333, 4_000])
    def test_of_an_impulse(self, arrival: int) -> None:
        ir = np.zeros((2, 4_800))
        ir[:, arrival] = [1.0, -0.3]
        assert_array_equal(onset_sample(ir), [arrival, arrival])

    def test_is_the_first_sample_within_20_db_of_the_peak(self) -> None:
        ir = np.zeros(1_000)
        ir[[100, 200, 300]] = [0.099, 0.101, 1.0]
        assert onset_sample(ir) == 200

    def test_in_a_measured_room(self) -> None:
        """6.3 m at 343 m/s is 810 samples; the turned-to ear hears it a few samples earlier than the other."""
        ir, rate = measured("rostock_head_left_40.flac")
        left, right = onset_sample(ir)
        assert 6.2 < right / rate * 343.0 < 6.9
        assert 5 < left - right < 45


class TestDecayCurve:
    @given(st.integers(0, 2**32 - 1), st.floats(0.05, 2.0), st.floats(-100.0, 0.0))
    @settings(max_examples=30)
    def test_never_rises_and_is_finite(self, seed: int, t60_s: float, noise_db: float) -> None:
        ir = decaying_noise(t60_s, seed=seed, duration_s=0.3)
        ir += np.random.default_rng(seed).standard_normal(ir.shape) * 10.0 ** (noise_db / 20.0)
        decay = energy_decay(ir, RATE)
        assert np.all(np.diff(decay.energy, axis=-1) <= 0.0)
        assert np.all(np.isfinite(decay.energy))

    def test_is_zero_db_at_the_onset_and_flat_before(self) -> None:
        ir = np.concatenate([np.zeros((2, 500)), decaying_noise(0.3)], axis=-1)
        curve = energy_decay_db(ir, RATE)
        assert_allclose(curve[:, :500], 0.0, atol=1e-9)

    def test_of_a_noiseless_decay_is_the_plain_backward_integral(self) -> None:
        ir = decaying_noise(0.2)
        plain = np.cumsum(np.square(ir[:, ::-1]), axis=-1)[:, ::-1]
        expected = 10.0 * np.log10(plain / plain[:, :1])
        audible = expected > -80.0
        assert_allclose(energy_decay_db(ir, RATE)[audible], expected[audible], atol=0.05)


class TestMeasuredRooms:
    @pytest.mark.parametrize("name", ["left_90", "left_45", "ahead", "right_45", "right_90"])
    def test_office_reverberation_time_is_the_published_one(self, name: str) -> None:
        ir, rate = measured(f"iosr_room_a_{name}.flac")
        assert_allclose(reverberation_time_s(ir, rate), 0.32, rtol=0.12)

    def test_turning_towards_the_loudspeaker_raises_clarity_and_direct_sound(self) -> None:
        ir, rate = measured("iosr_room_a_left_90.flac")
        assert clarity_db(ir, rate)[0] > clarity_db(ir, rate)[1] + 5.0
        assert direct_to_reverberant_db(ir, rate)[0] > direct_to_reverberant_db(ir, rate)[1] + 5.0

    def test_ears_agree_most_for_a_source_ahead(self) -> None:
        ahead, side = (measured(f"iosr_room_a_{name}.flac") for name in ("ahead", "left_90"))
        assert interaural_cross_correlation(*ahead) > 0.6 > interaural_cross_correlation(*side)


class TestMeasure:
    def test_agrees_with_the_single_functions(self) -> None:
        ir = decaying_noise(0.4, shape=(3, 2))
        together = measure(ir, RATE)
        assert_array_equal(together.reverberation_time_s, reverberation_time_s(ir, RATE))
        assert_array_equal(together.early_decay_time_s, early_decay_time_s(ir, RATE))
        assert_array_equal(together.clarity_db, clarity_db(ir, RATE))
        assert_array_equal(together.direct_to_reverberant_db, direct_to_reverberant_db(ir, RATE))
        assert_array_equal(together.level_db, level_db(ir))
        assert_array_equal(together.interaural_cross_correlation, interaural_cross_correlation(ir, RATE))
        assert_array_equal(
            together.early_interaural_cross_correlation, interaural_cross_correlation(ir, RATE, end_s=0.080)
        )
        assert_array_equal(together.interaural_time_difference_s, interaural_time_difference_s(ir, RATE))
        assert set(together.missing().values()) == {0}

    def test_counts_what_cannot_be_measured_and_goes_on(self) -> None:
        ir = decaying_noise(0.4, shape=(3, 2))
        ir[1, 0] = 0.0
        parameters = measure(ir, RATE)
        missing = parameters.missing()
        assert missing["reverberation_time_s"] == missing["onset_s"] == missing["level_db"] == 1
        assert missing["interaural_cross_correlation"] == 1
        assert np.isfinite(parameters.reverberation_time_s[[0, 2]]).all()

    def test_one_microphone_has_all_but_what_compares_two_ears(self) -> None:
        ir = decaying_noise(0.4, shape=(3, 2))
        both, left = measure(ir, RATE), measure(ir[:, :1], RATE)
        for name, values in vars(left).items():
            if name.startswith(("inter", "early_inter")):
                assert values.shape == (3,)
                assert np.isnan(values).all()
            else:
                assert_array_equal(values, getattr(both, name)[:, :1])

    @given(st.integers(0, 2**32 - 1), st.floats(-60.0, 60.0))
    @settings(max_examples=20)
    def test_gain_changes_the_level_only(self, seed: int, gain_db: float) -> None:
        ir = decaying_noise(0.3, seed=seed)
        plain, scaled = measure(ir, RATE), measure(ir * 10.0 ** (gain_db / 20.0), RATE)
        for name, values in vars(plain).items():
            shift = gain_db if name == "level_db" else 0.0
            assert_allclose(getattr(scaled, name), values + shift, rtol=1e-6, atol=1e-9, err_msg=name)

    @given(st.integers(0, 2**32 - 1), st.integers(0, 3_000))
    @settings(max_examples=20)
    def test_delay_changes_the_onset_only(self, seed: int, delay: int) -> None:
        ir = decaying_noise(0.3, seed=seed, duration_s=0.4)
        ir[:, 0] = 4.0
        plain = measure(np.pad(ir, ((0, 0), (100, 0))), RATE)
        late = measure(np.pad(ir, ((0, 0), (100 + delay, 0))), RATE)
        for name, values in vars(plain).items():
            shift = delay / RATE if name == "onset_s" else 0.0
            # The windows of the noise estimate move against the response, so late energies agree to a fraction only.
            assert_allclose(getattr(late, name), values + shift, rtol=2e-3, atol=2e-3, err_msg=name)


class TestBadInput:
    @pytest.mark.parametrize(
        "parameter",
        [reverberation_time_s, early_decay_time_s, clarity_db, direct_to_reverberant_db, energy_decay_db],
    )
    def test_silence_is_unmeasurable(self, parameter) -> None:
        with pytest.raises(UnmeasurableError):
            parameter(np.zeros((2, 4_800)), RATE)

    def test_silence_has_no_onset_and_no_level(self) -> None:
        assert_array_equal(onset_sample(np.zeros((2, 100))), [-1, -1])
        with pytest.raises(UnmeasurableError):
            level_db(np.zeros((2, 100)))

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_samples_that_are_not_finite_are_an_error_not_a_missing_value(self, bad: float) -> None:
        ir = decaying_noise(0.3)
        ir[1, 77] = bad
        with pytest.raises(ValueError, match="not finite"):
            measure(ir, RATE)

    @pytest.mark.parametrize("channels", [0, 3])
    def test_other_than_one_or_two_channels_are_refused(self, channels: int) -> None:
        with pytest.raises(ValueError, match="binaural"):
            measure(np.zeros((channels, 4_800)), RATE)

    def test_ears_are_not_compared_where_there_is_one(self) -> None:
        with pytest.raises(ValueError, match="binaural"):
            interaural_cross_correlation(decaying_noise(0.3, shape=(1,)), RATE)

    def test_empty_response(self) -> None:
        with pytest.raises(ValueError, match="at least one sample"):
            onset_sample(np.zeros((2, 0)))


class TestMarkedEchoes:
    """dEchorate: when the direct sound and the first reflections arrive was marked by people."""

    @pytest.fixture
    def room(self) -> dict[str, npt.NDArray[np.float64]]:
        with np.load(MEASURED / "dechorate.npz") as arrays:
            return {name: arrays[name] for name in arrays.files}

    def test_onset_is_the_rise_to_the_marked_direct_sound(self, room) -> None:
        """Marks are on peaks; the rise to them takes a tenth of a millisecond."""
        onset_s = onset_sample(room["responses"]) / int(room["sample_rate"])
        early_s = room["direct_s"] - onset_s
        assert np.all((early_s > 0.0) & (early_s < 150e-6))

    def test_the_energy_falls_across_strong_echoes(self, room) -> None:
        """The decay curve falls by more across the marks of ceiling and south wall, which the loudspeaker points at,
        than across as long a stretch of time elsewhere."""
        rate = int(room["sample_rate"])
        half = round(4e-4 * rate)
        curves = energy_decay_db(room["responses"], rate)
        for surface, name in ((5, "ceiling"), (2, "south wall")):
            ranks = []
            for curve, direct_s, reflected_s in zip(curves, room["direct_s"], room["reflected_s"], strict=True):
                fall = curve[: -2 * half] - curve[2 * half :]  # centred on each sample from `half` on
                elsewhere = fall[round((direct_s + 1.5e-3) * rate) - half : round(0.028 * rate) - half]
                ranks.append(np.mean(fall[round(reflected_s[surface] * rate) - half] > elsewhere))
            assert np.median(ranks) > 0.75, name
            assert min(ranks) > 0.6, name
