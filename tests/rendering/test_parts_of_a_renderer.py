"""What nobody asked for is not there, and comes and goes without a click: convolvers, heads, and direct sound that is
heard by itself or not."""

from functools import partial

import numpy as np
import pytest
from scipy.signal import fftconvolve
from scipy.signal.windows import kaiser

from server.rendering.convolver import Convolver
from server.rendering.direct_path import PathTarget
from server.rendering.fade import raised_cosine
from server.rendering.renderer import Renderer
from server.rendering.sources import ClipPlayer
from tests.signals import decaying_noise, error_db, noise

RATE, SIZE = 24_000, 256
IR_SAMPLES = 6_000
SPEED_OF_SOUND = 343.0
AIR = np.array([0.0003, 0.001, 0.002, 0.004, 0.008, 0.02, 0.07])
AHEAD = (1.0, 0.0, 0.0)
FLAT = np.zeros(7)
SECOND = RATE // SIZE
room = partial(decaying_noise, samples=IR_SAMPLES, decay_samples=800, gain=0.1)


@pytest.fixture
def engine(kemar_at):
    def make(**options):
        settings = {
            "block_size": SIZE,
            "ir_samples": IR_SAMPLES,
            "sample_rate": RATE,
            "filters": kemar_at(RATE)[1],
            "speed_of_sound": SPEED_OF_SOUND,
            "air_db_per_m": AIR,
            "max_emitters": 4,
        }
        return Renderer(**(settings | options))

    return make


def tone():
    """One second of 997 Hz, which loops without a seam."""
    return np.sin(2 * np.pi * 997 * np.arange(RATE) / RATE).astype(np.float32)


def add(renderer, clip, ir=None, target=None, name="a"):
    renderer.add_emitter(name, ClipPlayer(clip, loop=True), awaits_ir=ir is not None)
    renderer.set_path(name, target or PathTarget(3.0, AHEAD, FLAT))
    if ir is not None:
        renderer.set_ir(name, ir)


def run(renderer, blocks):
    return np.concatenate([renderer.process() for _ in range(blocks)], axis=1)


def splatter_db(heard):
    """Energy above 4 kHz, beside all, seen through a window whose side lobes are below -140 dB."""
    power = np.abs(np.fft.rfft(heard * kaiser(heard.shape[-1], 20))) ** 2
    above = np.fft.rfftfreq(heard.shape[-1], 1 / RATE) > 4_000
    return 10 * np.log10(power[..., above].sum() / power.sum())


def test_without_responses_there_is_no_convolver(engine, monkeypatch):
    monkeypatch.setattr(Convolver, "__init__", lambda *_args, **_named: pytest.fail("a convolver was made"))
    renderer = engine()
    add(renderer, tone())
    assert run(renderer, 10).any()
    assert renderer.convolvers == 0


def test_a_convolver_comes_with_the_first_response_and_goes_when_the_last_has_rung_out(engine):
    renderer = engine()
    add(renderer, noise(1, 5_000))
    run(renderer, 3)
    renderer.set_ir("a", room(2))
    run(renderer, 3)
    assert renderer.convolvers == 1
    renderer.drop_ir("a")
    ringing = 0
    while renderer.convolvers:
        renderer.process()
        ringing += 1
        assert ringing < 200
    assert ringing * SIZE > IR_SAMPLES


def test_a_response_that_is_dropped_rings_out_and_one_that_comes_is_faded_into(engine):
    clip, ir = noise(3, RATE), room(4)
    direct = engine()
    add(direct, clip)
    renderer = engine()
    add(renderer, clip)
    wet = [run(renderer, 10)]
    renderer.set_ir("a", ir)
    wet.append(run(renderer, 10))
    renderer.drop_ir("a")
    wet.append(run(renderer, 60))
    wet = np.concatenate(wet, axis=1)
    sent = np.resize(clip, wet.shape[1]).astype(float)
    weight = np.zeros(wet.shape[1])
    weight[10 * SIZE : 20 * SIZE] = 1
    weight[10 * SIZE : 11 * SIZE] = raised_cosine(SIZE)
    weight[20 * SIZE : 21 * SIZE] = raised_cosine(SIZE)[::-1]
    expected = run(direct, 80) + fftconvolve((sent * weight)[None], ir, axes=1)[:, : wet.shape[1]]
    assert error_db(wet, expected) < -115


@pytest.mark.parametrize("channels", [1, 2])
@pytest.mark.parametrize("air", [False, True])
def test_muted_direct_sound_fades_out_and_is_there_at_once_when_it_comes_back(engine, channels, air):
    """Against the same that was never muted: what came before is in the filters, as if they had run all along."""
    clip = noise(5, 7_000)
    heard = []
    for is_muted in (False, True):
        renderer = engine(has_head=channels == 2)
        add(renderer, clip)
        renderer.enable_direct("a", air=air)
        parts = [run(renderer, 20)]
        renderer.enable_direct("a", is_heard=not is_muted, air=air)
        parts.append(run(renderer, 9))
        renderer.enable_direct("a", air=air)
        parts.append(run(renderer, 9))
        heard.append(np.concatenate(parts, axis=1))
    always, muted = heard
    weight = np.ones(always.shape[1])
    weight[20 * SIZE : 29 * SIZE] = 0
    weight[20 * SIZE : 21 * SIZE] = raised_cosine(SIZE)[::-1]
    weight[29 * SIZE : 30 * SIZE] = raised_cosine(SIZE)
    assert error_db(muted, weight * always) < -110


def test_muted_direct_sound_takes_no_time_but_that_of_its_line(engine):
    """What is not heard is neither read from the line nor filtered: nothing is left of it in the windows."""
    renderer = engine()
    add(renderer, noise(6, 3_000))
    run(renderer, 5)
    renderer.enable_direct("a", is_heard=False)
    run(renderer, 2)
    state = next(iter(renderer._mixers)).direct.state
    before = state.heard.copy(), state.position[0]
    run(renderer, 5)
    np.testing.assert_array_equal(state.heard, before[0])
    assert not state.is_mixed.any()
    assert state.position[0] != before[1]


@pytest.mark.parametrize("length_m", [0.5, 3.0, 21.7])
def test_one_ear_without_a_head_hears_delay_and_distance_alone(engine, length_m):
    renderer = engine(has_head=False, outputs=1, air_db_per_m=np.zeros(7))
    impulse = np.zeros(RATE, np.float32)
    impulse[0] = 1
    add(renderer, impulse, target=PathTarget(length_m, AHEAD, FLAT))
    heard = run(renderer, SECOND)
    assert heard.shape[0] == 1
    frequency = np.arange(100, 8_000, 100)
    spectrum = heard[0] @ np.exp(-2j * np.pi * np.outer(np.arange(heard.shape[1]), frequency) / RATE)
    expected = np.exp(-2j * np.pi * frequency * length_m / SPEED_OF_SOUND) / length_m
    np.testing.assert_allclose(spectrum * length_m, expected * length_m, atol=2e-3)
    state = next(iter(renderer._mixers)).direct.state
    assert not state.spectra.any(), "a filter was computed that nothing calls for"


def test_one_ear_is_heard_alike_by_both_of_a_stereo_output(engine):
    renderer, alone = engine(has_head=False), engine(has_head=False, outputs=1)
    for each in (renderer, alone):
        add(each, noise(7, 2_000), ir=room(8, channels=1))
    both, one = run(renderer, 20), run(alone, 20)
    np.testing.assert_array_equal(both, np.repeat(one, 2, axis=0))


@pytest.mark.parametrize("first", [1, 2])
@pytest.mark.parametrize("has_ir", [False, True])
def test_a_head_is_put_on_and_taken_off_by_a_fade_of_what_goes_in(engine, first, has_ir):
    clip, second = noise(9, 9_000), 3 - first
    irs = {channels: room(10, channels=channels) if has_ir else None for channels in (1, 2)}

    def always(channels, weight):
        renderer = engine(has_head=channels == 2)
        played = np.resize(clip, 60 * SIZE) * weight
        add(renderer, played.astype(np.float32), irs[channels])
        return run(renderer, 60)

    renderer = engine(has_head=first == 2)
    add(renderer, clip, irs[first])
    heard = [run(renderer, 12)]
    assert renderer.can_set_channels(second)
    renderer.set_channels(second)
    if has_ir:
        renderer.set_ir("a", irs[second])
    assert not renderer.can_set_channels(first)
    heard.append(run(renderer, 48))
    fade = np.ones(60 * SIZE)
    fade[12 * SIZE : 13 * SIZE] = raised_cosine(SIZE)[::-1]
    fade[13 * SIZE :] = 0
    expected = always(first, fade) + always(second, 1 - fade)
    # A path that begins with silence is one that begins later.
    assert error_db(np.concatenate(heard, axis=1), expected) < -100


def test_what_rang_out_after_a_head_was_taken_off_is_let_go(engine):
    renderer = engine()
    add(renderer, tone(), ir=room(11))
    run(renderer, 5)
    renderer.set_ir("a", room(12, channels=1))
    renderer.set_channels(1)
    run(renderer, 3)
    assert len(list(renderer._mixers)) == 2
    run(renderer, 2 * SECOND)
    assert [mixer.channels for mixer in renderer._mixers] == [1]
    assert renderer.convolvers == 1


def test_a_source_that_changes_its_ears_is_asked_once_per_block(engine):
    class Counting:
        def __init__(self):
            self.asked = 0

        def process(self, out):
            out[:] = np.sin(2 * np.pi * 997 * (self.asked * SIZE + np.arange(SIZE)) / RATE)
            self.asked += 1

        def reset(self):
            self.asked = 0

    source, renderer = Counting(), engine()
    renderer.add_emitter("a", source, awaits_ir=False)
    renderer.set_path("a", PathTarget(2.0, AHEAD, FLAT))
    heard = [run(renderer, 20)]
    renderer.set_channels(1)
    heard.append(run(renderer, 20))
    assert source.asked == 40
    assert splatter_db(np.concatenate(heard, axis=1)[:, SIZE:]) < -90


def toggles(renderer):
    """Each with what it takes to switch it off and on again, by name."""
    bands = np.array([0, -2, -4, -6, -9, -12, -15.0])
    irs = {channels: renderer.prepare(room(13, channels=channels)) for channels in (1, 2)}
    shorter = renderer.prepare(room(13)[:, :500])

    def ears(channels):
        if renderer.can_set_channels(channels):
            renderer.set_channels(channels)
            renderer.set_ir("a", irs[channels])

    return {
        "direct_path": lambda on: renderer.enable_direct("a", is_heard=on),
        "distance_attenuation": lambda on: renderer.enable_direct("a", distance=on),
        "air_absorption": lambda on: renderer.enable_direct("a", air=on),
        "occlusion": lambda on: renderer.set_path("a", PathTarget(3.0, AHEAD, bands if on else FLAT)),
        "hrtf": lambda on: ears(2 if on else 1),
        "responses": lambda on: renderer.set_ir("a", irs[2]) if on else renderer.drop_ir("a"),
        "late_reverberation": lambda on: renderer.set_ir("a", irs[2] if on else shorter),
    }


@pytest.mark.parametrize(
    "name",
    [
        "direct_path",
        "distance_attenuation",
        "air_absorption",
        "occlusion",
        "hrtf",
        "responses",
        "late_reverberation",
    ],
)
@pytest.mark.parametrize("every", [3, 64])
def test_what_is_switched_while_a_tone_sounds_does_not_splatter(engine, name, every):
    renderer = engine()
    add(renderer, tone(), ir=room(13))
    run(renderer, 40)
    switch = toggles(renderer)[name]
    heard = []
    for number in range(2 * SECOND):
        if number % every == 0:
            switch(bool(number // every % 2))
        heard.append(renderer.process())
    assert splatter_db(np.concatenate(heard, axis=1)) < -90
