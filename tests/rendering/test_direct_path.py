"""The direct path of emitters at rest: delay, level, and what the head does, against the measured responses."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from server.acoustics.air import absorption_db_per_m
from server.acoustics.bands import FILTER_BANDS_HZ, OCTAVE_BANDS_HZ, in_filter_bands
from server.acoustics.decibels import amplitude_to_db, power_to_db
from server.rendering.direct_path import NEAR_LIMIT_M, PathTarget

SPEED_OF_SOUND = 343.0
LEVEL = (0.0, 0.0, 0.0, 1.0)
AHEAD = (1.0, 0.0, 0.0)
FLAT = np.zeros(7)
RATES = [16_000, 24_000, 44_100, 48_000]


def at(length_m=2.0, arrival=AHEAD, band_gain_db=FLAT):
    return PathTarget(length_m, arrival, band_gain_db)


def play(path, signal):
    """(2, samples) of one emitter; targets stay as they are."""
    size = path.block_size
    blocks = -(-len(signal) // size)
    padded = np.zeros(blocks * size, np.float32)
    padded[: len(signal)] = signal
    out = np.zeros((2, padded.size), np.float32)
    for start in range(0, padded.size, size):
        path.process(padded[None, start : start + size], out[:, start : start + size])
    return out[:, : len(signal)]


def spectrum(response, frequency_hz, sample_rate):
    samples = np.arange(response.shape[-1])
    return response @ np.exp(-2j * np.pi * np.outer(samples, np.atleast_1d(frequency_hz)) / sample_rate)


@pytest.mark.parametrize("sample_rate", RATES)
@pytest.mark.parametrize("length_m", [0.5, 1.0, 3.43, 12.3456, 150.0])
def test_time_of_flight_is_that_of_the_distance(make_path, length_m, sample_rate):
    path = make_path(head=False, sample_rate=sample_rate)
    response = path.impulse_response(at(length_m), LEVEL, sample_rate)
    frequency = np.array([0.05, 0.1, 0.3, 0.35]) * sample_rate
    delay_s = length_m / SPEED_OF_SOUND
    turned = spectrum(response, frequency, sample_rate) * np.exp(2j * np.pi * frequency * delay_s)
    # To a thousandth of a sample, at any frequency: no phase is left, and the level is that of the distance.
    np.testing.assert_allclose(turned * length_m, 1, atol=1e-4)


@pytest.mark.parametrize("sample_rate", RATES)
def test_through_the_head_sound_from_ahead_begins_after_its_way(make_path, sample_rate):
    path = make_path(sample_rate=sample_rate)
    for delay in (50, 333, 1234):
        response = np.abs(path.impulse_response(at(delay / sample_rate * SPEED_OF_SOUND), LEVEL, sample_rate // 4))
        onset = np.argmax(response > 0.1 * response.max(axis=-1, keepdims=True), axis=-1)
        np.testing.assert_allclose(onset, delay, atol=1)


def test_pressure_falls_with_distance_down_to_the_near_limit(make_path):
    path = make_path()
    rms = {
        length: np.sqrt(np.sum(path.impulse_response(at(length), LEVEL, 48_000) ** 2))
        for length in (0.0, 0.1, NEAR_LIMIT_M, 0.5, 1.0, 2.0, 8.0, 100.0)
    }
    for length, level in rms.items():
        # Where a response falls between samples does not matter but for the last of its treble.
        assert level / rms[1.0] == pytest.approx(1 / max(length, NEAR_LIMIT_M), rel=2e-3)


@pytest.mark.parametrize(("sample_rate", "bands_hz"), [(24_000, OCTAVE_BANDS_HZ), (48_000, FILTER_BANDS_HZ)])
def test_air_takes_what_the_standard_says(make_path, sample_rate, bands_hz):
    air = absorption_db_per_m(np.array(bands_hz))
    path = make_path(sample_rate=sample_rate, air_db_per_m=air)
    dry = make_path(sample_rate=sample_rate)
    samples = sample_rate // 2
    for length_m in (10.0, 100.0):
        lost = amplitude_to_db(
            np.abs(spectrum(dry.impulse_response(at(length_m), LEVEL, samples), bands_hz, sample_rate))
            / np.abs(spectrum(path.impulse_response(at(length_m), LEVEL, samples), bands_hz, sample_rate))
        )
        np.testing.assert_allclose(lost, np.stack([air * length_m] * 2), atol=0.25)


@pytest.mark.parametrize("bands", [6, 9])
def test_air_has_a_value_for_each_band(bands):
    with pytest.raises(ValueError, match="air_db_per_m must have a value for each octave band"):
        in_filter_bands(np.zeros(bands))


@pytest.mark.parametrize("sample_rate", [24_000, 48_000])
@pytest.mark.parametrize(
    "gain_db",
    [
        np.linspace(0, -24, 7),  # a screen
        np.array([0, 0, -1, -3, -6, -10, -15.0]),  # a loudspeaker's back
        np.full(7, -60.0),
        np.array([-9, -6, -3, 0, -3, -6, -9.0]),
    ],
)
def test_band_gains_are_those_asked_for(make_path, gain_db, sample_rate):
    path = make_path(head=False, taps=round(0.004 * sample_rate), sample_rate=sample_rate)
    response = path.impulse_response(at(1.0, band_gain_db=gain_db), LEVEL, 2048)
    got = amplitude_to_db(np.abs(spectrum(response, OCTAVE_BANDS_HZ, sample_rate)))
    np.testing.assert_allclose(got, np.stack([gain_db] * 2), atol=0.25)


@pytest.mark.parametrize("sample_rate", [24_000, 48_000])
def test_energy_at_measured_directions_is_the_measured_one(make_path, kemar_at, sample_rate):
    hrtf, _ = kemar_at(sample_rate)
    path = make_path(sample_rate=sample_rate)
    for measured in range(0, len(hrtf.directions), 37):
        response = path.impulse_response(at(1.0, hrtf.directions[measured]), LEVEL, 1024)
        got = power_to_db(np.sum(response**2, axis=-1))
        expected = power_to_db(np.sum(hrtf.impulse_responses[measured] ** 2, axis=-1))
        np.testing.assert_allclose(got, expected, atol=0.05)


def horizontal(hrtf):
    """Measured directions at the height of the ears, and their azimuths."""
    level = np.flatnonzero(np.abs(hrtf.directions[:, 2]) < 1e-6)
    return level[::4]


def lateness(pair, sample_rate, below_hz):
    """How much later the second ear hears, in seconds: where the low-passed responses correlate most."""
    low = sosfiltfilt(butter(4, below_hz, fs=sample_rate, output="sos"), np.pad(pair, ((0, 0), (256, 256))))
    fine = np.fft.irfft(np.fft.rfft(low), 32 * low.shape[-1])
    correlation = np.fft.irfft(
        np.fft.rfft(fine[1], 2 * fine.shape[-1]) * np.conj(np.fft.rfft(fine[0], 2 * fine.shape[-1]))
    )
    lag = np.argmax(np.concatenate([correlation[-32 * 64 :], correlation[: 32 * 64]])) - 32 * 64
    return lag / (32 * sample_rate)


@pytest.mark.parametrize("sample_rate", [24_000, 48_000])
def test_interaural_delay_over_azimuth_is_the_measured_one(make_path, kemar_at, sample_rate):
    hrtf, _ = kemar_at(sample_rate)
    path = make_path(sample_rate=sample_rate)
    for measured in horizontal(hrtf):
        response = path.impulse_response(at(1.0, hrtf.directions[measured]), LEVEL, 512).astype(float)
        for below_hz in (1000, 2000):
            expected = lateness(hrtf.impulse_responses[measured], sample_rate, below_hz)
            assert lateness(response, sample_rate, below_hz) == pytest.approx(expected, abs=30e-6)


@pytest.mark.parametrize("sample_rate", [24_000, 48_000])
def test_interaural_level_over_azimuth_is_the_measured_one(make_path, kemar_at, sample_rate):
    """In thirds of an octave, and over all frequencies."""
    hrtf, _ = kemar_at(sample_rate)
    path = make_path(sample_rate=sample_rate)
    edges = 100 * 2 ** ((np.arange(3 * 7) - 0.5) / 3)
    frequency = np.fft.rfftfreq(8192, 1 / sample_rate)
    thirds = [(frequency >= low) & (frequency < high) for low, high in pairwise(edges)]
    thirds = [third for third in thirds if third.any()] + [frequency > 0]

    def levels(pair):
        power = np.abs(np.fft.rfft(pair, 8192)) ** 2
        return power_to_db([power[:, band].sum(axis=-1) for band in thirds])

    for measured in horizontal(hrtf):
        response = path.impulse_response(at(1.0, hrtf.directions[measured]), LEVEL, 512)
        np.testing.assert_allclose(levels(response), levels(hrtf.impulse_responses[measured]), atol=0.5)


def test_output_is_the_delayed_signal_convolved_with_the_interpolated_response(make_path, kemar_at):
    """Offline, in double precision and by spectra: the mean of logarithms of three magnitudes, made minimum-phase by
    the Hilbert transform, delayed by a phase."""
    rate = 48_000
    hrtf, filters = kemar_at(rate)
    rng = np.random.default_rng(4)
    corners = filters.triangulation.triangles[500]
    shares = np.array([0.2, 0.3, 0.5])
    direction = shares @ filters.directions[corners]
    length_m = 2.7182
    n_fft = 16_384
    frequency = np.fft.rfftfreq(n_fft)
    magnitude = np.abs(np.fft.rfft(hrtf.impulse_responses[corners], n_fft))
    audible = np.maximum(magnitude, 1e-5 * magnitude.max(axis=-1, keepdims=True))  # as the filters were made
    log_magnitude = np.einsum("k,kef->ef", shares, np.log(audible))
    # Beyond what was measured of the head, the level of the last third of an octave.
    octaves = np.log2(np.maximum(frequency * rate, 1) / hrtf.band_hz)
    last = (octaves > -1 / 3) & (octaves <= 0) & (np.arange(len(octaves)) % 8 == 0)  # in the filters' own bins
    held = (1 - np.cos(np.pi * np.clip((2 ** (octaves + 1 / 3) - 1) / (2 ** (1 / 3) - 1), 0, 1))) / 2
    log_magnitude += held * (log_magnitude[:, last].mean(axis=-1, keepdims=True) - log_magnitude)
    cepstrum = np.fft.irfft(log_magnitude)
    cepstrum[:, 1 : n_fft // 2] *= 2
    cepstrum[:, n_fft // 2 + 1 :] = 0
    delay = length_m / SPEED_OF_SOUND + shares @ filters.delays_s[corners]
    response = np.fft.rfft(np.fft.irfft(np.exp(np.fft.rfft(cepstrum)))[:, : filters.taps], n_fft)
    # Band-limited to where the delay line is exact.
    signal = sosfiltfilt(butter(12, 0.7, output="sos"), np.pad(rng.standard_normal(8000), 1000))
    expected = (
        np.fft.irfft(
            np.fft.rfft(signal, n_fft) * response * np.exp(-2j * np.pi * frequency * delay[:, None] * rate), n_fft
        )[:, : len(signal)]
        / length_m
    )

    path = make_path(sample_rate=rate)
    path.set_target(0, at(length_m, direction / np.linalg.norm(direction)))
    error = play(path, signal) - expected
    assert power_to_db(np.mean(error**2) / np.mean(expected**2)) < -85


def test_directions_are_seen_from_the_head(make_path):
    """Turning the head and turning the world the other way are the same, about any axis."""
    path = make_path()
    rng = np.random.default_rng(2)
    for turn in Rotation.random(8, rng=rng):
        arrival = rng.standard_normal(3)
        arrival /= np.linalg.norm(arrival)
        turned = path.impulse_response(at(arrival=turn.apply(arrival)), turn.as_quat(), 1024)
        level = path.impulse_response(at(arrival=arrival), LEVEL, 1024)
        np.testing.assert_allclose(turned, level, atol=1e-6)


def test_turning_left_brings_what_was_ahead_to_the_right_ear(make_path):
    left, right = make_path().impulse_response(at(), Rotation.from_euler("z", 90, degrees=True).as_quat(), 1024)
    assert power_to_db(np.sum(right**2) / np.sum(left**2)) > 6


@pytest.mark.parametrize(
    "towards", [(-1, 0, 0), (0, 0, 1), (0, 0, -1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (0.5, 0, -np.sqrt(0.75))]
)
def test_no_direction_has_an_edge(make_path, towards):
    """Behind, above, below, where azimuths wrap and where nothing was measured: a hair's breadth changes nothing."""
    path = make_path()
    centre = np.array(towards, dtype=float)
    here = path.impulse_response(at(arrival=centre), LEVEL, 1024)
    assert np.isfinite(here).all()
    assert np.abs(here).max() > 0.01
    for off in np.concatenate([np.eye(3), -np.eye(3)]) * 1e-6:
        there = path.impulse_response(at(arrival=(centre + off) / np.linalg.norm(centre + off)), LEVEL, 1024)
        np.testing.assert_allclose(there, here, atol=1e-4 * np.abs(here).max())


def test_no_path_between_directions_has_a_step(make_path):
    """Along great circles over the whole sphere: where it changes most, a tenth of the way is a tenth of the change."""
    path = make_path(sample_rate=24_000)
    rng = np.random.default_rng(3)

    def changes(along, across, angles):
        arrivals = np.outer(np.cos(angles), along) + np.outer(np.sin(angles), across)
        responses = np.array([path.impulse_response(at(arrival=arrival), LEVEL, 512) for arrival in arrivals])
        return np.linalg.norm(np.diff(responses, axis=0), axis=(1, 2)) / np.linalg.norm(responses[1:], axis=(1, 2))

    for _ in range(4):
        circle = np.linalg.qr(rng.standard_normal((3, 2)))[0].T
        angles = np.radians(np.arange(0, 361, 1.0))
        change = changes(*circle, angles)
        worst = np.argmax(change)
        assert change[worst] < 0.3
        assert changes(*circle, np.linspace(angles[worst], angles[worst + 1], 11)).max() < 0.2 * change[worst]
