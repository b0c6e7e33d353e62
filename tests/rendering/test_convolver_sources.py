"""Laws of a convolver's sources: they come and go, ring out, and share a tail, each as if it were alone."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from server.rendering.convolver import Convolver
from server.rendering.partitions import TURNS, Partitioning
from tests.rendering.streams import BOTH_KINDS, convolve, decaying_ir, stream
from tests.signals import error_db, noise

pytestmark = BOTH_KINDS


def test_others_are_bit_equal_after_a_source_has_come_and_gone(any_size):
    size, blocks, samples = 64, 240, 3_000
    dry = noise(18, 3, blocks * size)
    dry[1, 40 * size :] = 0
    irs = [decaying_ir(seed, samples) for seed in (19, 20, 21)]
    gone_at = 40 + Partitioning(size, samples).quiet_blocks

    def wet(guest):
        convolver = Convolver(sources=3, channels=2, block_size=size, ir_samples=samples, any_size=any_size)
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
def test_a_source_that_rang_out_and_sounds_again_remembers_nothing(any_size, pause):
    """Guards the shortcut for silence: no stale spectrum may be heard when the source is fed again, however late."""
    size, samples = 64, 3_000
    ir = decaying_ir(22, samples)
    dry = noise(23, 1, 250 * size)
    dry[:, 20 * size : (20 + pause) * size] = 0
    convolver = Convolver(sources=1, channels=2, block_size=size, ir_samples=samples, any_size=any_size)
    convolver.set_ir(0, ir)
    assert error_db(stream(convolver, dry), convolve(dry[0], ir)) < -120


def test_quiet_means_exactly_nothing_more(any_size):
    size, samples = 64, 3_000
    convolver = Convolver(sources=1, channels=2, block_size=size, ir_samples=samples, any_size=any_size)
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
def test_a_source_starts_from_silence_with_its_first_ir(any_size, joins_at):
    """What was fed before the first IR is not heard, and joining late is the same as being new."""
    dry = noise(27, 1, 120 * 64)
    ir = decaying_ir(28, 2_900)
    convolver = Convolver(sources=1, channels=2, block_size=64, ir_samples=2_900, any_size=any_size)
    wet = stream(convolver, dry, [(joins_at, 0, ir)])
    assert not wet[:, : joins_at * 64].any()
    assert error_db(wet[:, joins_at * 64 :], convolve(dry[0, joins_at * 64 :], ir)) < -120


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1))
def test_sources_join_and_leave_without_touching_the_others(any_size, seed):
    """Random comings and goings in three slots; each stay is a convolution of its own."""
    size, samples, blocks = 64, 1_500, 260
    rng = np.random.default_rng(seed)
    quiet = Partitioning(size, samples).quiet_blocks
    convolver = Convolver(sources=3, channels=2, block_size=size, ir_samples=samples, any_size=any_size)
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


@pytest.mark.parametrize("cleared_at", range(64, 80))
def test_a_source_cleared_while_it_fades_touches_no_other(any_size, cleared_at):
    """At every block of a window of the last stage in which its IR is being exchanged, and with it what that costs."""
    size, samples = 64, 12_000
    dry = noise(70, 2, 320 * size)
    irs = [decaying_ir(seed, samples) for seed in (71, 72, 73)]
    convolver = Convolver(sources=2, channels=2, block_size=size, ir_samples=samples, any_size=any_size)
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
    # What the source had in work by then, and was multiplied in advance for, has come out.
    gone = (cleared_at + 16 * (TURNS + 2)) * size
    expected = convolve(dry[0], irs[2])
    assert error_db(np.concatenate(wet, axis=1)[:, gone:], expected[:, gone:]) < -115


def test_reset_is_as_good_as_new(any_size):
    dry = noise(29, 2, 70 * 64)
    ir = decaying_ir(30, 2_900)
    used = Convolver(sources=2, channels=2, block_size=64, ir_samples=2_900, any_size=any_size)
    stream(used, dry, [(0, 0, ir), (3, 1, ir), (19, 1, decaying_ir(41, 2_900)), (60, 1, ir)])
    used.set_ir(0, ir)
    used.reset()
    fresh = Convolver(sources=2, channels=2, block_size=64, ir_samples=2_900, any_size=any_size)
    changes = [(0, 1, decaying_ir(31, 400)), (5, 1, ir), (7, 0, ir)]
    np.testing.assert_array_equal(stream(used, dry, changes), stream(fresh, dry, changes))


def test_a_shared_tail_is_each_sources_own_at_its_level(any_size):
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
        sources=3, channels=2, block_size=size, ir_samples=samples, shared_tail=True, any_size=any_size
    )
    for source, ir in enumerate(irs):
        convolver.set_ir(source, ir)
    expected = sum(convolve(dry[source], ir) for source, ir in enumerate(irs))
    assert error_db(stream(convolver, dry), expected) < -115


def test_a_shared_tail_of_unlike_rooms_keeps_each_level(any_size):
    """Two unrelated tails, one source at a time: what is heard late has the energy of its own tail."""
    size, samples = 64, 6_000
    tail_start = Partitioning(size, samples).stages[-1].start
    irs = [decaying_ir(50, samples), 0.25 * decaying_ir(51, samples)]
    for sounding in (0, 1):
        dry = np.zeros((2, 160 * size), np.float32)
        dry[sounding, 0] = 1
        convolver = Convolver(
            sources=2, channels=2, block_size=size, ir_samples=samples, shared_tail=True, any_size=any_size
        )
        for source, ir in enumerate(irs):
            convolver.set_ir(source, ir)
        wet = stream(convolver, dry)
        heard = np.sum(wet[:, tail_start:samples].astype(float) ** 2)
        own = np.sum(irs[sounding][:, tail_start:].astype(float) ** 2)
        assert 10 * np.log10(heard / own) == pytest.approx(0, abs=0.05)


def test_both_kinds_are_equal_through_everything(any_size):
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
                any_size=kind,
            )
            for kind in (any_size, True)
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
