"""Streams at other sample rates than their scene's: they sound alike within its band, and only the direct sound and the
first reflections go beyond it."""

import numpy as np
import pytest
import soxr

from server.acoustics.bands import FILTER_BANDS_HZ
from server.acoustics.geometry import Pose
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.offline.render import PathPoint, RenderedEmitter, planned_effects, render
from server.planning.places import place_of, place_of_field
from server.protocol.blocks import DryBlock
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose, ListenerStart
from server.rendering.hrtf import kemar
from server.responses.direct_sound import DirectSound
from server.responses.ir_request import compute_irs
from server.scene.manifest import Air
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session
from tests.directional_flat import write_directional
from tests.signals import error_db

OWN = 24_000
BLOCKS = {24_000: 256, 44_100: 512, 48_000: 512, 96_000: 1_024}
RATES = pytest.mark.parametrize("rate", [44_100, 48_000, 96_000])
SECONDS = 0.4
THERE = (6.0, 3.0, 1.5)


def clip_at(rate, *, low_hz=200, high_hz=10_000):
    """Noise of a band; the same at all rates, and quiet enough that no limiter acts."""
    hz = 96_000
    spectrum = np.fft.rfft(0.005 * np.random.default_rng(4).standard_normal(hz // 4))
    frequency = np.fft.rfftfreq(hz // 4, 1 / hz)
    noise = np.fft.irfft(spectrum * ((frequency > low_hz) & (frequency < high_hz))) * np.hanning(hz // 4)
    return soxr.resample(noise, hz, rate, quality="VHQ").astype(np.float32)


def places(field):
    """Where the listener goes, and where the emitter is."""
    start = field.bundle.manifest.start
    x, y, z = start.listener
    return (start.listener, (x, y + 0.5, z)), start.emitter


def heard(field, rate, clip=None, *, seconds=SECONDS, stops=2, is_planned=False, **hello):
    """(channel, n): at rest for half of the time, and in the other half half a metre away; or in one place."""
    levels, place = FieldsByLevel([field]), None
    if is_planned:
        known = place_of_field(field).reverberations
        place = place_of(field.bundle, known, block_size=BLOCKS[rate], sample_rate=rate)
    here, emitter = places(field)
    first = ListenerStart(position=here[0], yaw=0.5)
    asked = {"scene": field.bundle.id, "sample_rate": rate, "block_size": BLOCKS[rate], "listener": first, **hello}
    session = Session(
        Hello(protocol=PROTOCOL, **asked),
        levels,
        kemar(rate),
        lambda _: clip_at(rate) if clip is None else clip,
        quality=QualityStep.full(field.level, 1.0),
        window=10_000,
        place=place,
        field_filters=kemar(OWN),
    )
    session.receive(AddEmitter(id="talker", clip="noise", position=emitter, loop=False))
    blocks = []
    for number, place in enumerate(here[:stops], start=1):
        if number > 1:
            session.receive(ListenerPose(pose_id=number, position=place, yaw=0.5 * number))
        for _ in range(round(seconds / stops * rate / BLOCKS[rate])):
            if (plan := session.take_plan_request()) is not None:
                session.adopt(plan.plan())
            if (request := session.take_request()) is not None:
                session.accept(compute_irs(levels.at_rate(rate), request, session.renderer))
            blocks.append(session.render_block().samples)
    return np.concatenate(blocks, axis=1).astype(float)


def dead(field):
    """Nothing follows the direct sound any more."""
    field.impulse_responses = lambda listeners, *_, **__: np.zeros((len(listeners), 2, field.ir_samples), np.float32)
    return field


def signal_to_noise_db(samples, rate, expected, *, seconds=SECONDS):
    """Of samples at `rate`, resampled to the scene's."""
    own = soxr.resample(samples.T, rate, OWN, quality="VHQ").T
    length = round(seconds * OWN) - 300
    error = own[:, :length] - expected[:, :length]
    return 10 * np.log10(np.sum(expected[:, :length] ** 2) / np.sum(error**2))


@RATES
def test_reflected_sound_is_that_of_the_scenes_own_rate(bundle, rate):
    """At 44.1 kHz blocks begin at other times, so only what is heard before the step is compared. The exchange of
    responses fades in as many steps as a block has samples."""

    def reflected(hz):
        return heard(AcousticField.load(bundle), hz) - heard(dead(AcousticField.load(bundle)), hz)

    own = reflected(OWN)
    other = reflected(rate)
    at_rest_db = signal_to_noise_db(other, rate, own, seconds=SECONDS / 2)
    assert at_rest_db > (80 if rate == 44_100 else 120)
    if rate != 44_100:
        assert signal_to_noise_db(other, rate, own) > 70


@RATES
@pytest.mark.parametrize("tone_hz", [440.0, 9_431.7])
def test_a_tone_stays_that_tone_and_nothing_else_appears(mirrored_field, rate, tone_hz):
    """Through the resampled response, the first reflections and the direct sound at once."""
    seconds, settled = 1.6, slice(round(0.6 * rate), round(1.5 * rate))
    phase = 2 * np.pi * tone_hz * np.arange(round(2 * rate)) / rate
    clip = (0.01 * np.sin(phase)).astype(np.float32)
    stayed = heard(mirrored_field, rate, clip, seconds=seconds, stops=1)[0][settled]
    window = np.kaiser(stayed.size, 20)
    spectrum = np.abs(np.fft.rfft(stayed * window, 4 * stayed.size))
    hz = np.fft.rfftfreq(4 * stayed.size, 1 / rate)
    elsewhere = np.abs(hz - tone_hz) > 12
    assert 20 * np.log10(spectrum[elsewhere].max() / spectrum.max()) < -100
    # Its phase turns with the clip's: a drift of a milliradian a second would be a ten-millionth of its frequency.
    first, last = np.array_split(stayed * np.exp(-1j * phase[settled]), 2)
    window = np.kaiser(first.size, 20)
    turned = np.angle(np.sum(last[: first.size] * window) / np.sum(first * window))
    assert abs(turned) < 1e-3


@pytest.fixture(scope="module")
def directional(tmp_path_factory):
    return {
        tail: AcousticField.load(write_directional(tmp_path_factory.mktemp(tail), towards=(0.6, 0.0, 0.8), tail=tail))
        for tail in ("stft", "bands")
    }


@pytest.fixture
def fields(bundle, mirrored_field, field_at_nodes, whole_at_nodes, measured_bundle, directional):
    return {
        "without reflections": AcousticField.load(bundle),
        "mirrored": mirrored_field,
        "nodes": field_at_nodes,
        "whole nodes": whole_at_nodes,
        "measured": AcousticField.load(measured_bundle),
        **directional,
    }


@pytest.mark.parametrize(
    "kind", ["without reflections", "mirrored", "nodes", "whole nodes", "measured", "stft", "bands"]
)
def test_whole_sound_is_that_of_the_scenes_own_rate(fields, kind):
    """The heads' filters have the same magnitude and delay, but not quite the same phase near 12 kHz."""
    own = heard(fields[kind], OWN)
    assert np.abs(own).max() > 1e-3
    assert signal_to_noise_db(heard(fields[kind], 48_000), 48_000, own) > 25


@pytest.fixture
def no_air(monkeypatch):
    """Its filter has the same magnitude at all rates, and the minimum phase of the band that there is: some 0.2 us for
    each metre of difference (`test_filters_of_air_are_the_same_at_all_rates`)."""
    monkeypatch.setattr(Air, "filter_db_per_m", np.zeros(len(FILTER_BANDS_HZ)))


@pytest.mark.usefixtures("no_air")
def test_streams_at_48_and_96_khz_differ_less_than_either_from_24_khz(directional):
    high, higher = (heard(directional["bands"], rate) for rate in (48_000, 96_000))
    down = soxr.resample(higher.T, 96_000, 48_000, quality="VHQ").T
    length = high.shape[1] - 600
    error = down[:, :length] - high[:, :length]
    assert 10 * np.log10(np.sum(high[:, :length] ** 2) / np.sum(error**2)) > 48


@pytest.mark.usefixtures("no_air")
def test_ambisonic_streams_are_those_of_the_scenes_own_rate(directional):
    own = heard(directional["bands"], OWN, output="ambisonics", order=1)
    other = heard(directional["bands"], 48_000, output="ambisonics", order=1)
    assert len(own) == len(other) == 4
    assert signal_to_noise_db(other, 48_000, own) > 40


def test_direct_sound_and_first_reflections_go_beyond_the_scenes_band_and_its_field_does_not(mirrored_bundle):
    high = clip_at(48_000, low_hz=13_000, high_hz=20_000)
    whole, direct = (
        heard(change(AcousticField.load(mirrored_bundle)), 48_000, high) for change in (lambda same: same, dead)
    )
    assert np.abs(direct).max() > 1e-4
    # Before the step: while responses are exchanged, their parts change at different times, and each cut is broad.
    at_rest = slice(9_000)
    assert error_db(whole[:, at_rest], direct[:, at_rest]) < -100


@RATES
def test_the_beginning_of_a_response_is_that_of_the_whole(directional, rate):
    field = FieldsByLevel([directional["bands"]]).at_rate(rate).default
    (listener, _), emitter = places(field)
    whole = field.impulse_responses([listener], [emitter], [0.3], remember=True)
    assert whole.shape == (1, 2, field.ir_samples)
    first = field.first_samples([listener], [emitter], [0.3], 1_500)
    np.testing.assert_allclose(first, whole[..., :1_500], atol=1e-6 * np.abs(whole).max())


@pytest.mark.parametrize("rate", [24_000, 44_100, 48_000])
@pytest.mark.parametrize("choice", ["all", "plan"])
def test_an_offline_render_has_the_samples_of_a_stream(directional, rate, choice):
    field = directional["bands"]
    resampled = FieldsByLevel([field]).at_rate(rate).default
    (first, second), emitter = places(field)
    planned = planned_effects(
        choice, resampled, Pose.from_yaw(first, 0.5), output="headphones", block_size=BLOCKS[rate]
    )
    blocks = round(SECONDS / 2 * rate / BLOCKS[rate])
    path = [
        PathPoint.at(number * blocks * BLOCKS[rate], Pose.from_yaw(place, 0.5 * (number + 1)))
        for number, place in enumerate((first, second))
    ]
    rendered = render(
        resampled,
        DirectSound.of(field.bundle, kemar(rate), field_filters=kemar(OWN)),
        [RenderedEmitter(clip_at(rate), Pose(emitter))],
        path,
        block_size=BLOCKS[rate],
        length=2 * blocks * BLOCKS[rate],
        planned=planned,
    )
    np.testing.assert_array_equal(rendered, heard(field, rate, is_planned=choice == "plan").astype(np.float32))


def test_live_samples_wait_for_half_a_second_of_the_streams_rate(levels):
    session = Session(
        Hello(protocol=PROTOCOL, scene="flat", sample_rate=96_000),
        levels,
        kemar(96_000),
        lambda _: clip_at(96_000),
        quality=QualityStep.full(levels.default.level, 1.0),
        field_filters=kemar(OWN),
    )
    session.receive(AddEmitter(id="guest", live=True, position=THERE))
    for sequence in range(60):
        assert not session.receive(DryBlock("guest", sequence, np.zeros(1_000, np.float32)))
    (live,) = session.live_statuses()
    assert (live.samples_queued, live.samples_dropped) == (48_000, 12_000)


def test_a_head_of_another_rate_is_no_head_of_a_stream(levels, filters):
    with pytest.raises(ValueError, match="24000 Hz"):
        Session(
            Hello(protocol=PROTOCOL, scene="flat", sample_rate=48_000),
            levels,
            filters,
            lambda _: clip_at(48_000),
            quality=QualityStep.full(levels.default.level, 1.0),
        )
