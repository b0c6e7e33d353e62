"""Convolution of several sources with impulse responses (IRs) that may change while the sources sound.

The method is non-uniformly partitioned overlap-save, which adds no delay (`server.rendering.partitions`). Sources are
summed in the frequency domain, in an order that depends only on their numbers. A silent source costs nothing and adds
exactly nothing.

A new IR is exchanged stage by stage: in the stage's next window both IRs are applied to the same input spectra, and
their outputs are crossfaded in the time domain over one partition, along a raised cosine. Interpolating the spectra
instead would wrap around in time (a click) and cause comb filtering. Only partitions that differ are computed twice.
The first stage, called the head, exchanges in the next block. Each later stage exchanges one source in TURNS per
window, so the later parts of the IR follow within TURNS + 1 partitions of their stage; if several IRs arrive meanwhile,
these stages use only the newest.

Compiled code (`server.rendering.convolver_kernel`) convolves blocks of a power of two, and NumPy
(`server.rendering.any_size_convolver`) all others; their results agree to -120 dB.
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
CHANNELS = (1, 2, 4, 9, 16)
"""Numbers of channels that can be convolved: one, two ears, and ambisonics of order 1 to 3."""

if TYPE_CHECKING:
    from server.rendering.compiled_convolver import CompiledConvolver


@dataclass(frozen=True)
class PartitionedIr:
    """An impulse response transformed for convolvers of one layout. Immutable, so threads may share it."""

    layout: tuple[Partitioning, int]
    """The partitioning, and the number of channels."""
    filters: Any
    tail_energy: float
    """The sum of squares, over all channels, of the samples that a shared tail can replace."""

    @property
    def channels(self) -> int:
        return self.layout[1]

    @property
    def nbytes(self) -> int:
        """The size of its spectra in bytes, including spectra that it shares with another IR."""
        return sum(int(part.nbytes) for part in self.filters.spectra)


@dataclass(frozen=True)
class _Tail:
    """The filter of the shared tail's stage: `filters`, made from `ir`, or silence."""

    ir: PartitionedIr | None
    filters: Any


_NO_TAIL = _Tail(None, None)


class Convolver:
    """Convolves `sources` mono inputs, each with its own IR of `channels` channels (one of CHANNELS), and mixes them
    into one output.

    `block_size` is a power of two from 64 up. With `any_size` it may be any size that a renderer accepts, and NumPy
    does the work. With `shared_tail` the last stage convolves one mix of all sources with one tail. This tail comes
    from the first source that has one, and each source is scaled to the level of its own tail: from twice the longest
    partition on, tails differ in little but level. A shared tail makes many sources cheaper. With `switches_tail` the
    convolver begins with separate tails, and `share_tail` switches between shared and separate ones with the same
    crossfades as an IR exchange.

    Only one thread at a time may use it, except `prepare`, which any thread may call. Raises ValueError for sizes that
    are not supported.
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
        if sources < 1 or channels not in CHANNELS:
            raise ValueError(f"a convolver has at least 1 source, and {CHANNELS} channels")
        self._partitioning = Partitioning(block_size, ir_samples, any_size)
        stages = self._partitioning.stages
        # With one stage the tail would be the whole IR, which cannot be shared.
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
        # The filter of a stage that must stay inaudible: it has no partitions except in the head.
        self._silence = self._engine.prepare(np.zeros((channels, 1), np.float32)) if self._switches_tail else None
        self._layout = self._partitioning, channels
        self._irs: list[PartitionedIr | None] = [None] * sources
        self._tail_energy = np.zeros(sources)
        self._retired: deque[tuple[int, PartitionedIr]] = deque()
        # Compiled code uses addresses, so a replaced IR must stay in memory until its source's turn, and during the
        # window that is computed from it then.
        self._retires_after = (TURNS + 2) * stages[-1].ticks
        self._tail = self._tail_before = _NO_TAIL
        self._tail_chosen_at = -1
        self._came_at = np.full(sources, -1)
        """The number of the block in which each source got its first IR; -1 before."""

    def prepare(
        self, ir: npt.NDArray[np.floating], *, like: PartitionedIr | None = None, same_from: int = 0
    ) -> PartitionedIr:
        """Cut an IR (channels, 1..ir_samples) into partitions and transform them for `set_ir`. This is most of the cost
        of an exchange, and any thread may do it.

        If the IR equals another one of the same length from sample `same_from` on, pass the other one as `like`: stages
        that begin there or later are reused, and exchanging the two IRs does not touch these stages.

        Raises ValueError for another shape, and for samples that are not finite or so large that a product could
        overflow: either would corrupt all later output.
        """
        # guard: a response has samples
        if ir.ndim != 2 or ir.shape[0] != self.channels or not 1 <= ir.shape[1] <= self.ir_samples:
            raise ValueError(f"expected an IR ({self.channels}, 1..{self.ir_samples}), got shape {ir.shape}")
        with np.errstate(over="ignore"):  # an overflow is found below
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
        """A key that is equal for convolvers which prepare IRs in the same way and may share them."""
        return self._layout, self._tail_start

    def set_ir(self, source: int, ir: npt.NDArray[np.floating] | PartitionedIr) -> None:
        """Set the IR of a source: at once before the source's first block, by a crossfade from the next block on after
        it.

        Crossfades complete within their partition, so none is ever restarted. If several IRs arrive before a crossfade,
        only the newest is used, and the output is the same as if the others had never arrived. Raises ValueError as
        `prepare` does.
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
        """Make all sources share one tail, or give each its own. Only for a convolver made with `switches_tail`;
        without effect if its IRs are too short for a tail."""
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
        """Choose the shared tail and the level at which each source feeds it; the level of a new source applies at
        once.

        The choice depends on the IRs of the next block and on the tail of the last block, but not on IRs that were set
        and replaced in between, because an offline render never sees those.
        """
        if self._tail_chosen_at != self._engine.blocks:
            self._tail_chosen_at, self._tail_before = self._engine.blocks, self._tail
        ir = next((ir for ir in self._irs if ir is not None and ir.tail_energy > 0), None)
        if ir is not None:
            tail = _Tail(ir, ir.filters if self._shares_tail else self._silence)
        elif self._shares_tail or self._tail_before is _NO_TAIL:
            tail = self._tail_before  # no source feeds this tail any more: it rings out
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
        """Convolve one block (sources, b) and return the mix (channels, b) of the same time span, in `out` or a new
        array.

        Rows of sources without an IR are ignored. The input must be finite: check live audio where it enters.
        """
        if out is None:
            out = np.empty((self.channels, self.block_size), np.float32)
        self._engine.process(blocks, out)
        if self._retired:
            self.release()
        return out

    @property
    def compiled(self) -> "CompiledConvolver":
        """The engine that the compiled renderer calls directly; the renderer has to call `release` after each block."""
        return self._engine  # type: ignore[no-any-return]

    def release(self) -> None:
        """Drop references to IRs that no stage can be using any more."""
        while self._retired and self._retired[0][0] <= self._engine.blocks:
            self._retired.popleft()

    @property
    def exchanged(self) -> tuple[int, ...]:
        """The sources whose IR was exchanged in the head during the last block."""
        return tuple(int(source) for source in np.flatnonzero(self._engine.exchanged))

    def is_quiet(self, source: int) -> bool:
        """Whether this source has rung out: it adds exactly nothing until its input has a nonzero sample."""
        return self._irs[source] is None or bool(self._engine.silent[source] >= self._partitioning.quiet_blocks)

    def clear(self, source: int) -> None:
        """Forget the IR and the signal of a source. Wait until it is silent (`is_quiet`), or this may click."""
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
        """Forget everything, as if newly constructed."""
        self._engine.reset()
        self._irs = [None] * self.sources
        self._tail_energy.fill(0)
        self._retired.clear()
        self._tail = self._tail_before = _NO_TAIL
        self._tail_chosen_at = -1
        self._came_at.fill(-1)


def _energy(samples: FloatArray) -> float:
    """The energy of samples (channel, n): their sum of squares, computed without a copy."""
    return float(np.einsum("cn,cn->", samples, samples))


# Importing either engine takes a third of a second, and most processes need only one of them.
def _compiled_convolver() -> Any:
    from server.rendering.compiled_convolver import CompiledConvolver

    return CompiledConvolver


def _any_size_convolver() -> Any:
    from server.rendering.any_size_convolver import AnySizeConvolver

    return AnySizeConvolver
