"""Compiled code reads responses by their addresses, so each must stay in memory for as long as one is held."""

import random
import weakref

import numpy as np
import pytest

from server.rendering.convolver import Convolver, PartitionedIr, Sharing

BLOCK_SIZE = 64
IR_SAMPLES = 60 * BLOCK_SIZE  # three stages


class Responses:
    """Makes responses, and knows which of them still exist."""

    def __init__(self, convolver: Convolver, rng: np.random.Generator) -> None:
        self._convolver, self._rng = convolver, rng
        self._filters: list[weakref.ref] = []

    def new(self, blocks: int, like: PartitionedIr | None = None) -> PartitionedIr:
        samples = self._rng.standard_normal((2, blocks * BLOCK_SIZE)).astype(np.float32)
        ir = self._convolver.prepare(samples, like=like, same_from=self._convolver.early_samples)
        self._filters.append(weakref.ref(ir.filters))
        return ir

    @property
    def addresses(self) -> set[int]:
        return {filters.address for each in self._filters if (filters := each()) is not None}


def addresses_held_by(convolver: Convolver) -> set[int]:
    """The addresses of responses that the next block may read."""
    engine = convolver.compiled
    held = [engine._wanted, *engine._shared_wanted.values()]
    for arrays, jobs in zip(engine._stage_arrays, engine._stages["jobs"], strict=True):
        held += [arrays.current, arrays.job_old[:jobs], arrays.job_new[:jobs]]
    return {int(each) for array in held for each in array} - {0}


@pytest.mark.parametrize("kind", ["shared_tail", "switches_tail"])
@pytest.mark.parametrize("seed", range(12))
def test_whatever_is_done_no_response_is_read_that_is_gone(seed, kind):
    choose, rng = random.Random(seed), np.random.default_rng(seed)
    sources = choose.choice((1, 2, 3))
    convolver = Convolver(sources=sources, channels=2, block_size=BLOCK_SIZE, ir_samples=IR_SAMPLES, **{kind: True})
    responses = Responses(convolver, rng)
    for _ in range(60):
        source = choose.randrange(sources)
        match choose.choice(("new", "new", "early", "clear", "share", "process", "wait", "reset")):
            case "new":
                convolver.set_ir(source, responses.new(choose.choice((1, 9, 20, 60))))
            case "early":
                convolver.set_ir(source, responses.new(60, like=convolver._irs[source]))
            case "clear":
                convolver.clear(source)
            case "share":
                convolver.share(choose.choice(list(Sharing)))
            case "reset" if choose.random() < 0.2:
                convolver.reset()
            case "process":
                for _ in range(choose.choice((1, 5, 17))):
                    convolver.process(rng.standard_normal((sources, BLOCK_SIZE)).astype(np.float32))
            case "wait":
                for _ in range(120):
                    convolver.process(np.zeros((sources, BLOCK_SIZE), np.float32))
        assert addresses_held_by(convolver) <= responses.addresses


@pytest.mark.parametrize("kind", ["shared_tail", "switches_tail"])
def test_a_response_that_went_before_the_first_block_is_shared_by_nobody(kind):
    convolver = Convolver(sources=2, channels=2, block_size=BLOCK_SIZE, ir_samples=IR_SAMPLES, **{kind: True})
    if kind == "switches_tail":
        convolver.share(Sharing.REVERBERATION)
    convolver.set_ir(0, Responses(convolver, np.random.default_rng(0)).new(60))
    convolver.clear(0)
    assert not addresses_held_by(convolver)
