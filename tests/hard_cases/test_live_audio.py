"""What comes in by the door for sound: numbers that are none, and signals at the edges of what a number can say."""

import math
import struct

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from scipy.signal import fftconvolve

from server.acoustics.geometry import Pose
from server.assets.clips import DecodeError, decode
from server.offline.render import PathPoint, RenderedEmitter, render
from server.protocol.blocks import DryBlock
from server.protocol.client_messages import AddEmitter
from server.rendering.direct_path import PathTarget
from server.rendering.ingest import LOUDEST, DryAudio
from server.rendering.sources import LiveSource
from server.responses.direct_sound import DirectSound
from tests.hard_cases.listening import (
    RATE,
    SIZE,
    THERE,
    Listening,
    convolved,
    decibels,
    energy_db,
    hear,
    not_finite,
    passive_energy_db,
    play,
    renderer,
    room,
    tone,
)
from tests.signals import error_db, noise

NO_AUDIO = {
    "not a number": math.nan,
    "negative not a number": -math.nan,
    "a signalling one": struct.unpack("<f", b"\x01\x00\xa0\x7f")[0],
    "infinity": math.inf,
    "negative infinity": -math.inf,
    "beyond the loudest": 1.001 * LOUDEST,
    "the largest float": 3.4e38,
    "an integer that was never scaled": 2.0**31,
}
bad = pytest.mark.parametrize("value", NO_AUDIO.values(), ids=NO_AUDIO)
LIVE = AddEmitter(id="a", live=True, position=THERE)


def live(field, filters, dry, blocks=40):
    """(2, n) of what a client sends, block by block."""
    listening = Listening(field, filters)
    listening.say(LIVE)
    listening.answer()
    for sequence, part in enumerate(np.array_split(dry, 6)):
        listening.say(DryBlock("a", sequence, part.astype(np.float32)))
    return listening.hear(blocks), listening


@bad
def test_a_live_sample_that_is_no_audio_is_silence_and_its_neighbours_are_themselves(measured, field, filters, value):
    dry = 0.005 * noise(1, 8_000)
    spoilt, mended = dry.copy(), dry.copy()
    spoilt[[0, 1_000, 1_001, 7_999]], mended[[0, 1_000, 1_001, 7_999]] = value, 0.0
    (heard, listening), (expected, _) = live(field, filters, spoilt), live(field, filters, mended)
    measured("largest difference", np.abs(heard - expected).max(), 0.0)
    assert listening.session.live_statuses()[0].samples_gated == 4
    assert [refusal.code for refusal in listening.session.complaints()] == ["bad_samples"]


@bad
def test_a_clip_of_a_callers_with_it_is_finite_from_the_first_block(measured, value):
    engine = renderer()
    clip = noise(1, 3_000)
    clip[[0, 500]] = value
    play(engine, clip, room(2))
    measured("samples not finite", not_finite(hear(engine, 20)), 0)


@bad
def test_a_file_with_it_is_refused_by_name(tmp_path, value):
    path = tmp_path / "bad.wav"
    clip = noise(1, 3_000)
    clip[500] = value
    soundfile.write(path, clip, RATE, subtype="FLOAT")
    with pytest.raises(DecodeError, match=r"bad\.wav: .*(not finite|not audio)"):
        decode(path, RATE)


@bad
def test_offline_it_is_silence_too(measured, field, filters, value):
    clips = [noise(1, 2_000), noise(1, 2_000)]
    clips[0][700], clips[1][700] = value, 0.0
    outputs = [
        render(
            field,
            DirectSound.of(field.bundle, filters),
            [RenderedEmitter(clip, Pose(THERE))],
            [PathPoint.at(0, Pose((2.0, 2.0, 1.5)))],
            length=10 * SIZE,
        )
        for clip in clips
    ]
    measured("largest difference", np.abs(outputs[0] - outputs[1]).max(), 0.0)


@given(st.binary(min_size=4, max_size=400).filter(lambda data: len(data) % 4 == 0))
def test_any_bits_at_all_leave_the_door_as_sound(measured, data):
    given_bits = np.frombuffer(data, np.float32)
    audio = DryAudio(given_bits)
    size = np.abs(audio.samples)
    measured("largest sample", float(size.max()), LOUDEST)
    assert np.all((size == 0) | (size >= np.finfo(np.float32).tiny))
    with np.errstate(invalid="ignore"):
        kept = np.isfinite(given_bits) & (np.abs(given_bits) <= LOUDEST) & (size > 0)
    assert np.array_equal(audio.samples[kept], given_bits[kept])
    with np.errstate(invalid="ignore"):
        assert audio.silenced == np.count_nonzero(~(np.abs(given_bits) <= LOUDEST))


@pytest.mark.parametrize("value", [1e-45, -1e-45, 1e-39, -1.17e-38])
def test_a_denormal_sample_is_silence_and_nothing_to_complain_of(measured, value):
    audio = DryAudio(np.array([0.5, value, 0.5], np.float32))
    measured("what is left of it", float(np.abs(audio.samples[1])), 0.0)
    assert audio.silenced == 0


@pytest.mark.parametrize("dtype", [np.float64, np.int16, np.int64, np.float16, np.bool_])
def test_samples_of_other_types_come_in_as_floats(measured, dtype):
    values = np.array([0, 1, 1, 0, 1], dtype)
    samples = DryAudio(values).samples
    assert samples.dtype == np.float32
    measured("largest difference", np.abs(samples - values.astype(float)).max(), 0.0)


def test_doubles_beyond_any_float_are_silence():
    samples = DryAudio(np.array([1e300, -1e300])).samples
    assert samples.dtype == np.float32
    assert not samples.any()


@pytest.mark.parametrize("shape", [(2, 10), (), (1, 1, 1)])
def test_audio_of_another_shape_is_refused(shape):
    with pytest.raises(ValueError, match="mono"):
        DryAudio(np.zeros(shape, np.float32))


def test_what_came_in_cannot_be_changed_afterwards():
    given_samples = np.ones(10, np.float32)
    audio = DryAudio(given_samples)
    given_samples[:] = np.nan
    assert audio.samples.tolist() == [1.0] * 10
    with pytest.raises(ValueError, match="read-only"):
        audio.samples[0] = np.nan


SIGNALS = {
    "direct current": np.ones(20_000, np.float32),
    "a tone at Nyquist's frequency": np.tile([1.0, -1.0], 10_000).astype(np.float32),
    "a full-scale square wave": np.sign(tone(441, 20_000) + 1e-9).astype(np.float32),
    "impulses of one sample": (np.arange(20_000) % 977 == 0).astype(np.float32),
    "one impulse": (np.arange(20_000) == 0).astype(np.float32),
    "an input of 1e-30": np.float32(1e-30) * noise(5, 20_000),
    "an input of 1e6": np.float32(LOUDEST) * np.sign(noise(6, 20_000)),
    "a step from silence to full scale": (np.arange(20_000) > 10_000).astype(np.float32),
    "white noise": noise(7, 20_000),
}
signals = pytest.mark.parametrize("clip", SIGNALS.values(), ids=SIGNALS)


@signals
def test_any_signal_is_convolved_as_in_double_precision(measured, clip):
    engine, ir = renderer(), room(2)
    play(engine, clip, ir, loop=False)
    measured("error", error_db(hear(engine, 90), convolved(clip, ir, 90 * SIZE)), -115, "dB")


@signals
def test_any_signal_keeps_within_the_energy_that_the_response_allows(measured, clip):
    engine, ir = renderer(), room(3)
    play(engine, clip, ir, loop=False)
    heard = hear(engine, 110)
    measured("energy beyond it", energy_db(heard) - passive_energy_db(clip, ir), 1e-3, "dB")


@signals
def test_any_signal_sounds_along_its_path_as_in_double_precision(measured, filters, clip):
    """Against its response, taken from the renderer one impulse at a time and convolved in double precision: a path at
    rest is linear and does not change with time, whatever comes along it."""
    path = PathTarget(3.0, (0.6, 0.8, 0.0), np.linspace(0, -6, 7))

    def heard(signal, blocks):
        engine = renderer(filters)
        play(engine, signal, path=path, loop=False)
        return hear(engine, blocks)

    impulse = np.zeros(2_000, np.float32)
    impulse[0] = 1
    response = heard(impulse, 8)
    expected = fftconvolve(clip.astype(float)[None], response, axes=1)[:, : 60 * SIZE]
    measured("error", error_db(heard(clip, 60), expected), -100, "dB")


@signals
def test_any_signal_played_twice_is_the_same_to_the_bit(measured, field, filters, clip):
    outputs = []
    for _ in range(2):
        listening = Listening(field, filters, clip=clip)
        listening.add()
        outputs.append(listening.hear(30))
    measured("largest difference", np.abs(outputs[0] - outputs[1]).max(), 0.0)


@signals
def test_any_signal_leaves_a_session_within_full_scale(measured, field, filters, clip):
    listening = Listening(field, filters, clip=clip)
    listening.add(gain_db=24.0)
    heard = listening.hear(60)
    assert not_finite(heard) == 0
    measured("peak", decibels(np.abs(heard).max()), -1.0 + 1e-5, "dB")


@given(
    st.lists(
        st.one_of(
            st.tuples(st.just("push"), st.integers(1, 3_000)),
            st.tuples(st.just("play"), st.integers(1, 8)),
        ),
        max_size=40,
    )
)
def test_a_client_that_sends_too_much_or_too_little_never_makes_a_click(measured, script):
    """A steady value comes out as itself or silence, and never moves faster than its fades."""
    source = LiveSource(capacity=12_000, lead=512)
    heard = [np.zeros(1)]
    for what, count in script:
        if what == "push":
            source.push(np.ones(count, np.float32))
        else:
            blocks = np.full((count, SIZE), np.nan, np.float32)
            for block in blocks:
                source.process(block)
            heard.append(blocks.ravel())
    wet = np.concatenate(heard).astype(float)
    measured("beyond what was sent", max(wet.max() - 1, -wet.min()), 1e-6)
    # The first sound may begin at once; after that, everything fades over 64 samples.
    steps = np.abs(np.diff(wet))
    loud = np.flatnonzero(wet > 0.5)
    after = steps[loud[0] :] if loud.size else steps[:0]
    measured("largest step after the first", float(np.max(after, initial=0.0)), math.pi / 2 / 64 * 1.01)
