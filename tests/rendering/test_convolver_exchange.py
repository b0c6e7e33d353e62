"""Laws of the exchange of impulse responses while a convolver runs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.rendering.convolver import Convolver
from server.rendering.fade import raised_cosine
from server.rendering.partitions import TURNS, Partitioning
from tests.rendering.streams import BOTH_KINDS, SAMPLE_RATE, convolve, decaying_ir, stream
from tests.signals import error_db, noise

pytestmark = BOTH_KINDS


def expected_with_exchanges(dry, schedule, partitioning):
    """Oracle of exchanges: every stage convolves by itself, and crossfades windows of its output.

    `schedule[source]` lists (block, ir). Window w of a stage is full after its last block; the IR wanted then is the
    one its output is made with, but for later stages, where sources change on their turns, one window in TURNS.
    """
    blocks = dry.shape[1] // partitioning.block_size
    channels = len(schedule[0][0][1])
    expected = np.zeros((channels, dry.shape[1]))
    for source, changes in enumerate(schedule):
        for stage in partitioning.stages:
            whole = {}

            def heard(ir, stage=stage, source=source, whole=whole):
                if id(ir) not in whole:
                    part = np.zeros_like(ir)
                    part[:, stage.start : stage.end] = ir[:, stage.start : stage.end]
                    silent = np.zeros((channels, dry.shape[1]))
                    whole[id(ir)] = convolve(dry[source], part) if part.any() else silent
                return whole[id(ir)]

            current = None
            for window in range(blocks // stage.ticks):
                last_block = (window + 1) * stage.ticks - 1
                wanted = [ir for block, ir in changes if block <= last_block]
                if not wanted:
                    continue
                at = window * stage.size + stage.start if stage.start == 0 else (window + 2) * stage.size
                span = slice(at, at + stage.size)
                if expected[:, span].size == 0:
                    continue
                fade = raised_cosine(stage.size)[: expected[:, span].shape[1]]
                may_change = stage.start == 0 or (window + source) % TURNS == 0
                new = wanted[-1] if current is None or may_change else current
                old = new if current is None else current
                expected[:, span] += (1 - fade) * heard(old)[:, span] + fade * heard(new)[:, span]
                current = new
    return expected


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    changes=st.lists(st.tuples(st.integers(0, 90), st.integers(0, 1)), max_size=12),
    channels=st.sampled_from((2, 4, 9, 16)),
)
def test_any_sequence_of_exchanges_is_a_sequence_of_crossfades(any_size, seed, changes, channels):
    size, blocks, ir_samples = 64, 96, 2_900
    dry = noise(seed, 2, blocks * size)
    irs = [decaying_ir(seed + index, ir_samples, channels) for index in range(len(changes) + 2)]
    schedule = [[(0, irs[0])], [(0, irs[1])]]
    for index, (block, source) in enumerate(sorted(changes, key=lambda change: change[0])):
        schedule[source].append((block, irs[index + 2]))
    convolver = Convolver(sources=2, channels=channels, block_size=size, ir_samples=ir_samples, any_size=any_size)
    # Before its first block a source takes an IR at once: several at block 0 are no exchange.
    flat = [(block, source, ir) for source, entries in enumerate(schedule) for block, ir in entries]
    wet = stream(convolver, dry, flat)
    assert error_db(wet, expected_with_exchanges(dry, schedule, Partitioning(size, ir_samples))) < -115


def test_newest_ir_wins_and_flags_tell_which_block_exchanged(any_size):
    convolver = Convolver(sources=2, channels=2, block_size=64, ir_samples=100, any_size=any_size)
    dry = noise(13, 2, 64)
    for source in (0, 1):
        convolver.set_ir(source, decaying_ir(14, 100))
    convolver.process(dry)
    assert convolver.exchanged == ()  # a first IR is not faded to

    convolver.set_ir(1, decaying_ir(15, 100))
    convolver.set_ir(1, np.zeros((2, 1), np.float32))
    convolver.process(dry)
    assert convolver.exchanged == (1,)

    only_second = dry * np.array([[0], [1]], np.float32)
    for _ in range(3):
        wet = convolver.process(only_second)
        assert convolver.exchanged == ()
    np.testing.assert_array_equal(wet, 0)


def splatter_db(wet, above_hz, sample_rate):
    power = np.abs(np.fft.rfft(wet * np.kaiser(wet.size, 20))) ** 2
    high = np.fft.rfftfreq(wet.size, 1 / sample_rate) > above_hz
    return 10 * np.log10(power[high].sum() / power.sum())


@pytest.mark.parametrize("block_size", [128, 256, 512])
@pytest.mark.parametrize(("blocks_between", "channels"), [(1, 1), (5, 1), (1, 4)])
def test_exchange_does_not_splatter(any_size, block_size, blocks_between, channels):
    """Energy above 4 kHz of a 997 Hz tone, while every exchange is to an entirely unrelated room: the worst case."""
    ir_samples = 12_000
    blocks = 2 * SAMPLE_RATE // block_size
    tone = np.sin(2 * np.pi * 997 * np.arange(blocks * block_size) / SAMPLE_RATE).astype(np.float32)[np.newaxis]
    convolver = Convolver(sources=1, channels=channels, block_size=block_size, ir_samples=ir_samples, any_size=any_size)
    rooms = [decaying_ir(seed, ir_samples, channels) for seed in range(20)]
    changes = [(block, 0, rooms[block % 20]) for block in range(0, blocks, blocks_between)]
    wet = stream(convolver, tone, changes)[:, ir_samples + block_size :].astype(float)
    assert max(splatter_db(channel, 4_000, SAMPLE_RATE) for channel in wet) < -95


def test_exchanges_at_90_hz_of_second_long_rooms_do_not_splatter(any_size):
    sample_rate, ir_samples, size = 48_000, 48_000, 256
    blocks = 3 * sample_rate // size
    tone = np.sin(2 * np.pi * 997 * np.arange(blocks * size) / sample_rate).astype(np.float32)[np.newaxis]
    convolver = Convolver(sources=1, channels=1, block_size=size, ir_samples=ir_samples, any_size=any_size)
    rooms = [convolver.prepare(decaying_ir(seed, ir_samples, 1)) for seed in range(12)]
    changes = [(int(number / 90 * sample_rate / size), 0, rooms[number % 12]) for number in range(3 * 90)]
    wet = stream(convolver, tone, changes)[0, ir_samples + size :].astype(float)
    assert splatter_db(wet, 4_000, sample_rate) < -95


@pytest.mark.parametrize("fresh_copies", [True, False])
def test_exchange_to_an_equal_ir_is_inaudible(any_size, fresh_copies):
    dry = noise(16, 1, 120 * 64)
    ir = decaying_ir(17, 3_000)
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=3_000, any_size=any_size)
    prepared = convolver.prepare(ir)
    wet = stream(convolver, dry, [(b, 0, convolver.prepare(ir) if fresh_copies else prepared) for b in range(120)])
    assert error_db(wet, convolve(dry[0], ir)) < -120


def test_an_exchange_of_some_partitions_leaves_the_others_bit_for_bit(any_size):
    """An IR that changes only in its head: what later stages say must not change at all."""
    dry = np.zeros((1, 80 * 64), np.float32)
    dry[:, : 10 * 64] = noise(38, 1, 10 * 64)
    before = decaying_ir(39, 2_900)
    after = before.copy()
    after[:, :64] = decaying_ir(40, 64)

    def wet(changes):
        convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=2_900, any_size=any_size)
        return stream(convolver, dry, changes)

    with_exchange, without = wet([(0, 0, before), (20, 0, after)]), wet([(0, 0, before)])
    assert error_db(with_exchange[:, 20 * 64 :], without[:, 20 * 64 :]) < -120


@settings(max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), change=st.integers(1, 80))
def test_energy_of_an_exchange_is_bounded(any_size, seed, change):
    """A crossfade is a convex mix at every instant: never above the larger of the two, stage by stage."""
    size, samples = 64, 500  # one stage: the bound holds sample by sample
    dry = noise(seed, 1, 90 * size)
    old, new = decaying_ir(seed, samples), decaying_ir(seed + 1, samples)
    convolver = Convolver(sources=1, channels=2, block_size=size, ir_samples=samples, any_size=any_size)
    wet = stream(convolver, dry, [(0, 0, old), (change, 0, new)])
    bound = np.maximum(np.abs(convolve(dry[0], old)), np.abs(convolve(dry[0], new)))
    assert np.all(np.abs(wet) <= bound + 1e-4)
