"""What all sources share, changed while they sound."""

import numpy as np
import pytest

from server.rendering.convolver import Convolver, Sharing
from server.rendering.partitions import Partitioning
from tests.rendering.streams import BOTH_KINDS
from tests.signals import error_db

SIZE, SAMPLES, SOURCES = 64, 4_000, 3
SETTLED = SAMPLES + 4 * 16 * SIZE


SWITCHES = {"switches_tail": True}

pytestmark = BOTH_KINDS


def make(any_size, channels=2, **kind):
    return Convolver(sources=SOURCES, channels=channels, block_size=SIZE, ir_samples=SAMPLES, any_size=any_size, **kind)


def rooms(seed, channels=2):
    rng = np.random.default_rng(seed)
    decay = np.exp(-np.arange(SAMPLES) / 900)
    return [(0.1 * decay * rng.standard_normal((channels, SAMPLES))).astype(np.float32) for _ in range(SOURCES)]


def stream(convolver, dry, switches=(), irs=()):
    """`switches` and `irs` by block: what to share from there on; a source and its next IR."""
    switches, irs, output = dict(switches), dict(irs), []
    for block in range(dry.shape[1] // SIZE):
        if block in switches:
            convolver.share(switches[block])
        if block in irs:
            convolver.set_ir(*irs[block])
        output.append(convolver.process(dry[:, block * SIZE : (block + 1) * SIZE]))
    return np.concatenate(output, axis=1).astype(float)


def with_shared(irs, sharing):
    """The responses as they sound if everything from the start of a stage on is that of the first, at each one's own
    level."""
    stages = Partitioning(SIZE, SAMPLES).stages
    start = stages[{Sharing.TAIL: -1, Sharing.REVERBERATION: 1}[sharing]].start
    late = irs[0][:, start:]
    gains = [np.sqrt((ir[:, start:] ** 2).sum() / (late**2).sum()) for ir in irs]
    return [np.concatenate([ir[:, :start], gain * late], axis=1) for ir, gain in zip(irs, gains, strict=True)]


@pytest.mark.parametrize("sharing", [Sharing.TAIL, Sharing.REVERBERATION])
@pytest.mark.parametrize("channels", [2, 4, 9])
def test_before_and_after_a_switch_it_is_as_if_it_had_always_been_so(any_size, channels, sharing):
    dry = np.random.default_rng(1).standard_normal((SOURCES, 400 * SIZE)).astype(np.float32)
    irs = rooms(2, channels)
    irs[1] *= 2
    own, together, switched = (make(any_size, channels), make(any_size, channels), make(any_size, channels, **SWITCHES))
    for source, (ir, shared_ir) in enumerate(zip(irs, with_shared(irs, sharing), strict=True)):
        own.set_ir(source, ir)
        together.set_ir(source, shared_ir)
        switched.set_ir(source, ir)
    alone, shared = stream(own, dry), stream(together, dry)
    heard = stream(switched, dry, [(100, sharing), (250, Sharing.NOTHING)])
    first, second = slice(None, 100 * SIZE), slice(100 * SIZE + SETTLED, 250 * SIZE)
    last = slice(250 * SIZE + SETTLED, None)
    assert error_db(heard[:, first], alone[:, first]) < -115
    assert error_db(heard[:, second], shared[:, second]) < -115
    assert error_db(heard[:, last], alone[:, last]) < -115
    assert error_db(heard[:, second], alone[:, second]) > -60  # or there would be nothing to switch


def test_a_convolver_made_with_a_shared_tail_is_one_that_switched_to_it(any_size):
    dry = np.random.default_rng(1).standard_normal((SOURCES, 200 * SIZE)).astype(np.float32)
    made, switched = make(any_size, shared_tail=True), make(any_size, **SWITCHES)
    switched.share(Sharing.TAIL)
    for convolver in (made, switched):
        for source, ir in enumerate(rooms(2)):
            convolver.set_ir(source, ir)
    assert error_db(stream(switched, dry), stream(made, dry)) < -115


def test_early_parts_are_exchanged_by_themselves(any_size):
    """The rest stays that of the response before, whatever is shared."""
    dry = np.random.default_rng(1).standard_normal((SOURCES, 300 * SIZE)).astype(np.float32)
    for sharing in Sharing:
        parts, whole = make(any_size, **SWITCHES), make(any_size, **SWITCHES)
        early = parts.early_samples
        for source, (ir, other) in enumerate(zip(rooms(2), rooms(8), strict=True)):
            before = parts.prepare(ir)
            parts.set_ir(source, before)
            parts.set_ir(source, parts.prepare(other[:, :early], like=before, same_from=early))
            whole.set_ir(source, np.concatenate([other[:, :early], ir[:, early:]], axis=1))
        for convolver in (parts, whole):
            convolver.share(sharing)
        np.testing.assert_array_equal(stream(parts, dry), stream(whole, dry))


def test_both_kinds_switch_alike_while_irs_change(any_size):
    rng = np.random.default_rng(3)
    pair = [make(kind, switches_tail=True) for kind in (any_size, True)]
    outputs = [[], []]
    for block in range(400):
        dry = rng.standard_normal((SOURCES, SIZE)).astype(np.float32)
        source, ir = int(rng.integers(SOURCES)), rooms(int(rng.integers(1_000)))[0]
        action = rng.random()
        for convolver, output in zip(pair, outputs, strict=True):
            if action < 0.05:
                convolver.set_ir(source, ir)
            elif action < 0.08:
                convolver.share(Sharing(block % 3))
            output.append(convolver.process(dry))
    assert error_db(np.concatenate(outputs[0], axis=1), np.concatenate(outputs[1], axis=1)) < -115


def test_switching_does_not_splatter(any_size):
    sample_rate = 24_000
    time_s = np.arange(500 * SIZE) / sample_rate
    dry = np.tile(np.sin(2 * np.pi * 500 * time_s), (SOURCES, 1)).astype(np.float32)
    convolver = make(any_size, switches_tail=True)
    for source, ir in enumerate(rooms(4)):
        convolver.set_ir(source, ir)
    wet = stream(convolver, dry, [(block, Sharing(block // 40 % 3)) for block in range(120, 480, 40)])
    middle = wet[:, SETTLED:] * np.blackman(wet.shape[1] - SETTLED)
    spectrum = np.abs(np.fft.rfft(middle)) ** 2
    frequency = np.fft.rfftfreq(middle.shape[1], 1 / sample_rate)
    assert 10 * np.log10(spectrum[:, frequency > 4_000].sum() / spectrum.sum()) < -90


def test_responses_without_a_tail_have_none_to_share(any_size):
    short = Partitioning(SIZE, 400)
    assert len(short.stages) == 1
    convolver = Convolver(sources=1, channels=2, block_size=SIZE, ir_samples=400, switches_tail=True, any_size=any_size)
    convolver.set_ir(0, rooms(5)[0][:, :400])
    convolver.share(Sharing.REVERBERATION)
    dry = np.zeros((1, 20 * SIZE), np.float32)
    dry[0, 0] = 1
    assert error_db(stream(convolver, dry)[:, :400], rooms(5)[0][:, :400].astype(float)) < -115


@pytest.mark.parametrize("kind", [{"switches_tail": True}, {"shared_tail": True}, {}], ids=str)
def test_what_is_replaced_before_a_block_leaves_no_trace(any_size, kind):
    """One convolver is told everything, the other only what stands when a block is made. Some responses have no
    tail."""
    rng = np.random.default_rng(7)
    told_all, told_last = make(any_size, **kind), make(any_size, **kind)
    known = [ir[:, :length] for seed in range(4) for ir, length in zip(rooms(seed), (SAMPLES, 300, 300), strict=True)]
    outputs = [[], []]
    for _ in range(400):
        dry = rng.standard_normal((SOURCES, SIZE)).astype(np.float32)
        if rng.random() < 0.2:
            calls = [(int(rng.integers(SOURCES)), known[rng.integers(len(known))]) for _ in range(8)]
            switches = [Sharing(int(rng.integers(3))) for _ in calls]
            for (source, ir), sharing in zip(calls, switches, strict=True):
                told_all.set_ir(source, ir)
                told_all.share(sharing)
            for source, ir in dict(calls).items():
                told_last.set_ir(source, ir)
            told_last.share(switches[-1])
        for convolver, output in zip((told_all, told_last), outputs, strict=True):
            output.append(convolver.process(dry))
    np.testing.assert_array_equal(*(np.concatenate(output, axis=1) for output in outputs))
