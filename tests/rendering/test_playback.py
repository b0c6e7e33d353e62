"""When clips start, repeat, stop and have been heard, and how gains follow ramps: to the sample, and the same whether
compiled code plays them or NumPy does (blocks of a power of two, or of any other size)."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.acoustics.decibels import amplitude_to_db, db_to_amplitude
from server.rendering.renderer import Renderer
from server.rendering.sources import FADE_SAMPLES, ClipPlayer, LiveSource
from tests.signals import decaying_noise, noise

SIZES = (64, 96)
BOTH_KINDS = pytest.mark.parametrize("size", SIZES, ids=["compiled", "any size"])
AT_ONCE = np.ones((1, 1), np.float32)


def renderer(size=64, **options):
    """One without direct paths: with the response `AT_ONCE` it hears the dry signals, as without a head."""
    return Renderer(
        block_size=size,
        ir_samples=500,
        sample_rate=24_000,
        filters=None,
        speed_of_sound=343.0,
        air_db_per_m=np.zeros(7),
        has_head=False,
        **options,
    )


def hear(engine, blocks):
    """(n,)"""
    return np.concatenate([engine.process()[0] for _ in range(blocks)]).astype(float)


def expected(clip, samples, *, offset=0, loop=None, starts=0, stops=None, fade=1):
    """What a clip sounds like from clock 0 on, sample by sample."""
    out = np.zeros(samples)
    at = offset
    for n in range(starts, samples):
        if loop is not None and at == loop[1]:
            at = loop[0]
        if at == clip.size:
            break
        rise = 0.5 - 0.5 * np.cos(np.pi * (n - starts + 0.5) / FADE_SAMPLES)
        out[n] = clip[at] * (rise if offset and n - starts < FADE_SAMPLES else 1.0)
        at += 1
    if stops is not None:
        since = np.arange(samples) - stops
        out *= np.where(since < 0, 1.0, 0.5 + 0.5 * np.cos(np.pi * np.clip((since + 0.5) / fade, 0, 1)))
        if stops <= starts:
            out[:] = 0
    return out


@st.composite
def playbacks(draw):
    length = draw(st.integers(1, 400))
    loops = draw(st.booleans())
    loop_start = draw(st.integers(0, length - 1)) if loops else 0
    loop_end = draw(st.integers(loop_start + 1, length)) if loops else length
    return {
        "clip": 1 + np.arange(length, dtype=np.float32) / length,
        "offset": draw(st.integers(0, loop_end - 1)),
        "loop": (loop_start, loop_end) if loops else None,
        "starts": draw(st.integers(0, 500)),
        "stops": draw(st.none() | st.integers(0, 700)),
        "fade": draw(st.integers(1, 200)),
    }


@settings(max_examples=60, deadline=None)
@given(playback=playbacks(), size=st.sampled_from(SIZES))
def test_a_clip_is_played_to_the_sample(playback, size):
    loop, stops = playback["loop"], playback["stops"]
    ends = {} if loop is None else {"loop_start": loop[0], "loop_end": loop[1]}
    player = ClipPlayer(
        playback["clip"], loop=loop is not None, offset=playback["offset"], starts_at=playback["starts"], **ends
    )
    engine = renderer(size)
    engine.add_emitter("a", player)
    engine.set_ir("a", AT_ONCE)
    if stops is not None:
        engine.stop_emitter("a", stops, fade=playback["fade"])
    heard = hear(engine, 12)
    np.testing.assert_allclose(heard, expected(samples=heard.size, **playback), rtol=1e-6, atol=1e-6)


@BOTH_KINDS
def test_what_is_late_starts_with_the_next_block_from_its_beginning(size):
    clip, engine = noise(1, 300), renderer(size)
    engine.add_emitter("a", ClipPlayer(clip, loop=False, starts_at=10))
    hear(engine, 2)
    engine.set_ir("a", AT_ONCE)
    np.testing.assert_allclose(hear(engine, 6)[:300], clip, atol=1e-6)


@BOTH_KINDS
def test_a_start_is_by_the_clock_of_the_renderer(size):
    clip, engine = noise(1, 300), renderer(size)
    hear(engine, 3)
    engine.add_emitter("a", ClipPlayer(clip, loop=False, starts_at=3 * size + 7))
    engine.set_ir("a", AT_ONCE)
    np.testing.assert_allclose(hear(engine, 6)[: 7 + 300], [*np.zeros(7), *clip], atol=1e-6)


@BOTH_KINDS
def test_the_newest_stop_counts_until_the_fade_begins(size):
    clip, engine = np.ones(5_000, np.float32), renderer(size)
    engine.add_emitter("a", ClipPlayer(clip, loop=True))
    engine.set_ir("a", AT_ONCE)
    hear(engine, 2)
    engine.stop_emitter("a", 1_000)
    engine.stop_emitter("a", 3 * size + 5, fade=200)
    begun = hear(engine, 2)
    engine.stop_emitter("a", 2_000)
    heard = np.concatenate([begun, hear(engine, 5)])
    np.testing.assert_allclose(heard, expected(clip, 9 * size, stops=3 * size + 5, fade=200)[2 * size :], atol=1e-6)


@BOTH_KINDS
def test_a_clip_that_is_stopped_before_it_can_be_heard_is_never_heard(size):
    engine = renderer(size)
    engine.add_emitter("a", ClipPlayer(np.ones(5_000, np.float32), loop=True))
    engine.stop_emitter("a", 2 * size, fade=500)
    hear(engine, 2)
    assert not engine.has_ended("a"), "its first response may come yet"
    engine.set_ir("a", AT_ONCE)
    assert not hear(engine, 20).any()
    assert engine.has_ended("a")


@BOTH_KINDS
def test_a_clip_has_ended_when_its_room_is_silent_and_not_before(size):
    engine = renderer(size)
    engine.add_emitter("a", ClipPlayer(noise(1, 3 * size), loop=False))
    engine.set_ir("a", decaying_noise(2, 500, 1, decay_samples=200))
    heard, told = [], []
    for _ in range(40):
        heard.append(hear(engine, 1).any())
        told.append(engine.has_ended("a"))
    assert told[-1]
    assert not any(has_ended and is_heard for has_ended, is_heard in zip(told, heard, strict=True))
    assert any(is_heard and number >= 3 for number, is_heard in enumerate(heard)), "its reverberation outlasts it"


def test_only_clips_stop_and_end():
    engine = renderer()
    engine.add_emitter("a", LiveSource(capacity=4_096, lead=512))
    engine.set_ir("a", AT_ONCE)
    with pytest.raises(ValueError, match="'a' plays no clip"):
        engine.stop_emitter("a", 0)
    hear(engine, 20)
    assert not engine.has_ended("a")
    engine.add_emitter("b", ClipPlayer(noise(1, 10), loop=True))
    engine.set_ir("b", AT_ONCE)
    hear(engine, 20)
    assert not engine.has_ended("b")


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"offset": 10, "loop": False}, "offset 10"),
        ({"offset": -1, "loop": False}, "offset -1"),
        ({"offset": 5, "loop": True, "loop_end": 5}, "offset 5"),
        ({"loop": True, "loop_start": 5, "loop_end": 5}, "from sample 5 to 5"),
        ({"loop": True, "loop_end": 11}, "to 11"),
    ],
)
def test_what_lies_outside_a_clip_is_refused(options, problem):
    with pytest.raises(ValueError, match=problem):
        ClipPlayer(np.ones(10, np.float32), **options)


def ramped(size, *, gain=1.0, ramp=1_000):
    """A renderer of a constant, two blocks before its gain begins to go from 1 to `gain`, and what it played so far."""
    engine = renderer(size)
    engine.add_emitter("a", ClipPlayer(np.ones(10, np.float32), loop=True))
    engine.set_ir("a", AT_ONCE)
    heard = hear(engine, 2)
    engine.set_gain("a", gain, ramp=ramp)
    return engine, heard


@BOTH_KINDS
@pytest.mark.parametrize("ramp", [1, 63, 64, 1_000])
@pytest.mark.parametrize("gain_db", [-80.0, -12.0, 24.0])
def test_a_ramp_is_linear_in_decibels_and_ends_to_the_sample(size, ramp, gain_db):
    engine, before = ramped(size, gain=float(db_to_amplitude(gain_db)), ramp=ramp)
    np.testing.assert_allclose(before, 1.0, atol=1e-6)
    heard = hear(engine, 20)
    steps = np.minimum(np.arange(1, heard.size + 1) / ramp, 1.0)
    np.testing.assert_allclose(heard, db_to_amplitude(gain_db * steps), rtol=1e-5, atol=1e-6)


@BOTH_KINDS
def test_a_newer_gain_goes_on_from_where_a_ramp_is(size):
    engine, _ = ramped(size, gain=0.01, ramp=20 * size)
    hear(engine, 10)
    engine.set_gain("a", 1.0, ramp=10 * size)
    heard_db = amplitude_to_db(hear(engine, 10))
    np.testing.assert_allclose(heard_db, -20 + 20 * np.arange(1, 10 * size + 1) / (10 * size), atol=1e-3)
    engine.set_gain("a", 0.1, ramp=20 * size)
    hear(engine, 10)
    engine.set_gain("a", 1.0)
    heard = hear(engine, 2)
    assert heard[0] == pytest.approx(10**-0.5, rel=0.01)
    assert (np.diff(heard) > -1e-5).all()
    np.testing.assert_allclose(heard[size:], 1.0, atol=1e-6)


@BOTH_KINDS
def test_a_ramp_is_not_lost_where_an_emitter_changes_its_hearing(size):
    engine, _ = ramped(size, gain=0.01, ramp=20 * size)
    hear(engine, 5)
    engine.set_ir("a", np.ones((2, 1), np.float32))
    heard_db = amplitude_to_db(hear(engine, 20))
    steps = np.minimum(np.arange(5 * size + 1, 25 * size + 1) / (20 * size), 1.0)
    np.testing.assert_allclose(heard_db, -40 * steps, atol=0.01)


def test_a_removed_emitter_goes_in_the_middle_of_a_ramp():
    engine, _ = ramped(64, gain=10.0, ramp=64_000)
    hear(engine, 3)
    engine.remove_emitter("a")
    heard = hear(engine, 20)
    assert (np.diff(heard) <= 1e-3).all()
    assert not heard[64 + 500 :].any()


def test_silence_is_no_end_of_a_ramp():
    engine, _ = ramped(64)
    with pytest.raises(ValueError, match="above 0"):
        engine.set_gain("a", 0.0, ramp=10)
    engine.set_gain("a", 0.0)
    with pytest.raises(ValueError, match="above 0"):
        engine.set_gain("a", 1.0, ramp=10)
