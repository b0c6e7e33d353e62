"""Silence after sound: exact, soon, and no dearer than sound."""

import threading
import time

import numpy as np
import pytest

from tests.hard_cases.listening import IR_SAMPLES, SIZE, ahead, hear, not_finite, play, renderer, room
from tests.signals import noise

RUNG_OUT = IR_SAMPLES // SIZE + 40


def full(engine, clip, *, loop):
    for name in "abcd":
        play(engine, clip, room(ord(name)), path=ahead(3.0), name=name, loop=loop)


def median_s(engine, blocks):
    times = []
    for _ in range(blocks):
        began = time.perf_counter()
        engine.process()
        times.append(time.perf_counter() - began)
    return float(np.median(times))


@pytest.mark.parametrize("loudness", [1e-30, 1e-6, 1.0, 1e6])
def test_after_any_sound_silence_is_exact_within_the_response(measured, filters, loudness):
    engine = renderer(filters)
    full(engine, np.float32(loudness) * noise(1, 20 * SIZE), loop=False)
    hear(engine, 20 + RUNG_OUT)
    measured("largest sample", np.abs(hear(engine, 20)).max(), 0.0)


def test_a_block_of_silence_after_loud_sound_costs_no_more_than_one_of_sound(measured, filters):
    sounding, silent = renderer(filters), renderer(filters)
    full(sounding, noise(1, 5_000), loop=True)
    full(silent, 1e6 * noise(1, 20 * SIZE), loop=False)
    for engine in (sounding, silent):
        hear(engine, 20)
    # While it rings out, and when it has: beside sound at the same time, so that a busy machine is as busy for both.
    ratios = [median_s(silent, 10) / median_s(sounding, 10) for _ in range(6)]
    measured("cost while ringing out beside sound", float(np.median(ratios)), 1.3)
    hear(silent, RUNG_OUT)
    ratios = [median_s(silent, 10) / median_s(sounding, 10) for _ in range(10)]
    measured("cost beside sound", float(np.median(ratios)), 0.7)


@pytest.mark.parametrize("amplitude", [1e-36, 1e-37, 1.2e-38])
def test_a_block_at_the_edge_of_denormal_numbers_costs_no_more_than_any(measured, filters, amplitude):
    loud, faint = renderer(filters), renderer(filters)
    full(loud, noise(1, 5_000), loop=True)
    full(faint, np.float32(amplitude) * noise(1, 5_000), loop=True)
    for engine in (loud, faint):
        hear(engine, 40)
    ratios = [median_s(faint, 10) / median_s(loud, 10) for _ in range(20)]
    measured("cost beside full scale", float(np.median(ratios)), 1.25)


def test_products_of_the_faintest_numbers_are_zero_and_only_in_there(measured):
    """The mode of a thread's arithmetic is as before after a block, on the thread that rendered it."""
    engine = renderer()
    play(engine, np.full(3_000, 1e-30, np.float32), np.full((2, 1), 1e-9, np.float32))
    seen = []

    def run():
        heard = hear(engine, 4)
        seen.append((np.abs(heard).max(), (np.full(4, 1e-30, np.float32) * np.float32(1e-9)).max()))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    (largest, outside) = seen[0]
    measured("largest product inside", largest, 0.0)
    measured("product outside", float(outside), 9e-40, at_least=True)


def test_a_removed_emitter_rings_out_and_makes_room(measured, filters):
    engine = renderer(filters, max_emitters=1)
    play(engine, noise(1, 3_000), room(2), path=ahead())
    hear(engine, 10)
    engine.remove_emitter("a")
    ringing = hear(engine, 2 + RUNG_OUT)
    assert not_finite(ringing) == 0
    heard = np.abs(ringing[:, 3 * SIZE : 6 * SIZE]).max()
    measured("heard of it while it rings out", heard, 0.1, at_least=True)
    measured("after it has rung out", np.abs(hear(engine, 20)).max(), 0.0)
    for _ in range(5):
        play(engine, noise(1, 3_000), room(2), path=ahead())
        hear(engine, 2)
        engine.remove_emitter("a")
        hear(engine, 2 + RUNG_OUT)


def test_a_pause_in_a_clip_is_exactly_silent_and_the_clip_goes_on(measured, filters):
    clip = np.concatenate([noise(1, SIZE), np.zeros((RUNG_OUT + 20) * SIZE, np.float32)])
    engine = renderer(filters)
    play(engine, clip, room(2), path=ahead())
    first = hear(engine, clip.size // SIZE)
    again = hear(engine, clip.size // SIZE)
    measured("largest sample in the pause", np.abs(first[:, -10 * SIZE :]).max(), 0.0)
    measured("largest difference of the second time", np.abs(first - again).max(), 2e-6)
