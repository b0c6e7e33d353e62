"""Laws of streaming convolution, against SciPy's one-shot FFT convolution in float64.

Each holds for the compiled convolver and for the one in NumPy.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import fftconvolve

from server.compiled import HAS_NUMBA
from server.rendering.convolver import Convolver
from server.rendering.fade import raised_cosine
from server.rendering.partitions import Partitioning

SAMPLE_RATE = 24_000

pytestmark = pytest.mark.parametrize(
    "is_compiled", [pytest.param(True, id="compiled"), pytest.param(False, id="numpy")]
)
BLOCK_SIZES = (64, 128, 256)


@pytest.fixture(autouse=True)
def _numba_is_there(is_compiled):
    assert HAS_NUMBA or not is_compiled, "the tests measure the compiled convolver: install numba"


def noise(seed, *shape):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def decaying_ir(seed, samples, channels=2, t60_s=0.4):
    decay = 10 ** (-3 * np.arange(samples) / (t60_s * SAMPLE_RATE))
    return (noise(seed, channels, samples) * decay).astype(np.float32)


def convolve(dry, ir):
    """Oracle: (n,) with (c, m) to the first n samples, float64."""
    return fftconvolve(dry[np.newaxis].astype(float), ir.astype(float), axes=1)[:, : dry.size]


def stream(convolver, dry, changes=()):
    """Feed (s, n) block by block; `changes` are (block, source, ir), made before that block."""
    size = convolver.block_size
    blocks = []
    for index in range(dry.shape[1] // size):
        for block, source, ir in changes:
            if block == index:
                convolver.set_ir(source, ir)
        blocks.append(convolver.process(dry[:, index * size : (index + 1) * size]))
    return np.concatenate(blocks, axis=1)


def error_db(actual, expected):
    """Largest error, relative to the largest sample."""
    return 20 * np.log10(np.abs(actual - expected).max() / np.abs(expected).max() + 1e-30)


@pytest.mark.parametrize("block_size", [64, 128, 256, 512, 1024])
@pytest.mark.parametrize("ir_samples", [1, 200, 256, 257, 4_001, 24_000])
def test_streaming_equals_convolution(is_compiled, block_size, ir_samples):
    dry = noise(1, 1, 20 * block_size + 2 * ir_samples // block_size * block_size)
    ir = decaying_ir(2, ir_samples)
    convolver = Convolver(sources=1, channels=2, block_size=block_size, ir_samples=ir_samples, is_compiled=is_compiled)
    convolver.set_ir(0, ir)
    assert error_db(stream(convolver, dry), convolve(dry[0], ir)) < -120


@pytest.mark.parametrize("sources", [1, 4, 16, 64])
def test_a_second_of_response_stays_exact_however_many_sources(is_compiled, sources):
    ir_samples = 48_000
    dry = noise(3, sources, 220 * 256)
    irs = [decaying_ir(seed, ir_samples) for seed in range(sources)]
    convolver = Convolver(sources=sources, channels=2, block_size=256, ir_samples=ir_samples, is_compiled=is_compiled)
    for source, ir in enumerate(irs):
        convolver.set_ir(source, ir)
    expected = sum(convolve(dry[source], ir) for source, ir in enumerate(irs))
    assert error_db(stream(convolver, dry), expected) < -120


@settings(deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    sources=st.integers(1, 4),
    channels=st.integers(1, 2),
    block_size=st.sampled_from(BLOCK_SIZES),
    ir_samples=st.integers(1, 6_000),
    blocks=st.integers(1, 80),
)
def test_any_layout_equals_convolution(is_compiled, seed, sources, channels, block_size, ir_samples, blocks):
    rng = np.random.default_rng(seed)
    dry = noise(seed, sources, blocks * block_size)
    irs = [decaying_ir(seed + source, rng.integers(1, ir_samples + 1), channels) for source in range(sources)]
    convolver = Convolver(
        sources=sources, channels=channels, block_size=block_size, ir_samples=ir_samples, is_compiled=is_compiled
    )
    for source, ir in enumerate(irs):
        convolver.set_ir(source, ir)
    expected = sum(convolve(dry[source], ir) for source, ir in enumerate(irs))
    assert error_db(stream(convolver, dry), expected) < -120


def test_an_impulse_in_every_partition_comes_out_where_it_is(is_compiled):
    """One IR sample at a time, in each partition's first, middle and last sample, against an impulse fed in."""
    size, ir_samples = 64, 3_000
    convolver = Convolver(sources=1, channels=1, block_size=size, ir_samples=ir_samples, is_compiled=is_compiled)
    dry = np.zeros((1, 55 * size), np.float32)
    dry[0, 37] = 1
    for stage in Partitioning(size, ir_samples).stages:
        for partition in range(stage.partitions):
            for offset in (0, stage.size // 2 + 1, stage.size - 1):
                at = stage.start + partition * stage.size + offset
                if at >= ir_samples:
                    continue
                ir = np.zeros((1, ir_samples), np.float32)
                ir[0, at] = 1
                convolver.reset()
                convolver.set_ir(0, ir)
                expected = np.zeros_like(dry)
                expected[0, 37 + at] = 1
                np.testing.assert_allclose(stream(convolver, dry), expected, atol=2e-6)


def test_a_unit_impulse_passes_at_once_and_unchanged(is_compiled):
    convolver = Convolver(sources=1, channels=1, block_size=64, ir_samples=1_000, is_compiled=is_compiled)
    convolver.set_ir(0, np.ones((1, 1), np.float32))
    dry = noise(6, 1, 64)
    np.testing.assert_allclose(convolver.process(dry), dry, atol=2e-6)


@settings(deadline=None)
@given(a=st.floats(-4, 4), b=st.floats(-4, 4), seed=st.integers(0, 2**32 - 1))
def test_linear(is_compiled, a, b, seed):
    x, y = noise(seed, 2, 1, 30 * 64)
    ir = decaying_ir(seed, 1_000)

    def wet(dry):
        convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=1_000, is_compiled=is_compiled)
        convolver.set_ir(0, ir)
        return stream(convolver, dry.astype(np.float32))

    np.testing.assert_allclose(wet(a * x + b * y), a * wet(x) + b * wet(y), atol=2e-4)


@pytest.mark.parametrize("late_blocks", [1, 3, 17, 40])
def test_time_invariant(is_compiled, late_blocks):
    """Whatever the phase of the stages; to the last bit where it is the same."""
    dry = noise(7, 1, 60 * 256)
    ir = decaying_ir(8, 13_000)

    def wet(x):
        convolver = Convolver(sources=1, channels=2, block_size=256, ir_samples=13_000, is_compiled=is_compiled)
        convolver.set_ir(0, ir)
        return stream(convolver, x)

    late = np.concatenate([np.zeros((1, late_blocks * 256), np.float32), dry], axis=1)
    assert error_db(wet(late)[:, late_blocks * 256 :], wet(dry)) < -120
    very_late = np.concatenate([np.zeros((1, 64 * 256), np.float32), dry], axis=1)
    np.testing.assert_array_equal(wet(very_late)[:, 64 * 256 :], wet(dry))


def expected_with_exchanges(dry, schedule, partitioning):
    """Oracle of exchanges: every stage convolves by itself, and crossfades windows of its output.

    `schedule[source]` lists (block, ir). Window w of a stage is full after its last block; the IR wanted then is the
    one its output is made with, but for later stages, where even and odd sources take turns to change.
    """
    blocks = dry.shape[1] // partitioning.block_size
    expected = np.zeros((2, dry.shape[1]))
    for source, changes in enumerate(schedule):
        for stage in partitioning.stages:

            def heard(ir, stage=stage, source=source):
                part = np.zeros_like(ir)
                part[:, stage.start : stage.end] = ir[:, stage.start : stage.end]
                return convolve(dry[source], part) if part.any() else np.zeros((2, dry.shape[1]))

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
                may_change = stage.start == 0 or (window + source) % 2 == 0
                new = wanted[-1] if current is None or may_change else current
                old = new if current is None else current
                expected[:, span] += (1 - fade) * heard(old)[:, span] + fade * heard(new)[:, span]
                current = new
    return expected


@settings(deadline=None, max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    changes=st.lists(st.tuples(st.integers(0, 90), st.integers(0, 1)), max_size=12),
)
def test_any_sequence_of_exchanges_is_a_sequence_of_crossfades(is_compiled, seed, changes):
    size, blocks, ir_samples = 64, 96, 2_900
    dry = noise(seed, 2, blocks * size)
    irs = [decaying_ir(seed + index, ir_samples) for index in range(len(changes) + 2)]
    schedule = [[(0, irs[0])], [(0, irs[1])]]
    for index, (block, source) in enumerate(sorted(changes, key=lambda change: change[0])):
        schedule[source].append((block, irs[index + 2]))
    convolver = Convolver(sources=2, channels=2, block_size=size, ir_samples=ir_samples, is_compiled=is_compiled)
    # Before its first block a source takes an IR at once: several at block 0 are no exchange.
    flat = [(block, source, ir) for source, entries in enumerate(schedule) for block, ir in entries]
    wet = stream(convolver, dry, flat)
    assert error_db(wet, expected_with_exchanges(dry, schedule, Partitioning(size, ir_samples))) < -115


def test_newest_ir_wins_and_flags_tell_which_block_exchanged(is_compiled):
    convolver = Convolver(sources=2, channels=2, block_size=64, ir_samples=100, is_compiled=is_compiled)
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
@pytest.mark.parametrize("blocks_between", [1, 5])
def test_exchange_does_not_splatter(is_compiled, block_size, blocks_between):
    """Energy above 4 kHz of a 997 Hz tone, while every exchange is to an entirely unrelated room: the worst case."""
    ir_samples = 12_000
    blocks = 2 * SAMPLE_RATE // block_size
    tone = np.sin(2 * np.pi * 997 * np.arange(blocks * block_size) / SAMPLE_RATE).astype(np.float32)[np.newaxis]
    convolver = Convolver(sources=1, channels=1, block_size=block_size, ir_samples=ir_samples, is_compiled=is_compiled)
    rooms = [decaying_ir(seed, ir_samples, 1) for seed in range(20)]
    changes = [(block, 0, rooms[block % 20]) for block in range(0, blocks, blocks_between)]
    wet = stream(convolver, tone, changes)[0, ir_samples + block_size :].astype(float)
    assert splatter_db(wet, 4_000, SAMPLE_RATE) < -95


def test_exchanges_at_90_hz_of_second_long_rooms_do_not_splatter(is_compiled):
    sample_rate, ir_samples, size = 48_000, 48_000, 256
    blocks = 3 * sample_rate // size
    tone = np.sin(2 * np.pi * 997 * np.arange(blocks * size) / sample_rate).astype(np.float32)[np.newaxis]
    convolver = Convolver(sources=1, channels=1, block_size=size, ir_samples=ir_samples, is_compiled=is_compiled)
    rooms = [convolver.prepare(decaying_ir(seed, ir_samples, 1)) for seed in range(12)]
    changes = [(int(number / 90 * sample_rate / size), 0, rooms[number % 12]) for number in range(3 * 90)]
    wet = stream(convolver, tone, changes)[0, ir_samples + size :].astype(float)
    assert splatter_db(wet, 4_000, sample_rate) < -95


@pytest.mark.parametrize("fresh_copies", [True, False])
def test_exchange_to_an_equal_ir_is_inaudible(is_compiled, fresh_copies):
    dry = noise(16, 1, 120 * 64)
    ir = decaying_ir(17, 3_000)
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=3_000, is_compiled=is_compiled)
    prepared = convolver.prepare(ir)
    wet = stream(convolver, dry, [(b, 0, convolver.prepare(ir) if fresh_copies else prepared) for b in range(120)])
    assert error_db(wet, convolve(dry[0], ir)) < -120


def test_an_exchange_of_some_partitions_leaves_the_others_bit_for_bit(is_compiled):
    """An IR that changes only in its head: what later stages say must not change at all."""
    dry = np.zeros((1, 80 * 64), np.float32)
    dry[:, : 10 * 64] = noise(38, 1, 10 * 64)
    before = decaying_ir(39, 2_900)
    after = before.copy()
    after[:, :64] = decaying_ir(40, 64)

    def wet(changes):
        convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=2_900, is_compiled=is_compiled)
        return stream(convolver, dry, changes)

    with_exchange, without = wet([(0, 0, before), (20, 0, after)]), wet([(0, 0, before)])
    assert error_db(with_exchange[:, 20 * 64 :], without[:, 20 * 64 :]) < -120


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 2**32 - 1), change=st.integers(1, 80))
def test_energy_of_an_exchange_is_bounded(is_compiled, seed, change):
    """A crossfade is a convex mix at every instant: never above the larger of the two, stage by stage."""
    size, samples = 64, 500  # one stage: the bound holds sample by sample
    dry = noise(seed, 1, 90 * size)
    old, new = decaying_ir(seed, samples), decaying_ir(seed + 1, samples)
    convolver = Convolver(sources=1, channels=2, block_size=size, ir_samples=samples, is_compiled=is_compiled)
    wet = stream(convolver, dry, [(0, 0, old), (change, 0, new)])
    bound = np.maximum(np.abs(convolve(dry[0], old)), np.abs(convolve(dry[0], new)))
    assert np.all(np.abs(wet) <= bound + 1e-4)


def test_others_are_bit_equal_after_a_source_has_come_and_gone(is_compiled):
    size, blocks, samples = 64, 240, 3_000
    dry = noise(18, 3, blocks * size)
    dry[1, 40 * size :] = 0
    irs = [decaying_ir(seed, samples) for seed in (19, 20, 21)]
    gone_at = 40 + Partitioning(size, samples).quiet_blocks

    def wet(guest):
        convolver = Convolver(sources=3, channels=2, block_size=size, ir_samples=samples, is_compiled=is_compiled)
        convolver.set_ir(0, irs[0])
        convolver.set_ir(2, irs[2])
        output = []
        for index in range(blocks):
            block = dry[:, index * size : (index + 1) * size].copy()
            if guest and index == 10:
                convolver.set_ir(1, irs[1])
            if guest and index == 20:
                convolver.set_ir(1, irs[0])
            if guest and index == gone_at:
                assert convolver.is_quiet(1)
                convolver.clear(1)
            output.append(convolver.process(block))
        return np.concatenate(output, axis=1)

    with_guest, without = wet(True), wet(False)
    np.testing.assert_array_equal(with_guest[:, : 10 * size], without[:, : 10 * size])
    np.testing.assert_array_equal(with_guest[:, gone_at * size :], without[:, gone_at * size :])
    assert not np.array_equal(with_guest[:, 10 * size : 30 * size], without[:, 10 * size : 30 * size])


@pytest.mark.parametrize("pause", [1, 2, 5, 14, 15, 16, 17, 31, 33, 48, 63, 64, 79, 80, 81, 96, 111, 130])
def test_a_source_that_rang_out_and_sounds_again_remembers_nothing(is_compiled, pause):
    """Guards the shortcut for silence: no stale spectrum may be heard when the source is fed again, however late."""
    size, samples = 64, 3_000
    ir = decaying_ir(22, samples)
    dry = noise(23, 1, 250 * size)
    dry[:, 20 * size : (20 + pause) * size] = 0
    convolver = Convolver(sources=1, channels=2, block_size=size, ir_samples=samples, is_compiled=is_compiled)
    convolver.set_ir(0, ir)
    assert error_db(stream(convolver, dry), convolve(dry[0], ir)) < -120


def test_quiet_means_exactly_nothing_more(is_compiled):
    size, samples = 64, 3_000
    convolver = Convolver(sources=1, channels=2, block_size=size, ir_samples=samples, is_compiled=is_compiled)
    assert convolver.is_quiet(0)
    convolver.set_ir(0, decaying_ir(24, samples))
    convolver.process(noise(25, 1, size))
    assert not convolver.is_quiet(0)
    silence = np.zeros((1, size), np.float32)
    for _ in range(200):
        wet = convolver.process(silence)
        if convolver.is_quiet(0):
            break
    else:
        pytest.fail("never rang out")
    assert not wet.any()
    convolver.set_ir(0, decaying_ir(26, samples))
    for _ in range(40):
        assert not convolver.process(silence).any()


@pytest.mark.parametrize("joins_at", [1, 12, 16, 21, 47])
def test_a_source_starts_from_silence_with_its_first_ir(is_compiled, joins_at):
    """What was fed before the first IR is not heard, and joining late is the same as being new."""
    dry = noise(27, 1, 120 * 64)
    ir = decaying_ir(28, 2_900)
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=2_900, is_compiled=is_compiled)
    wet = stream(convolver, dry, [(joins_at, 0, ir)])
    assert not wet[:, : joins_at * 64].any()
    assert error_db(wet[:, joins_at * 64 :], convolve(dry[0, joins_at * 64 :], ir)) < -120


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_sources_join_and_leave_without_touching_the_others(is_compiled, seed):
    """Random comings and goings in three slots; each stay is a convolution of its own."""
    size, samples, blocks = 64, 1_500, 260
    rng = np.random.default_rng(seed)
    quiet = Partitioning(size, samples).quiet_blocks
    convolver = Convolver(sources=3, channels=2, block_size=size, ir_samples=samples, is_compiled=is_compiled)
    dry = np.zeros((3, blocks * size), np.float32)
    expected = np.zeros((2, blocks * size))
    joins, leaves = {}, {}
    for source in range(3):
        at = int(rng.integers(0, 30))
        while at < blocks:
            length = int(rng.integers(1, 40))
            stay = noise(int(rng.integers(2**31)), 1, length * size)[:, : (blocks - at) * size]
            dry[source, at * size : at * size + stay.shape[1]] = stay
            ir = decaying_ir(int(rng.integers(2**31)), int(rng.integers(1, samples + 1)))
            joins.setdefault(at, []).append((source, ir))
            leaves.setdefault(at + length + quiet, []).append(source)
            alone = np.zeros(blocks * size, np.float32)
            alone[at * size : at * size + stay.shape[1]] = stay
            expected += convolve(alone, ir)
            at += length + quiet + int(rng.integers(0, 20))
    wet = []
    for block in range(blocks):
        for source in leaves.get(block, ()):
            convolver.clear(source)
        for source, ir in joins.get(block, ()):
            convolver.set_ir(source, ir)
        wet.append(convolver.process(dry[:, block * size : (block + 1) * size]))
    assert error_db(np.concatenate(wet, axis=1), expected) < -120


@pytest.mark.parametrize("cleared_at", range(32, 48))
def test_a_source_cleared_while_it_fades_touches_no_other(is_compiled, cleared_at):
    """At every block of a window of the last stage in which its IR is being exchanged, and with it what that costs."""
    size, samples = 64, 12_000
    dry = noise(70, 2, 320 * size)
    irs = [decaying_ir(seed, samples) for seed in (71, 72, 73)]
    convolver = Convolver(sources=2, channels=2, block_size=size, ir_samples=samples, is_compiled=is_compiled)
    convolver.set_ir(0, irs[0])
    convolver.set_ir(1, irs[1])
    wet = []
    for block in range(320):
        if block == 20:
            convolver.set_ir(0, irs[2])
            convolver.set_ir(1, irs[2])
        if block == cleared_at:
            convolver.clear(1)
        wet.append(convolver.process(dry[:, block * size : (block + 1) * size]))
    gone = (cleared_at + 48) * size  # what the source had in work by then has come out
    expected = convolve(dry[0], irs[2])
    assert error_db(np.concatenate(wet, axis=1)[:, gone:], expected[:, gone:]) < -115


def test_reset_is_as_good_as_new(is_compiled):
    dry = noise(29, 2, 70 * 64)
    ir = decaying_ir(30, 2_900)
    used = Convolver(sources=2, channels=2, block_size=64, ir_samples=2_900, is_compiled=is_compiled)
    stream(used, dry, [(0, 0, ir), (3, 1, ir), (19, 1, decaying_ir(41, 2_900)), (60, 1, ir)])
    used.set_ir(0, ir)
    used.reset()
    fresh = Convolver(sources=2, channels=2, block_size=64, ir_samples=2_900, is_compiled=is_compiled)
    changes = [(0, 1, decaying_ir(31, 400)), (5, 1, ir), (7, 0, ir)]
    np.testing.assert_array_equal(stream(used, dry, changes), stream(fresh, dry, changes))


def test_a_shared_tail_is_each_sources_own_at_its_level(is_compiled):
    """Rooms that share their late part but for a gain: the shared tail is then exact, at a tail's cost for one."""
    size, samples = 64, 3_000
    tail_start = Partitioning(size, samples).stages[-1].start
    late = decaying_ir(42, samples)
    late[:, :tail_start] = 0
    gains = (0.5, 1.0, 2.0)
    irs = []
    for number, gain in enumerate(gains):
        ir = decaying_ir(43 + number, samples)
        ir[:, tail_start:] = 0
        irs.append(ir + np.float32(gain) * late)
    dry = noise(46, 3, 120 * size)
    convolver = Convolver(
        sources=3, channels=2, block_size=size, ir_samples=samples, shared_tail=True, is_compiled=is_compiled
    )
    for source, ir in enumerate(irs):
        convolver.set_ir(source, ir)
    expected = sum(convolve(dry[source], ir) for source, ir in enumerate(irs))
    assert error_db(stream(convolver, dry), expected) < -115


def test_a_shared_tail_of_unlike_rooms_keeps_each_level(is_compiled):
    """Two unrelated tails, one source at a time: what is heard late has the energy of its own tail."""
    size, samples = 64, 6_000
    tail_start = Partitioning(size, samples).stages[-1].start
    irs = [decaying_ir(50, samples), 0.25 * decaying_ir(51, samples)]
    for sounding in (0, 1):
        dry = np.zeros((2, 160 * size), np.float32)
        dry[sounding, 0] = 1
        convolver = Convolver(
            sources=2, channels=2, block_size=size, ir_samples=samples, shared_tail=True, is_compiled=is_compiled
        )
        for source, ir in enumerate(irs):
            convolver.set_ir(source, ir)
        wet = stream(convolver, dry)
        heard = np.sum(wet[:, tail_start:samples].astype(float) ** 2)
        own = np.sum(irs[sounding][:, tail_start:].astype(float) ** 2)
        assert 10 * np.log10(heard / own) == pytest.approx(0, abs=0.05)


def test_both_kinds_are_equal_through_everything(is_compiled):
    """The same calls, random, to both: exchanges, comings, goings, silence and a shared tail."""
    size, samples, sources = 64, 2_900, 4
    for shared_tail in (False, True):
        rng = np.random.default_rng(60)
        pair = [
            Convolver(
                sources=sources,
                channels=2,
                block_size=size,
                ir_samples=samples,
                shared_tail=shared_tail,
                is_compiled=kind,
            )
            for kind in (is_compiled, False)
        ]
        outputs = [[], []]
        for block in range(300):
            dry = noise(block, sources, size) * (rng.random((sources, 1)) < 0.7)
            for source in range(sources):
                if rng.random() < 0.1:
                    ir = decaying_ir(int(rng.integers(2**31)), int(rng.integers(1, samples + 1)))
                    for convolver in pair:
                        convolver.set_ir(source, ir)
            for convolver, output in zip(pair, outputs, strict=True):
                output.append(convolver.process(dry.astype(np.float32)))
            assert pair[0].exchanged == pair[1].exchanged
        assert error_db(np.concatenate(outputs[0], axis=1), np.concatenate(outputs[1], axis=1)) < -120


def test_blocks_handed_out_belong_to_the_caller(is_compiled):
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=500, is_compiled=is_compiled)
    convolver.set_ir(0, decaying_ir(32, 500))
    first = convolver.process(noise(33, 1, 64))
    copy = first.copy()
    mine = np.empty((2, 64), np.float32)
    assert convolver.process(noise(34, 1, 64), mine) is mine
    np.testing.assert_array_equal(first, copy)
    assert first.dtype == np.float32
    assert first.flags.c_contiguous


def test_blocks_and_room_for_the_mix_may_lie_in_memory_as_they_like(is_compiled):
    ir = decaying_ir(47, 500)
    dry = noise(48, 2, 64)

    def wet(blocks, out=None):
        convolver = Convolver(sources=2, channels=2, block_size=64, ir_samples=500, is_compiled=is_compiled)
        for source in range(2):
            convolver.set_ir(source, ir)
        return convolver.process(blocks, out)

    expected = wet(dry)
    np.testing.assert_array_equal(wet(np.asfortranarray(dry)), expected)
    np.testing.assert_array_equal(wet(np.repeat(dry, 2, axis=1)[:, ::2]), expected)
    np.testing.assert_array_equal(wet(dry, np.empty((64, 2), np.float32).T), expected)
    for wrong in (dry[:1], dry[:, :32]):
        with pytest.raises(ValueError):
            wet(wrong)


@pytest.mark.parametrize("shape", [(2,), (1, 100), (3, 100), (2, 0), (2, 101), (1, 2, 100)])
def test_an_ir_of_another_shape_is_refused(is_compiled, shape):
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=100, is_compiled=is_compiled)
    with pytest.raises(ValueError, match="shape"):
        convolver.set_ir(0, np.zeros(shape, np.float32))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_an_ir_that_is_not_finite_is_refused_and_the_old_one_stays(is_compiled, bad):
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=100, is_compiled=is_compiled)
    convolver.set_ir(0, decaying_ir(35, 100))
    ir = decaying_ir(36, 100)
    ir[1, 50] = bad
    with pytest.raises(ValueError, match="finite"):
        convolver.set_ir(0, ir)
    assert np.isfinite(convolver.process(noise(37, 1, 64))).all()
    assert convolver.exchanged == ()


@pytest.mark.parametrize(("samples", "channels", "block_size"), [(100, 2, 128), (100, 1, 64), (101, 2, 64)])
def test_an_ir_prepared_for_another_convolver_is_refused(is_compiled, samples, channels, block_size):
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=100, is_compiled=is_compiled)
    other = Convolver(sources=1, channels=channels, block_size=block_size, ir_samples=samples, is_compiled=is_compiled)
    with pytest.raises(ValueError, match="another convolver"):
        convolver.set_ir(0, other.prepare(np.zeros((channels, samples), np.float32)))


@pytest.mark.parametrize(
    "wrong",
    [{"sources": 0}, {"channels": 0}, {"channels": 3}, {"block_size": 0}, {"block_size": 96}, {"ir_samples": 0}],
)
def test_impossible_sizes_are_refused(is_compiled, wrong):
    sizes = {"sources": 1, "channels": 1, "block_size": 64, "ir_samples": 1}
    with pytest.raises(ValueError):
        Convolver(**(sizes | wrong), is_compiled=is_compiled)
