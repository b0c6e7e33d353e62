"""The first block, and the first sound in it."""

import numpy as np
import pytest

from tests.hard_cases.listening import (
    IR_SAMPLES,
    RATE,
    SIZE,
    Listening,
    ahead,
    convolved,
    decibels,
    hear,
    not_finite,
    play,
    played,
    renderer,
    room,
)
from tests.signals import error_db, noise


def test_the_first_block_of_nothing_is_silence(measured, filters):
    measured("largest sample", np.abs(hear(renderer(filters), 1)).max(), 0.0)


def test_the_first_block_begins_with_the_first_sample_of_its_clip(measured):
    engine, clip, ir = renderer(), noise(1, 5_000), room(2)
    play(engine, clip, ir)
    measured("error", error_db(hear(engine, 1), convolved(clip, ir, SIZE)), -120, "dB")


@pytest.mark.parametrize("block_size", [64, 128, 512, 1024])
def test_the_first_blocks_are_the_same_in_blocks_of_any_size(measured, block_size):
    clip, ir = noise(1, 5_000), room(2)
    engine = renderer(block_size=block_size)
    play(engine, clip, ir)
    measured("error", error_db(hear(engine, 4096 // block_size), convolved(clip, ir, 4096)), -120, "dB")


def test_before_sound_can_arrive_there_is_none(measured, filters):
    engine = renderer(filters)
    play(engine, noise(3, 5_000), path=ahead(6.0))
    arrives = int(6.0 / 343 * RATE)
    heard = hear(engine, 4)
    # The interpolation between samples begins half its length before, and an ear is nearer than the head's centre.
    margin = 16 + int(0.0008 * RATE)
    before, after = heard[:, : arrives - margin], heard[:, arrives:]
    measured("before the sound arrives", decibels(np.abs(before).max() / np.abs(after).max()), -90, "dB")


def test_an_emitter_without_response_and_path_waits_in_silence(measured, filters):
    engine = renderer(filters)
    engine.add_emitter("a", _Never())
    measured("largest sample", np.abs(hear(engine, 4)).max(), 0.0)


class _Never:
    """A source that must not be asked."""

    def process(self, _out):
        raise AssertionError("asked for sound before it can be heard")

    def reset(self):
        pass


def test_a_stream_started_twice_is_the_same_to_the_bit(measured, field, filters):
    def first():
        listening = Listening(field, filters)
        listening.add()
        return listening.hear(30)

    measured("largest difference", np.abs(first() - first()).max(), 0.0)


def test_a_renderer_that_was_reset_is_like_a_new_one(measured, filters):
    engine, fresh = renderer(filters), renderer(filters)
    play(engine, 1e6 * noise(4, 3_000), room(5), path=ahead(0.0))
    hear(engine, 10)
    engine.reset()
    outputs = []
    for one in (engine, fresh):
        play(one, noise(6, 3_000), room(7), path=ahead(3.0))
        outputs.append(hear(one, 40))
    measured("largest difference", np.abs(outputs[0] - outputs[1]).max(), 0.0)


def test_the_shortest_clip_there_is_loops(measured):
    engine, clip, ir = renderer(), np.ones(1, np.float32), room(8)
    play(engine, clip, ir)
    samples = 30 * SIZE
    measured("error", error_db(hear(engine, 30), convolved(played(clip, samples), ir, samples)), -120, "dB")


def test_a_response_as_long_as_there_is_room_for_is_heard_to_its_last_sample(measured):
    ir = np.zeros((2, IR_SAMPLES), np.float32)
    ir[:, -1] = 1
    engine, clip = renderer(), noise(9, 700)
    play(engine, clip, ir, loop=False)
    blocks = -(-(IR_SAMPLES + clip.size) // SIZE)
    heard = hear(engine, blocks)
    assert not_finite(heard) == 0
    measured("error", error_db(heard, convolved(clip, ir, blocks * SIZE)), -110, "dB")
