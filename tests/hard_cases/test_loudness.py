"""Sounds that would clip: in a stream and offline alike, told to the client, and over when they are over."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from server.acoustics.geometry import Pose
from server.offline.render import PathPoint, RenderedEmitter, render
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import ListenerPose
from server.rendering.limiter import CEILING, Limiter
from server.responses.direct_sound import DirectSound
from tests.hard_cases.listening import HERE, SIZE, THERE, Listening, decibels, not_finite
from tests.signals import noise

LOUD = 20 * noise(1, 10_000)


@given(
    st.lists(
        st_numpy.arrays(np.float32, (2, 64), elements=st.floats(width=32, allow_nan=True, allow_infinity=True)),
        min_size=1,
        max_size=4,
    )
)
def test_no_block_of_any_bits_leaves_beyond_the_ceiling(measured, blocks):
    limiter = Limiter(channels=2, block_size=64, sample_rate=24_000)
    with np.errstate(over="ignore", invalid="ignore"):
        for block in blocks:
            out = block.copy()
            limiter.process(out)
            assert not_finite(out) == 0
            measured("peak beside the ceiling", float(np.abs(out).max()) / CEILING, 1 + 1e-6)
        quiet = np.full((2, 64), 0.01, np.float32)
        for _ in range(2_000):
            out = quiet.copy()
            limiter.process(out)
    measured("off, once it is over", float(np.abs(out - quiet).max()), 0.0)


def test_a_stream_and_a_file_are_limited_to_the_same_samples(measured, field, filters):
    listening = Listening(field, filters, clip=LOUD)
    listening.say(ListenerPose(pose_id=1, position=HERE))
    listening.add(loop=False)
    streamed = listening.hear(30)
    offline = render(
        field,
        DirectSound.of(field.bundle, filters),
        [RenderedEmitter(LOUD, Pose(THERE))],
        [PathPoint.at(0, Pose(HERE))],
        length=30 * SIZE,
    )
    assert listening.session.blocks_limited > 10
    measured("largest difference", np.abs(streamed - offline).max(), 0.0)
    measured("peak", decibels(np.abs(streamed).max()), -1 + 1e-5, "dB")


def test_a_client_is_told_which_blocks_were_turned_down(field, filters):
    listening = Listening(field, filters, clip=LOUD)
    listening.add(loop=False)
    listening.answer()
    flags = [AudioBlock.parse(listening.session.render_block().serialize("f32"), "f32").is_limited for _ in range(600)]
    assert any(flags)
    assert not any(flags[-50:])
    assert sum(flags) == listening.session.blocks_limited


@pytest.mark.parametrize("encoding", ["f32", "s16"])
def test_what_is_sent_never_wraps_round(measured, field, filters, encoding):
    listening = Listening(field, filters, clip=LOUD)
    listening.add()
    listening.answer()
    for _ in range(20):
        block = listening.session.render_block()
        sent = AudioBlock.parse(block.serialize(encoding), encoding).samples
        measured("largest change by encoding", float(np.abs(sent - block.samples).max()), 1 / 32_767)


def test_a_quiet_stream_is_never_turned_down(measured, field, filters):
    listening = Listening(field, filters)
    listening.add()
    listening.hear(100)
    measured("blocks turned down", listening.session.blocks_limited, 0)


def test_one_loud_emitter_does_not_stop_the_others_for_longer_than_it_sounds(measured, field, filters):
    """Recovery: 3 s after the noise the whisper is what it would have been."""
    outputs = []
    for is_loud in (True, False):
        listening = Listening(field, filters, clip=0.001 * noise(2, 7_000))
        listening.add("whisper")
        if is_loud:
            listening.session._load_clip = lambda _name: 1e4 * noise(3, 2_000)
            listening.add("noise", loop=False)
        listening.hear(math.ceil(3.5 * 24_000 / SIZE))
        outputs.append(listening.hear(20))
    measured("error", decibels(np.abs(outputs[0] - outputs[1]).max() / np.abs(outputs[1]).max()), -80, "dB")
