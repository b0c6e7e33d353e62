"""The limiter: nothing below its ceiling, never beyond it, both ears alike, and without a sound of its own."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import resample_poly

from server.acoustics.spherical_harmonics import real_harmonics
from server.rendering.limiter import CEILING, Limiter
from tests.signals import noise

RATE, SIZE = 48_000, 256


def tone(frequency_hz, samples, amplitude=1.0, phase=0.0):
    angle = 2 * np.pi * frequency_hz * np.arange(samples) / RATE + phase
    return np.stack([amplitude * np.sin(angle)] * 2).astype(np.float32)


def limit(signal, size=SIZE, limiter=None):
    """What becomes of it, and in which blocks something did."""
    limiter = limiter or Limiter(channels=len(signal), block_size=size, sample_rate=RATE)
    out, acted = signal.copy(), []
    for at in range(0, signal.shape[1], size):
        block = np.ascontiguousarray(out[:, at : at + size])
        limiter.process(block)
        out[:, at : at + size] = block
        acted.append(limiter.acted)
    return out, np.array(acted)


def true_peak_db(signal):
    """At sixteen times the rate, by SciPy's resampler; without the ends, where a signal is cut off."""
    return 20 * np.log10(np.abs(resample_poly(signal.astype(float), 16, 1, axis=1)[:, 1_000:-1_000]).max())


@pytest.mark.parametrize("peak_db", [-60.0, -6.0, -1.6])
def test_below_the_ceiling_every_bit_stays(peak_db):
    signal = noise(1, 2, 100 * SIZE)
    # White noise, limited to half the band, so that the ceiling is kept between samples too.
    signal = resample_poly(signal, 1, 2, axis=1)
    signal = resample_poly(signal, 2, 1, axis=1)
    signal *= 10 ** ((peak_db - true_peak_db(signal)) / 20)
    signal = signal.astype(np.float32)
    out, acted = limit(signal)
    np.testing.assert_array_equal(out, signal)
    assert not acted.any()


def test_what_is_beyond_only_between_samples_is_turned_down_too():
    """A quarter of the rate, sampled half-way up: 3 dB more than any of its samples."""
    signal = tone(RATE / 4, 100 * SIZE, phase=np.pi / 4)
    assert np.abs(signal).max() < 0.71
    assert true_peak_db(signal) > -0.1
    out, acted = limit(signal)
    assert acted.all()
    # Past the first block, which ends before what lies beyond its edge is known.
    assert true_peak_db(out[:, 2 * SIZE :]) < -0.9


@pytest.mark.parametrize("size", [64, 128, 256, 1024])
@pytest.mark.parametrize("gain", [1.0, 4.0, 100.0, 1e9, 1e30])
def test_no_sample_is_beyond_the_ceiling(size, gain):
    signal = gain * noise(2, 2, 40 * 1024)
    out, _ = limit(signal, size)
    assert np.abs(out).max() <= CEILING * (1 + 1e-6)


@pytest.mark.parametrize(
    ("signal", "bound_db"),
    [
        (tone(997, 200 * SIZE, 4.0), -0.9),
        (np.sign(tone(997, 200 * SIZE) + 1e-9), -0.5),
        (np.repeat(np.arange(200 * SIZE)[None] % 3001 == 7, 2, axis=0) * np.float32(50), -0.9),
        (4 * noise(3, 2, 200 * SIZE), 1.0),
    ],
    ids=["a tone", "a square wave", "impulses", "noise"],
)
def test_true_peaks_stay_near_the_ceiling(signal, bound_db):
    """Noise up to Nyquist's frequency is the worst there is for an estimate at four times the rate and for the edges of
    blocks: up to 2 dB above the ceiling of -1 dB."""
    out, _ = limit(signal.astype(np.float32))
    assert true_peak_db(out[:, 4 * SIZE :]) < bound_db


def test_a_steady_tone_stays_a_tone():
    out, _ = limit(tone(997, 400 * SIZE, 4.0))
    steady = out[0, 200 * SIZE : 200 * SIZE + 32_768] * np.kaiser(32_768, 20)
    power = np.abs(np.fft.rfft(steady)) ** 2
    above = np.fft.rfftfreq(32_768, 1 / RATE) > 1_500
    assert 10 * np.log10(power[above].sum() / power.sum()) < -90


def test_both_ears_are_turned_down_alike():
    signal = noise(4, 2, 50 * SIZE)
    signal[1] *= 0.1
    signal[0] *= 5
    out, _ = limit(signal)
    np.testing.assert_allclose(out[0] / signal[0], out[1] / signal[1], rtol=1e-5)


def test_the_gain_falls_before_a_peak_within_a_block_and_not_at_it():
    signal = np.full((2, 4 * SIZE), 0.5, np.float32)
    signal[:, 2 * SIZE + 200] = 2.0
    out, acted = limit(signal)
    gain = out[0] / signal[0]
    assert acted.tolist() == [False, False, True, True]
    np.testing.assert_array_equal(gain[: 2 * SIZE], 1.0)
    assert gain[2 * SIZE + 200] * 2.0 <= CEILING * (1 + 1e-6)
    steps = np.abs(np.diff(gain))
    assert steps.max() <= 1 / 16  # over more than one step of the way down, and slower on the way up
    assert steps[2 * SIZE + 216 :].max() < 1e-3


def test_afterwards_it_lets_go_to_the_bit():
    signal = np.concatenate([tone(997, 20 * SIZE, 4.0), tone(997, 1_000 * SIZE, 0.2)], axis=1)
    out, acted = limit(signal)
    assert not acted[-100:].any()
    np.testing.assert_array_equal(out[:, -100 * SIZE :], signal[:, -100 * SIZE :])
    released_s = np.flatnonzero(acted).max() * SIZE / RATE
    assert 0.5 < released_s < 3.0


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_is_silence_counted_and_gone_with_the_next_block(bad):
    signal = 0.1 * noise(5, 2, 8 * SIZE)
    spoilt = signal.copy()
    spoilt[0, 2 * SIZE + 3 : 2 * SIZE + 6] = bad
    limiter = Limiter(channels=2, block_size=SIZE, sample_rate=RATE)
    out, acted = limit(spoilt, limiter=limiter)
    expected = signal.copy()
    expected[0, 2 * SIZE + 3 : 2 * SIZE + 6] = 0
    np.testing.assert_array_equal(out, expected)
    assert limiter.samples_silenced == 3
    assert acted.tolist() == [False, False, True, False, False, False, False, False]


def test_a_limiter_that_was_reset_is_like_a_new_one():
    limiter = Limiter(channels=2, block_size=SIZE, sample_rate=RATE)
    limit(100 * noise(6, 2, 10 * SIZE), limiter=limiter)
    limiter.reset()
    signal = 2 * noise(7, 2, 10 * SIZE)
    np.testing.assert_array_equal(limit(signal, limiter=limiter)[0], limit(signal)[0])


def test_one_channel_is_limited_like_two_alike():
    signal = 3 * noise(8, 1, 20 * SIZE)
    np.testing.assert_array_equal(limit(signal)[0][0], limit(np.repeat(signal, 2, axis=0))[0][0])


@pytest.mark.parametrize("options", [{"block_size": 100}, {"ceiling": 0.0}, {"ceiling": float("nan")}])
def test_a_limiter_that_cannot_be_is_refused(options):
    with pytest.raises(ValueError, match="multiples of 16"):
        Limiter(**({"channels": 2, "block_size": SIZE, "sample_rate": RATE} | options))


LIMIT = """
import sys
if sys.argv[1] == "interpreted":
    sys.path.insert(0, "tests/oracles")
    import interpreted
    interpreted.install()
import numpy as np
from server.rendering.limiter import Limiter, limit
assert hasattr(limit, "py_func") == (sys.argv[1] == "compiled")
limiter = Limiter(channels=2, block_size=256, sample_rate=48_000)
signal = 2 * np.random.default_rng(9).standard_normal((40, 2, 256)).astype(np.float32)
signal[20:30] *= np.float32(0.01)
signal[35, 1, 7] = np.nan
for block in signal:
    limiter.process(block)
np.save(sys.argv[2], signal)
"""


def test_with_nothing_compiled_it_is_the_same(tmp_path):
    outputs = []
    for how in ("compiled", "interpreted"):
        command = [sys.executable, "-c", LIMIT, how, str(tmp_path / f"{how}.npy")]
        subprocess.run(command, check=True, cwd=Path(__file__).parents[2])
        outputs.append(np.load(tmp_path / f"{how}.npy"))
    np.testing.assert_allclose(*outputs, atol=1e-6)


def test_ambisonic_channels_keep_their_direction():
    """A wave that is too loud comes from where it came from: one gain for all sixteen channels."""
    harmonics = real_harmonics((0.6, -0.48, 0.64), 3)
    signal = (8 * harmonics[:, None] * tone(700, 60 * SIZE)[0]).astype(np.float32)
    out, acted = limit(signal)
    assert acted.any()
    assert true_peak_db(out[:, 2 * SIZE :]) < -0.9
    np.testing.assert_allclose(out, harmonics[:, None] * out[0], atol=1e-5)
