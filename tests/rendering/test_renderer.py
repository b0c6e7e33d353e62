"""Laws of the renderer, against SciPy's convolution of what each emitter should have played."""

import gc
import threading
import time
import weakref
from functools import partial

import numpy as np
import pytest
from scipy.signal import fftconvolve

from server.rendering.fade import raised_cosine
from server.rendering.limiter import ANY_LIMITER
from server.rendering.output_kernel import mix_listeners
from server.rendering.partitions import Partitioning
from server.rendering.renderer import (
    DuplicateEmitterError,
    Renderer,
    RendererFullError,
    UnknownEmitterError,
    render_all,
)
from server.rendering.sources import ClipPlayer
from tests.signals import decaying_noise, error_db, noise

SIZE = 64
IR_SAMPLES = 500
RING_OUT_BLOCKS = Partitioning(SIZE, IR_SAMPLES).quiet_blocks
room = partial(decaying_noise, samples=IR_SAMPLES, decay_samples=100)


def renderer(**options):
    """One without direct paths: its laws are those of mixing and convolving."""
    defaults = {"sample_rate": 24_000, "filters": None, "speed_of_sound": 343.0, "air_db_per_m": np.zeros(7)}
    return Renderer(block_size=SIZE, ir_samples=IR_SAMPLES, **(defaults | options))


def add(engine, name, clip, *, gain=1.0, loop=True):
    engine.add_emitter(name, ClipPlayer(clip, loop=loop), gain=gain)


def emitter_ids(engine):
    return tuple(engine._emitters)


def run(engine, blocks):
    return np.concatenate([engine.process() for _ in range(blocks)], axis=1)


def convolve(dry, ir, samples):
    return fftconvolve(dry[np.newaxis].astype(float), ir.astype(float), axes=1)[:, :samples]


def test_it_is_freed_with_its_last_reference():
    """And not by the collector, which runs rarely in a server: streams would leave a megabyte each until then."""
    engine = renderer()
    add(engine, "a", noise(0, 700))
    engine.set_ir("a", room(1))
    run(engine, 3)
    reference = weakref.ref(engine)
    gc.disable()
    try:
        del engine
        assert reference() is None
    finally:
        gc.enable()


def test_every_emitter_is_its_clip_in_its_room():
    engine = renderer()
    clips = [noise(seed, 700) for seed in (3, 4, 5)]
    gains = [1.0, 0.25, 2.0]
    for number, (clip, gain) in enumerate(zip(clips, gains, strict=True)):
        add(engine, str(number), clip, gain=gain, loop=number > 0)
        engine.set_ir(str(number), room(number))
    blocks = 40
    played = [np.pad(clips[0], (0, blocks * SIZE))[: blocks * SIZE], *(np.resize(c, blocks * SIZE) for c in clips[1:])]
    expected = sum(gain * convolve(played[n], room(n), blocks * SIZE) for n, gain in enumerate(gains))
    assert error_db(run(engine, blocks), expected) < -120


def test_a_renderer_of_nothing_is_silent_and_keeps_time():
    engine = renderer()
    assert engine.sample_clock == 0
    assert not run(engine, 3).any()
    assert engine.sample_clock == 3 * SIZE


def test_an_emitter_waits_for_its_room_at_the_first_sample():
    clip = noise(6, 1_000)
    engine = renderer()
    add(engine, "a", clip)
    assert not run(engine, 5).any()
    assert engine.applied("a") is None
    engine.set_ir("a", room(7), token=1)
    assert error_db(run(engine, 10), convolve(clip, room(7), 10 * SIZE)) < -120
    assert not engine.exchanged


def test_blocks_say_whether_they_exchanged_and_which_token_is_in_effect():
    engine = renderer()
    for name in ("a", "b"):
        add(engine, name, noise(8, 100))
        engine.set_ir(name, room(9), token=1)
        assert engine.applied(name) is None
    engine.process()
    assert (engine.exchanged, engine.applied("a"), engine.applied("b")) == (False, 1, 1)
    engine.set_ir("a", room(10), token=2)
    engine.set_ir("a", room(11), token=3)
    assert (engine.exchanged, engine.applied("a")) == (False, 1)
    engine.process()
    assert (engine.exchanged, engine.applied("a"), engine.applied("b")) == (True, 3, 1)
    engine.process()
    assert (engine.exchanged, engine.applied("a"), engine.applied("b")) == (False, 3, 1)


def test_exchange_crossfades_two_rooms_over_the_next_block():
    clip = noise(12, 20 * SIZE)
    engine = renderer()
    add(engine, "a", clip)
    engine.set_ir("a", room(13))
    head = run(engine, 8)
    engine.set_ir("a", room(14))
    wet = np.concatenate([head, run(engine, 12)], axis=1)
    weight = np.repeat([0.0, 1.0], [8 * SIZE, 12 * SIZE])
    weight[8 * SIZE : 9 * SIZE] = raised_cosine(SIZE)
    old, new = (convolve(clip, room(seed), clip.size) for seed in (13, 14))
    assert error_db(wet, (1 - weight) * old + weight * new) < -120


def test_a_prepared_room_renders_the_same_from_any_thread():
    outputs = []
    for prepare_elsewhere in (False, True):
        engine = renderer()
        add(engine, "a", noise(15, 300))
        ir = room(16)
        if prepare_elsewhere:
            prepared = []
            worker = threading.Thread(target=lambda ir=ir, engine=engine, out=prepared: out.append(engine.prepare(ir)))
            worker.start()
            worker.join()
            ir = prepared[0]
        engine.set_ir("a", ir)
        outputs.append(run(engine, 10))
    np.testing.assert_array_equal(*outputs)


def test_gain_ramps_over_one_block_from_wherever_it_was():
    engine = renderer()
    add(engine, "a", np.ones(100, np.float32), gain=0.5)
    engine.set_ir("a", np.ones((2, 1), np.float32))
    rise = raised_cosine(SIZE)
    expected = [np.full(SIZE, 0.5)]
    played = [engine.process()]
    engine.set_gain("a", 9.0)
    engine.set_gain("a", 2.0)
    expected.append(0.5 + 1.5 * rise)
    played.append(engine.process())
    engine.set_gain("a", 1.0)
    expected.append(2.0 - rise)
    played.append(engine.process())
    expected.append(np.ones(SIZE))
    played.append(engine.process())
    np.testing.assert_allclose(np.concatenate(played, axis=1), [np.concatenate(expected)] * 2, atol=1e-6)


def test_a_gain_set_before_the_first_block_is_not_ramped_to():
    engine = renderer()
    add(engine, "a", np.ones(10, np.float32))
    engine.set_gain("a", 0.25)
    engine.process()
    engine.set_ir("a", np.ones((2, 1), np.float32))
    np.testing.assert_allclose(engine.process(), 0.25, atol=1e-6)


def test_a_removed_emitter_ramps_down_and_rings_out():
    clip = noise(17, 10 * SIZE)
    engine = renderer()
    add(engine, "a", clip, gain=0.5)
    engine.set_ir("a", room(18))
    head = run(engine, 4)
    engine.remove_emitter("a")
    assert emitter_ids(engine) == ()
    tail = run(engine, RING_OUT_BLOCKS + 2)
    played = 0.5 * clip
    played[4 * SIZE : 5 * SIZE] *= raised_cosine(SIZE)[::-1]
    played[5 * SIZE :] = 0
    wet = np.concatenate([head, tail], axis=1)
    expected = np.zeros(wet.shape)
    convolved = convolve(played, room(18), wet.shape[1])
    expected[:, : convolved.shape[1]] = convolved
    assert error_db(wet, expected) < -120
    assert not wet[:, -SIZE:].any()


def test_others_are_bit_equal_before_an_emitter_comes_and_after_it_has_gone():
    def wet(guest):
        engine = renderer()
        for number in range(3):
            add(engine, str(number), noise(number, 777))
            engine.set_ir(str(number), room(number))
        output = [run(engine, 5)]
        if guest:
            add(engine, "guest", noise(19, 400))
            engine.set_ir("guest", room(20))
        output.append(run(engine, 5))
        if guest:
            engine.set_ir("guest", room(21))
            engine.set_gain("guest", 0.3)
        output.append(run(engine, 5))
        if guest:
            engine.remove_emitter("guest")
        output.append(run(engine, 1 + RING_OUT_BLOCKS))
        output.append(run(engine, 20))
        return output

    with_guest, without = wet(True), wet(False)
    np.testing.assert_array_equal(with_guest[0], without[0])
    assert not np.array_equal(with_guest[1], without[1])
    np.testing.assert_array_equal(with_guest[-1], without[-1])


def test_an_id_is_free_at_once_and_its_successor_inherits_nothing():
    engine = renderer()
    add(engine, "a", noise(22, 300), gain=0.5)
    engine.set_ir("a", room(23), token=7)
    engine.process()
    engine.remove_emitter("a")
    add(engine, "a", noise(24, 10 * SIZE))
    assert engine.applied("a") is None
    run(engine, RING_OUT_BLOCKS)
    assert not engine.process().any()
    engine.set_ir("a", room(25))
    assert error_db(run(engine, 10), convolve(noise(24, 10 * SIZE), room(25), 10 * SIZE)) < -120


@pytest.mark.parametrize("with_room", [False, True])
def test_an_emitter_removed_before_it_sounded_never_sounds(with_room):
    engine = renderer()
    add(engine, "a", noise(26, 300))
    if with_room:
        engine.set_ir("a", room(27))
    engine.remove_emitter("a")
    assert not run(engine, 3).any()


def test_no_more_emitters_than_allowed():
    engine = renderer(max_emitters=2)
    for name in ("a", "b"):
        add(engine, name, noise(28, 10))
    with pytest.raises(RendererFullError, match="at most 2"):
        add(engine, "c", noise(28, 10))
    assert emitter_ids(engine) == ("a", "b")
    engine.process()
    engine.remove_emitter("a")
    add(engine, "c", noise(28, 10))
    assert emitter_ids(engine) == ("b", "c")


def test_slots_come_back_when_removed_emitters_have_rung_out():
    engine = renderer(max_emitters=1)
    for name in ("a", "b"):
        add(engine, name, noise(29, 10))
        engine.set_ir(name, room(30))
        engine.process()
        engine.remove_emitter(name)
        engine.process()
    with pytest.raises(RendererFullError, match="ring out"):
        add(engine, "c", noise(29, 10))
    run(engine, RING_OUT_BLOCKS)
    for name in ("c", "d"):
        add(engine, name, noise(29, 10))
        engine.remove_emitter(name)


def test_coming_and_going_for_ever_leaks_nothing():
    engine = renderer(max_emitters=2)
    rng = np.random.default_rng(31)
    refused = 0
    for step in range(600):
        try:
            add(engine, str(step), noise(step, 100))
        except RendererFullError:
            refused += 1
        else:
            if rng.random() < 0.7:
                engine.set_ir(str(step), room(step))
        assert np.isfinite(engine.process()).all()
        if len(emitter_ids(engine)) == 2 or rng.random() < 0.5:
            for name in emitter_ids(engine)[:1]:
                engine.remove_emitter(name)
    assert 0 < refused < 600
    for name in emitter_ids(engine):
        engine.remove_emitter(name)
    run(engine, RING_OUT_BLOCKS + 1)
    assert not engine.process().any()
    for name in ("x", "y"):
        add(engine, name, noise(32, 100))


def test_names_that_are_taken_or_unknown():
    engine = renderer()
    add(engine, "a", noise(33, 10))
    with pytest.raises(DuplicateEmitterError, match="'a'"):
        add(engine, "a", noise(33, 10))
    for call in (engine.remove_emitter, engine.applied, lambda name: engine.set_gain(name, 1.0)):
        with pytest.raises(UnknownEmitterError, match="'b'"):
            call("b")
    with pytest.raises(UnknownEmitterError, match="'b'"):
        engine.set_ir("b", room(34))


def test_a_bad_room_is_refused_and_the_old_one_stays_in_effect():
    engine = renderer()
    add(engine, "a", noise(35, 100))
    engine.set_ir("a", room(36), token=1)
    engine.process()
    for bad in (
        np.full((2, 10), np.nan, np.float32),
        np.zeros((3, 10), np.float32),
        np.zeros((2, IR_SAMPLES + 1), np.float32),
    ):
        with pytest.raises(ValueError):
            engine.set_ir("a", bad, token=2)
    assert np.isfinite(engine.process()).all()
    assert (engine.applied("a"), engine.exchanged) == (1, False)


def test_reset_is_as_good_as_new():
    def play(engine):
        add(engine, "a", noise(38, 300))
        engine.set_ir("a", room(39), token=1)
        output = [engine.process()]
        add(engine, "b", noise(40, 200))
        engine.set_ir("b", room(41))
        output.append(run(engine, 3))
        engine.set_ir("a", room(42), token=2)
        engine.remove_emitter("b")
        output.append(run(engine, 2))
        return np.concatenate(output, axis=1)

    used = renderer()
    first = play(used)
    used.remove_emitter("a")
    used.reset()
    assert (used.sample_clock, emitter_ids(used), used.exchanged) == (0, (), False)
    np.testing.assert_array_equal(play(used), first)


def test_many_rendered_in_one_call_are_each_alone_to_the_bit():
    def play(together):
        engines = [renderer(max_emitters=2) for _ in range(4)]
        output = [[] for _ in engines]
        for block in range(30):
            for number, engine in enumerate(engines):
                if block == 2 * number:
                    add(engine, "a", noise(50 + number, 300))
                    engine.set_ir("a", room(60 + number))
                if block == 12 + number:
                    engine.set_ir("a", room(70 + number))
                if block == 20:
                    engine.set_gain("a", 0.5)
            due = [engine for number, engine in enumerate(engines) if (block + number) % 3]
            blocks = [each.samples for each in render_all(due)] if together else [engine.process() for engine in due]
            for engine, samples in zip(due, blocks, strict=True):
                output[engines.index(engine)].append(samples)
        return [np.concatenate(blocks, axis=1) for blocks in output]

    for together, alone in zip(play(True), play(False), strict=True):
        np.testing.assert_array_equal(together, alone)
    assert render_all([]) == []


def test_rendering_leaves_the_interpreter_to_others():
    """While one call renders, another thread runs Python: it counts on, as it could not if the call held the lock."""
    engine = renderer(max_emitters=4)
    for number in range(4):
        add(engine, str(number), noise(number, 500))
        engine.set_ir(str(number), room(number))
    run(engine, 2)
    # The same one, over and over: some hundred ms.
    rows = np.tile(np.array([engine._output.address, engine._mixer.address, 0, 1, 0, 0], np.int64), (20_000, 1))
    frames, flags = np.zeros(engine._output.sum.size, np.float32), np.zeros((1, 2), np.int64)
    counted = []

    def count():
        while not counted or counted[-1] >= 0:
            counted.append(len(counted))
            time.sleep(0.001)

    thread = threading.Thread(target=count)
    thread.start()
    before = len(counted)
    mix_listeners(rows, frames, flags, None, ANY_LIMITER)
    during = len(counted) - before
    counted.append(-1)
    thread.join()
    assert during >= 3


@pytest.mark.parametrize("loop", [True, False])
def test_an_emitter_that_began_before_fades_in_where_it_would_be(loop):
    """In a renderer that begins at a later clock, and only after some blocks, as a response takes its time."""
    clip, blocks, late, clock = noise(0, 900), 60, 4, 10 * SIZE
    whole, resumed = renderer(), renderer()
    resumed.skip_to(clock)
    assert resumed.sample_clock == clock
    for engine, since in ((whole, None), (resumed, SIZE)):
        engine.add_emitter("a", ClipPlayer(clip, loop=loop), since=since)
    run(whole, 1)
    whole.set_ir("a", room(1))
    expected = run(whole, blocks)[:, clock - SIZE :]
    assert not run(resumed, late).any()
    resumed.set_ir("a", room(1))
    heard = run(resumed, blocks - late - 9)
    played = np.resize(clip, blocks * SIZE) if loop else np.pad(clip, (0, blocks * SIZE))[: blocks * SIZE]
    played[: clock - SIZE + late * SIZE] = 0
    played[clock - SIZE + late * SIZE :][:SIZE] *= raised_cosine(SIZE)
    own = convolve(played, room(1), blocks * SIZE)[:, clock - SIZE + late * SIZE :]
    assert error_db(heard, own[:, : heard.shape[1]]) < -120
    rung_in = IR_SAMPLES + SIZE
    same = expected[:, late * SIZE + rung_in :][:, : heard.shape[1] - rung_in]
    assert np.abs(heard[:, rung_in:] - same).max() < 1e-5
