import numpy as np
import pytest
from scipy.signal.windows import hann

from server.acoustics.codec import Codec
from training.models.cells import Cells
from training.models.factorised import Heads
from training.models.targets import LEAD_SAMPLES, align, flat_targets

CODEC = Codec(16_000, 256, 64, 4_000, 1e-5)
CELLS = Cells(CODEC, known_frames=12)
HEADS = Heads(CELLS)


def heads(responses):
    flat = flat_targets(responses, CELLS).astype(np.float64)
    assert flat.shape == (*responses.shape[:-2], HEADS.size)
    return {name: flat[..., part].reshape(*flat.shape[:-1], *HEADS.shapes[name]) for name, part in HEADS.slices.items()}


def band_limited(rng, silent=800):
    """Noise below 0.8 of Nyquist, with silence on either side."""
    spectrum = np.fft.rfft(rng.standard_normal((2, CODEC.samples - 2 * silent)))
    spectrum[:, int(0.8 * spectrum.shape[-1]) :] = 0
    noise = np.fft.irfft(spectrum) * hann(CODEC.samples - 2 * silent)
    return np.pad(noise, ((0, 0), (silent, silent)))


@pytest.mark.parametrize("delay", [0.0, 17.0, 123.456, -40.3])
def test_aligning_is_undone_by_delaying(delay):
    response = band_limited(np.random.default_rng(0))
    np.testing.assert_allclose(align(align(response, delay), -delay), response, atol=1e-3)


def test_whole_samples_are_shifted():
    response = band_limited(np.random.default_rng(0))
    np.testing.assert_allclose(align(response, 100.0)[:, :-100], response[:, 100:], atol=1e-9)
    np.testing.assert_allclose(align(response, -64.0)[:, 64:], response[:, :-64], atol=1e-9)


def test_a_late_arrival_is_followed_by_silence():
    response = np.zeros((1, CODEC.samples))
    response[0, 3000] = 1
    aligned = align(response, 3000 - LEAD_SAMPLES)
    assert np.argmax(np.abs(aligned)) == LEAD_SAMPLES
    np.testing.assert_allclose(np.delete(aligned, LEAD_SAMPLES, axis=1), 0, atol=1e-9)


def test_phasors_are_those_of_the_click():
    """A click at sample t turns bin k of the frame that starts at sample s by -2 pi k (t - s) / n_fft."""
    click = np.zeros((2, CODEC.samples))
    click[:, LEAD_SAMPLES] = 1
    phasor = heads(click)["phasor"]
    found = phasor[0] + 1j * phasor[1]
    start = np.round(CODEC.frame_times_s[: CELLS.known_frames] * CODEC.sample_rate).astype(int) - CODEC.n_fft // 2
    # Where Hann's window lets the click through at all.
    hears = (start < LEAD_SAMPLES) & (start + CODEC.n_fft > LEAD_SAMPLES)
    assert hears.any()
    turn = -2j * np.pi * np.arange(CODEC.bins)[:, None] * (LEAD_SAMPLES - start) / CODEC.n_fft
    np.testing.assert_allclose(found[..., hears], np.broadcast_to(np.exp(turn), found.shape)[..., hears], atol=2e-3)


def test_aligned_clicks_share_their_phase_however_far_they_came():
    rng = np.random.default_rng(0)
    response = band_limited(rng)
    near, far = (align(response, 800 - LEAD_SAMPLES), align(align(response, -333.3), 800 + 333.3 - LEAD_SAMPLES))
    for name, one in heads(near).items():
        if name != "late":  # silence is only numerically silent
            np.testing.assert_allclose(heads(far)[name][..., 2:8], one[..., 2:8], atol=0.1)


def test_fine_frames_are_the_codecs():
    response = np.random.default_rng(0).standard_normal((3, 2, CODEC.samples))
    log_magnitude, _ = CODEC.encode(response)
    np.testing.assert_allclose(heads(response)["fine"], log_magnitude[..., : CELLS.fine_frames], atol=4e-3)


def test_late_cells_hold_the_power_of_noise():
    noise = np.random.default_rng(0).standard_normal((40, 2, CODEC.samples)) * np.array([1.0, 0.1])[:, None]
    late = heads(noise)["late"]
    # The outermost bands and the last cell lie half outside the signal's spectrum and time.
    level = np.log(np.sqrt(np.mean(np.exp(2 * late), axis=0)))[:, 2:-2, :-1]
    np.testing.assert_allclose(level[0], np.log(np.sqrt(CODEC.window_energy)), atol=0.25)
    np.testing.assert_allclose(level[0] - level[1], np.log(10), atol=0.35)


@pytest.mark.parametrize(("right", "expected"), [(1.0, 1.0), (-0.5, -1.0)])
def test_ears_that_hear_the_same_are_coherent(right, expected):
    noise = np.random.default_rng(0).standard_normal((1, CODEC.samples))
    interaural = heads(np.concatenate([noise, right * noise]))["interaural"]
    np.testing.assert_allclose(interaural[0], expected, atol=2e-3)
    np.testing.assert_allclose(interaural[1], 0, atol=2e-3)


def test_an_earlier_left_ear_leads_in_phase():
    """E[L conj(R)] with R delayed by d: exp(+2 pi i f d)."""
    noise = np.random.default_rng(0).standard_normal(CODEC.samples + 2)
    interaural = heads(np.stack([noise[2:], noise[:-2]]))["interaural"]
    centres = (CELLS.bands.edges[:-1] + CELLS.bands.edges[1:] - 1) / 2
    expected = 2 * np.pi * centres / CODEC.n_fft * 2
    phase = np.angle(np.mean(interaural[0] + 1j * interaural[1], axis=-1))
    np.testing.assert_allclose(np.exp(1j * (phase - expected))[2:-2], 1, atol=0.1)
