"""Convolution of several sources with impulse responses (IRs) that may change while they sound.

Non-uniformly partitioned overlap-save, nothing delayed (`server.rendering.partitions`). Sources are summed in the
frequency domain, in an order that their numbers alone decide; one that is silent costs nothing and adds nothing at all.

A new IR is exchanged stage by stage: at the stage's next window both IRs run over the same input spectra, and their
outputs are crossfaded in the time domain over one partition, a raised cosine. Interpolating the spectra instead would
wrap around in time (a click) and comb. Only partitions that differ are computed twice. The head, the first stage,
begins with the next block; later stages exchange one source in TURNS per window, so later parts of the IR follow within
TURNS + 1 partitions of their stage, and of several IRs that arrive meanwhile only the newest is heard there.

Blocks of a power of two are convolved by compiled code (`server.rendering.convolver_kernel`), others by NumPy
(`server.rendering.any_size_convolver`): the same to -120 dB.
"""

from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from server.rendering.ingest import LOUDEST
from server.rendering.partitions import TURNS, Partitioning

FloatArray = npt.NDArray[np.float32]

if TYPE_CHECKING:
    from server.rendering.compiled_convolver import CompiledConvolver


@dataclass(frozen=True)
class PartitionedIr:
    """An impulse response made ready for convolvers of one layout; immutable, so threads may share it."""

    layout: tuple[Partitioning, int]
    """Partitioning, channels."""
    filters: Any
    tail_energy: float
    """Sum of squares of the samples that a shared tail stands for, over both channels."""

    @property
    def channels(self) -> int:
        return self.layout[1]

    @property
    def nbytes(self) -> int:
        """What its spectra take, including any that it shares with another."""
        return sum(int(part.nbytes) for part in self.filters.spectra)


@dataclass(frozen=True)
class _Tail:
    """What the stage of the shared tail convolves with: `filters` of `ir`, or silence."""

    ir: PartitionedIr | None
    filters: Any


_NO_TAIL = _Tail(None, None)


class Convolver:
    """`sources` mono inputs, each with its own IR of `channels` channels (1 or 2), mixed into one output.

    `block_size` is a power of two from 64 on or, with `any_size` and in NumPy alone, any that a renderer takes. With
    `shared_tail` the last stage convolves one mix of all sources with one tail, that of the first source that has any,
    each source at the level of its own: later than twice the longest partition, tails differ little but in level. It
    makes many sources cheaper. With `switches_tail` it begins without, and `share_tail` has it share its tail or not:
    fades like those of an exchange lead from one to the other.

    One thread at a time may use it, except `prepare`, which any thread may call. Raises ValueError for sizes it cannot
    have.
    """

    def __init__(
        self,
        *,
        sources: int,
        channels: int,
        block_size: int,
        ir_samples: int,
        shared_tail: bool = False,
        switches_tail: bool = False,
        any_size: bool = False,
    ) -> None:
        if sources < 1 or channels not in {1, 2}:
            raise ValueError("a convolver has at least 1 source, and 1 or 2 channels")
        self._partitioning = Partitioning(block_size, ir_samples, any_size)
        stages = self._partitioning.stages
        # A tail that starts with the IR is no tail.
        self._has_shared_tail = (shared_tail or switches_tail) and len(stages) > 1
        self._switches_tail = self._has_shared_tail and not shared_tail
        self._shares_tail = self._has_shared_tail and shared_tail
        self._tail_start = stages[-1].start if self._has_shared_tail else ir_samples
        self.sources = sources
        self.channels = channels
        self.block_size = block_size
        self.ir_samples = ir_samples
        kind = _any_size_convolver() if any_size else _compiled_convolver()
        self._engine: Any = kind(
            self._partitioning,
            sources,
            channels,
            has_shared_tail=self._has_shared_tail,
            has_own_tails=self._switches_tail or not self._has_shared_tail,
        )
        # What a stage that is not to be heard convolves with: no partition of it but in the head.
        self._silence = self._engine.prepare(np.zeros((channels, 1), np.float32)) if self._switches_tail else None
        self._layout = self._partitioning, channels
        self._irs: list[PartitionedIr | None] = [None] * sources
        self._tail_energy = np.zeros(sources)
        self._retired: deque[tuple[int, PartitionedIr]] = deque()
        # Compiled code holds addresses: an IR that was replaced is in use until its source's turn, and in the
        # window that is made of it then.
        self._retires_after = (TURNS + 2) * stages[-1].ticks
        self._tail = self._tail_before = _NO_TAIL
        self._tail_chosen_at = -1
        self._came_at = np.full(sources, -1)
        """In which block each source got its first IR."""

    def prepare(
        self, ir: npt.NDArray[np.floating], *, like: PartitionedIr | None = None, same_from: int = 0
    ) -> PartitionedIr:
        """Cut and transform an IR (channels, 1..ir_samples) for `set_ir`: most of its cost, on any thread.

        Where the IR is known to be, from sample `same_from` on, the one of the same length that `like` was made of, the
        stages that begin there or later are taken from it, and an exchange of the two leaves them alone.

        Raises ValueError for another shape, and for a sample that is not finite, or so large that a product might not
        be: either would spoil every output to come.
        """
        # guard: a response has samples
        if ir.ndim != 2 or ir.shape[0] != self.channels or not 1 <= ir.shape[1] <= self.ir_samples:
            raise ValueError(f"expected an IR ({self.channels}, 1..{self.ir_samples}), got shape {ir.shape}")
        with np.errstate(over="ignore"):  # seen below
            samples = ir.astype(np.float32, copy=False)
        head_energy, tail_energy = _energy(samples[:, : self._tail_start]), _energy(samples[:, self._tail_start :])
        # Energy says it at once of nearly all; neither is true of what is no number.
        # guard: a response is sound
        if not (head_energy + tail_energy <= LOUDEST or -LOUDEST <= ir.min() <= ir.max() <= LOUDEST):
            raise ValueError(f"impulse response has samples that are not finite, or beyond {LOUDEST:g}")
        if like is not None and like.layout != self._layout:
            raise ValueError("the IR that it is like was prepared for another convolver")
        prepared = self._engine.prepare(samples, None if like is None else like.filters, same_from)
        return PartitionedIr(self._layout, prepared, tail_energy)

    @property
    def preparation(self) -> Hashable:
        """Convolvers of which this is equal prepare IRs alike, and may share them."""
        return self._layout, self._tail_start

    def set_ir(self, source: int, ir: npt.NDArray[np.floating] | PartitionedIr) -> None:
        """Give a source its IR: at once before its first block, and by a crossfade from the next block on after it.

        Fades complete within their partition, so none is ever restarted; of several IRs that arrive before one, only
        the newest is heard: what comes out is the same as if no other had arrived. Raises ValueError as `prepare`.
        """
        prepared = ir if isinstance(ir, PartitionedIr) else self.prepare(ir)
        if prepared.layout != self._layout:
            raise ValueError("the IR was prepared for another convolver")
        previous = self._irs[source]
        if previous is None:
            self._came_at[source] = self._engine.blocks
        else:
            self._retire(previous)
        self._irs[source] = prepared
        self._tail_energy[source] = prepared.tail_energy
        self._engine.want(source, prepared.filters)
        if self._shares_tail and self._switches_tail:
            self._engine.want_own_tail(source, self._silence)
        if self._has_shared_tail:
            self._choose_tail()

    def share_tail(self, is_shared: bool) -> None:
        """Have all sources share a tail, or none; only of a convolver that switches tails. Nothing happens where its
        IRs are too short to have any."""
        if not self._switches_tail or is_shared == self._shares_tail:
            return
        self._shares_tail = is_shared
        for source, ir in enumerate(self._irs):
            if ir is not None:
                self._engine.want_own_tail(source, self._silence if is_shared else ir.filters)
        self._choose_tail()

    def _retire(self, ir: PartitionedIr) -> None:
        self._retired.append((self._engine.blocks + self._retires_after, ir))

    def _choose_tail(self) -> None:
        """Choose the shared tail, and the level at which each source feeds it; a newcomer's is in effect at once.

        The choice depends on the IRs of the next block and on what the last block was made with, and on nothing that
        was handed in and replaced between the two: an offline render knows nothing of that.
        """
        if self._tail_chosen_at != self._engine.blocks:
            self._tail_chosen_at, self._tail_before = self._engine.blocks, self._tail
        ir = next((ir for ir in self._irs if ir is not None and ir.tail_energy > 0), None)
        if ir is not None:
            tail = _Tail(ir, ir.filters if self._shares_tail else self._silence)
        elif self._shares_tail or self._tail_before is _NO_TAIL:
            tail = self._tail_before  # which nothing feeds any more: it rings out
        else:
            tail = _Tail(self._tail_before.ir, self._silence)
        if self._tail.ir is not None and self._tail.ir is not tail.ir:
            self._retire(self._tail.ir)
        self._tail = tail
        self._engine.want_tail(tail.filters)
        self._engine.tail_gain[1] = 0.0 if ir is None else np.sqrt(self._tail_energy / ir.tail_energy)
        newcomers = self._came_at == self._engine.blocks
        self._engine.tail_gain[0, newcomers] = self._engine.tail_gain[1, newcomers]

    def process(self, blocks: FloatArray, out: FloatArray | None = None) -> FloatArray:
        """One block (sources, b) in, the mix (channels, b) of the same instant out: in `out`, or an array of its own.

        Rows of sources without an IR are ignored. Input must be finite: gate live audio where it enters.
        """
        if out is None:
            out = np.empty((self.channels, self.block_size), np.float32)
        self._engine.process(blocks, out)
        if self._retired:
            self.release()
        return out

    @property
    def compiled(self) -> "CompiledConvolver":
        """What the compiled renderer runs in its own call; it has to `release` after each block."""
        return self._engine  # type: ignore[no-any-return]

    def release(self) -> None:
        """Let go of IRs that no stage can be using any more."""
        while self._retired and self._retired[0][0] <= self._engine.blocks:
            self._retired.popleft()

    @property
    def exchanged(self) -> tuple[int, ...]:
        """Sources whose IR was exchanged in the head, in the block last processed."""
        return tuple(int(source) for source in np.flatnonzero(self._engine.exchanged))

    def is_quiet(self, source: int) -> bool:
        """Whether this source has rung out: it adds exactly nothing until it is fed a sample that is not zero."""
        return self._irs[source] is None or bool(self._engine.silent[source] >= self._partitioning.quiet_blocks)

    def clear(self, source: int) -> None:
        """Forget a source, IR and signal. Silence it first (`is_quiet`) unless a click is welcome."""
        ir = self._irs[source]
        if ir is None:
            return
        self._retire(ir)
        self._irs[source] = None
        self._tail_energy[source] = 0
        self._engine.clear(source)
        if self._has_shared_tail:
            self._choose_tail()

    def reset(self) -> None:
        """Forget everything, as if just constructed."""
        self._engine.reset()
        self._irs = [None] * self.sources
        self._tail_energy.fill(0)
        self._retired.clear()
        self._tail = self._tail_before = _NO_TAIL
        self._tail_chosen_at = -1
        self._came_at.fill(-1)


def _energy(samples: FloatArray) -> float:
    """Of (channel, n), without a copy of it."""
    return float(np.einsum("cn,cn->", samples, samples))


# Either takes a third of a second to import, and is wanted without the other.
def _compiled_convolver() -> Any:
    from server.rendering.compiled_convolver import CompiledConvolver

    return CompiledConvolver


def _any_size_convolver() -> Any:
    from server.rendering.any_size_convolver import AnySizeConvolver

    return AnySizeConvolver
