"""A tail of band noises against the same prediction decoded by an inverse transform."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import butter, sosfilt

from server.acoustics.decoding_kernel import NO_MARGIN
from server.acoustics.geometry import Quaternion
from server.acoustics.sound_path import PlanPathFinder
from server.acoustics.spherical_harmonics import real_harmonics
from server.field.band_tail import BandTail, early_frames
from server.field.band_tail_kernel import add_band_tail
from server.field.directional_graph import DirectionalGraph
from server.field.field import AcousticField
from server.health.double_precision import DoubleFullResponse
from server.rendering.hrtf import kemar
from server.responses.full_response import FullResponse
from server.scene.bundle import BUNDLED, Bundle
from server.scene.manifest import QualityLevel
from tests.directional_flat import with_ears_exchanged

APARTMENT = Bundle.load(BUNDLED / "apartment")
PARAMETERS = AcousticField.load(APARTMENT).graph.parameters.model_copy(update={"known_frames": 0})
RATE = PARAMETERS.sample_rate
COLUMNS = PARAMETERS.columns
LISTENER, EMITTER = (2.0, 2.0, 1.5), (3.0, 2.5, 1.5)
BANDS = [(350, 700), (700, 1400), (1400, 2800), (2800, 5600)]


class _Predicted(DirectionalGraph):
    """A graph whose predictions a test chooses, with the codec and noise of the apartment."""

    def __init__(self, log_magnitude, relative) -> None:
        self.name, self.channels, self.gives_responses = "predicted", 2, False
        self.order = self.heard_order = 2
        self.parameters, self.paths = PARAMETERS, PlanPathFinder(APARTMENT.floor_plan, 343.0)
        self.said = log_magnitude, relative

    def run(self, listeners, emitters, heads, paths=None):  # noqa: ARG002  the same everywhere
        return [np.repeat(said[None], len(np.asarray(listeners)), 0) for said in self.said]


def fields(decay_db_s=(100.0,) * 7, towards=None, share=1.0):
    """The same prediction, decoded in both ways. A `share` of the sound comes from the direction `towards`."""
    axis = PARAMETERS.frame_axis
    centres_s = (axis.edges[:-1] + axis.edges[1:] - 1) / 2 * PARAMETERS.hop / RATE
    log_magnitude = (-np.outer(decay_db_s, centres_s) / 20 * np.log(10)).astype(np.float32)
    relative = np.zeros(9) if towards is None else share * real_harmonics(towards, 2)
    directions = np.ones((8, 7, COLUMNS), np.float32) * relative[1:, None, None].astype(np.float32)
    levels = [QualityLevel(name=tail, field="factorised-r16", tail=tail) for tail in ("stft", "bands")]
    return [AcousticField(APARTMENT, level, _Predicted(log_magnitude, directions)) for level in levels]


def responses(both, heads=((0.0, 0.0, 0.0, 1.0),)):
    poses = [LISTENER] * len(heads), [EMITTER] * len(heads), heads
    return [field.impulse_responses(*poses) for field in both]


def levels_db(response, band, step_s=0.04):
    """(ear, step) levels in an octave band."""
    heard = sosfilt(butter(4, band, "bandpass", fs=RATE, output="sos"), response.astype(float), axis=-1)
    step = round(step_s * RATE)
    steps = heard.shape[-1] // step
    return 10 * np.log10(np.mean(heard[:, : steps * step].reshape(2, steps, step) ** 2, axis=-1) + 1e-30)


@pytest.mark.parametrize("band", BANDS, ids=lambda band: f"{band[0]}-{band[1]} Hz")
@pytest.mark.parametrize("towards", [(0.0, 1.0, 0.0), (0.6, 0.0, 0.8)], ids=["left", "above"])
# Within a band, a head colours sound from one side otherwise than diffuse sound. Late sound is nearly diffuse.
@pytest.mark.parametrize(("share", "most_db"), [(0.0, 0.3), (0.3, 0.7), (1.0, 3.0)])
def test_levels_are_those_of_the_inverse_transform(band, towards, share, most_db):
    stft, bands = responses(fields(towards=towards, share=share))
    difference = levels_db(bands[0], band) - levels_db(stft[0], band)
    assert np.abs(difference[:, :-2]).max() < most_db


def test_bands_that_decay_unlike_each_other_keep_their_decay():
    decay = (60.0, 60.0, 70.0, 80.0, 100.0, 120.0, 150.0)
    stft, bands = responses(fields(decay))
    for band in BANDS:
        difference = levels_db(bands[0], band) - levels_db(stft[0], band)
        assert np.abs(difference[:, :12]).max() < 0.5


def test_the_change_is_not_heard():
    both = fields()
    stft, bands = responses(both)
    frames = early_frames(PARAMETERS)
    begin = frames * PARAMETERS.hop
    around = np.s_[..., begin - 200 : begin + 800]
    step = levels_db(bands[0][around], (350, 5000), 0.005) - levels_db(stft[0][around], (350, 5000), 0.005)
    assert np.abs(step[:, 2:]).max() < 1.0
    before = np.s_[:, : begin - 300]
    # The one decodes magnitudes, the other their logarithms.
    assert_allclose(bands[0][before], stft[0][before], rtol=0, atol=1e-6 * np.abs(stft[0][before]).max())


@pytest.mark.parametrize("aligned", [-300.0, -64.5, -1.25, 0.0, 63.75, 215.78, 512.0, 1000.4, 13_000.0, 20_000.0])
def test_magnitudes_are_decoded_as_their_logarithms_are(aligned):
    field = AcousticField.load(APARTMENT)
    arrivals = field.graph.arrivals([LISTENER], [EMITTER])
    heads, start = np.array([Quaternion.from_angles(0.3, 0.4, -0.2)]), np.array([aligned])
    tail, by_logarithms = BandTail(field.graph, APARTMENT.frozen_noise), BandTail(field.graph, APARTMENT.frozen_noise)
    assert tail._margin > NO_MARGIN
    by_logarithms._margin = NO_MARGIN
    decoder = field._decoder
    found, expected = (each.responses(decoder, arrivals, heads, start).copy() for each in (tail, by_logarithms))
    assert_allclose(found, expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    assert (aligned > 14_400) == (not expected.any())


@pytest.mark.parametrize(("share", "most"), [(0.0, 0.05), (0.3, 0.1)])
@pytest.mark.parametrize("towards", [(0.0, 1.0, 0.0), (1.0, 0.0, 0.0)])
def test_the_coherence_of_the_ears_is_that_of_the_inverse_transform(towards, share, most):
    stft, bands = responses(fields((20.0,) * 7, towards=towards, share=share))
    for band in BANDS:
        sos = butter(4, band, "bandpass", fs=RATE, output="sos")
        found = []
        for response in (stft[0], bands[0]):
            left, right = sosfilt(sos, response[:, 2400:-1200].astype(float), axis=-1)
            found.append(left @ right / np.sqrt((left @ left) * (right @ right)))
        assert abs(found[0] - found[1]) < most


def test_a_head_that_turns_hears_the_side_change():
    _, bands = responses(fields(towards=(0.0, 1.0, 0.0)), [(0.0, 0.0, 0.0, 1.0), Quaternion.from_yaw(np.pi)])
    late = np.sum(bands[..., 3000:].astype(float) ** 2, axis=-1)
    assert late[0, 0] > 2 * late[0, 1]
    assert late[1, 1] > 2 * late[1, 0]


def test_another_head_has_a_tail_of_its_own():
    _, bands = fields(towards=(0.0, 1.0, 0.0))
    own = kemar(RATE)
    mirrored = with_ears_exchanged(own)
    poses = [LISTENER], [EMITTER], [(0.0, 0.0, 0.0, 1.0)]
    late = np.sum(bands.through(mirrored).impulse_responses(*poses)[0, :, 3000:].astype(float) ** 2, axis=-1)
    assert late[1] > 2 * late[0]


@pytest.mark.parametrize("level", [-11.6, -30.0, 5.0])
def test_silence_and_loudness_stay_finite(level):
    _, bands = fields()
    shape = bands.graph.said[0].shape
    bands.graph.said = np.full(shape, level, np.float32), np.full((8, *shape), 1.0, np.float32)
    response = bands.impulse_responses([LISTENER], [EMITTER], [(0.0, 0.0, 0.0, 1.0)])
    assert np.isfinite(response).all()
    if level < np.log(PARAMETERS.log_floor):
        assert np.abs(response).max() < 1e-9  # -180 dB: the floor's logarithm is rounded


def test_equal_poses_have_equal_responses_in_any_batch():
    _, bands = fields()
    heads = [Quaternion.from_yaw(yaw) for yaw in (0.0, 1.0, 2.0)]
    together = bands.impulse_responses([LISTENER] * 3, [EMITTER] * 3, heads)
    for row, head in enumerate(heads):
        assert_allclose(together[row], bands.impulse_responses([LISTENER], [EMITTER], [head])[0], atol=1e-7)


@pytest.mark.parametrize("towards", [None, (0.0, 1.0, 0.0), (0.6, 0.0, 0.8)])
def test_it_is_that_of_double_precision(towards):
    head = Quaternion.from_angles(0.3, 0.4, -0.2)
    poses = [LISTENER], [EMITTER], [head]
    for field in fields((60.0, 60.0, 70.0, 80.0, 100.0, 120.0, 150.0), towards):
        found = FullResponse(field, kemar(RATE)).impulse_responses(*poses)[0].astype(float)
        exact = DoubleFullResponse(field, kemar(RATE)).impulse_responses(*poses)[0].astype(float)
        for part in (slice(None, 1600), slice(1600, None)):
            error = np.sum((found - exact)[:, part] ** 2) / np.sum(exact[:, part] ** 2)
            assert 10 * np.log10(error) < -120


@pytest.mark.parametrize("samples", [1_000, 2_048, 14_400])
def test_first_samples_are_those_of_the_whole_response(samples):
    """At the least those by which the gate makes up for what it takes away."""
    for field in fields(towards=(0.0, 1.0, 0.0), share=0.3):
        (whole,) = field.impulse_responses([LISTENER], [EMITTER], [0.3])
        (first,) = field.first_samples([LISTENER], [EMITTER], [0.3], samples)
        np.testing.assert_allclose(first, whole[:, :samples], rtol=1e-5, atol=1e-8)
        with pytest.raises(ValueError, match="finite"):
            field.first_samples([(np.nan, 0.0, 0.0)], [EMITTER], [0.3], samples)


@pytest.mark.parametrize("fade_at", [-400, -100, 37, 500, 900, 1200])
@pytest.mark.parametrize("noise_samples", [700, 1000, 1300])
def test_from_where_nothing_was_decoded_there_is_the_tail_alone(fade_at, noise_samples):
    rng = np.random.default_rng(0)
    size, share, missing = 1000, 0.25, rng.random((2, 80), np.float32)
    noises = rng.integers(-1000, 1000, (7, 2, noise_samples)).astype(np.int16)
    gains, places = rng.random((3, 7, 5), np.float32), np.array([-20.5, 80.0, 208.25, 460.0, 461.5])
    decoded = rng.standard_normal((2, size)).astype(np.float32)
    found = decoded.copy()
    add_band_tail(gains, places, noises, fade_at, share, missing, np.full((2, 80), np.nan, np.float32), found)
    count, samples = min(size, noise_samples), np.arange(min(size, noise_samples))
    left, other, own = (
        np.stack([np.interp(samples, places, of_band) for of_band in of_part]) for of_part in gains.astype(float)
    )
    one, two = noises[:, 0, :count], noises[:, 1, :count]
    tail = np.zeros((2, size))
    tail[:, :count] = np.sum(left * one, axis=0), np.sum(other * one + own * two, axis=0)
    until = min(size, max(0, fade_at + 80))
    amplitude = np.ones(size)
    amplitude[: max(0, fade_at)] = 0
    fading = np.arange(max(0, fade_at), until)
    amplitude[fading] = share * missing[0, fading - fade_at] + (1 - share) * missing[1, fading - fade_at]
    decoded[:, until:] = 0
    assert_allclose(found, decoded + amplitude * tail, rtol=0, atol=1e-3)
