import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from server.core.errors import RequestError
from server.protocol.blocks import AudioBlock, DryBlock

u32 = st.integers(0, 2**32 - 1)


def test_an_audio_block_has_the_documented_layout():
    samples = np.array([[0.25, 0.5], [-0.25, -0.5]], np.float32)
    block = AudioBlock(3, 768, 12, 9, samples, is_exchange=True, is_late=True)
    header = bytes([1, 3]) + struct.pack("<HIQIII", 2, 3, 768, 12, 9, 2)
    assert len(header) == AudioBlock.HEADER_BYTES == 28
    assert block.serialize("f32") == header + np.array([0.25, -0.25, 0.5, -0.5], "<f4").tobytes()


@given(u32, st.integers(0, 2**64 - 1), u32, u32, st.booleans(), st.booleans(), st.integers(0, 9))
def test_float_blocks_survive_the_wire_exactly(sequence, clock, pose, reverberation_pose, is_exchange, is_late, seed):
    samples = np.random.default_rng(seed).standard_normal((2, 16), dtype=np.float32)
    block = AudioBlock(sequence, clock, pose, reverberation_pose, samples, is_exchange, is_late)
    back = AudioBlock.parse(block.serialize("f32"), "f32")
    assert_array_equal(back.samples, samples)
    assert (back.sequence, back.sample_clock, back.is_exchange, back.is_late) == (sequence, clock, is_exchange, is_late)
    assert (back.pose_id, back.reverberation_pose_id) == (pose, reverberation_pose)


def test_integer_blocks_keep_half_a_step_and_clip_instead_of_wrapping():
    samples = np.array([np.linspace(-1, 1, 101), np.linspace(-3, 3, 101)], np.float32)
    back = AudioBlock.parse(AudioBlock(0, 0, 0, 0, samples).serialize("s16"), "s16").samples
    assert_allclose(back, np.clip(samples, -1, 1), atol=0.5 / 32767 + 1e-7)


@pytest.mark.parametrize(
    "data", [b"", b"\x02" * 40, AudioBlock(0, 0, 0, 0, np.zeros((2, 4), np.float32)).serialize("f32")[:-8]]
)
def test_a_partial_block_is_not_a_block(data):
    with pytest.raises(ValueError):
        AudioBlock.parse(data, "f32")


def test_a_dry_block_has_the_documented_layout():
    block = DryBlock("voice", 7, np.array([0.5, -1.0], np.float32))
    header = bytes([3, 0]) + struct.pack("<HII", 5, 7, 2) + b"voice\0\0\0"
    assert block.serialize("f32") == header + np.array([0.5, -1.0], "<f4").tobytes()
    integers = bytes([3, 1]) + struct.pack("<HII", 5, 7, 2) + b"voice\0\0\0"
    assert block.serialize("s16") == integers + np.array([16384, -32767], "<i2").tobytes()


@given(st.text(min_size=1, max_size=64).filter(lambda text: text.isprintable()), u32, st.integers(1, 700))
def test_dry_blocks_survive_the_wire(identifier, sequence, frames):
    samples = np.linspace(-1, 1, frames, dtype=np.float32)
    for encoding, tolerance in (("f32", 0), ("s16", 0.51 / 32767)):
        back = DryBlock.parse(DryBlock(identifier, sequence, samples).serialize(encoding))
        assert (back.id, back.sequence) == (identifier, sequence)
        assert_allclose(back.samples, samples, rtol=0, atol=tolerance)


GOOD = DryBlock("a", 0, np.zeros(4, np.float32)).serialize("f32")


@pytest.mark.parametrize(
    ("data", "field"),
    [
        (GOOD[:11], "header"),
        (b"\x03\xff" + GOOD[2:], "encoding"),
        (GOOD[:12] + b"\xff" + GOOD[13:], "id"),
        (GOOD[:-1], "frames"),
        (GOOD + b"\0", "frames"),
        (struct.pack("<BBHII", 3, 0, 1, 0, 0) + b"a\0\0\0", "frames"),
        (struct.pack("<BBHII", 3, 0, 257, 0, 4) + bytes(20), "id"),
        (struct.pack("<BBHII", 3, 0, 256, 0, 4) + bytes(20), "frames"),
        (struct.pack("<BBHII", 3, 0, 1, 0, 2**32 - 1) + bytes(20), "frames"),
    ],
)
def test_a_bad_dry_block_names_what_is_wrong(data, field):
    with pytest.raises(RequestError) as refusal:
        DryBlock.parse(data)
    assert (refusal.value.code, refusal.value.field) == ("malformed_block", field)


@given(st.binary(max_size=64))
def test_any_bytes_are_a_dry_block_or_are_refused(data):
    try:
        block = DryBlock.parse(b"\x03" + data)
    except RequestError:
        return
    assert block.samples.dtype == np.float32
    assert block.samples.size
