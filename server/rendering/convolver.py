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
from enum import IntEnum
from itertools import accumulate
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


class Sharing(IntEnum):
    """What sources share: the greater, the more. Shared parts come from one source, and each source feeds them at the
    level of its own."""

    NOTHING = 0
    TAIL = 1
    """The last stage."""
    REVERBERATION = 2
    """All stages but the first."""


@dataclass(frozen=True)
class PartitionedIr:
    """An impulse response transformed for convolvers of one layout. Immutable, so threads may share it."""

    layout: tuple[Partitioning, int]
    """The partitioning, and the number of channels."""
    filters: Any
    energies: tuple[float, ...]
    """For each stage the sum of squares, over all channels, of the samples from its start on."""

    @property
    def channels(self) -> int:
        return self.layout[1]

    @property
    def nbytes(self) -> int:
        """The size of its spectra in bytes, including spectra that it shares with another IR."""
        return sum(int(part.nbytes) for part in self.filters.spectra)


class Convolver:
    """Convolves `sources` mono inputs, each with its own IR of `channels` channels (one of CHANNELS), and mixes them
    into one output.

    `block_size` is a power of two from 64 up. With `any_size` it may be any size that a renderer accepts, and NumPy
    does the work. With `shared_tail` the last stage convolves one mix of all sources with one tail. This tail comes
    from the first source that has one, and each source is scaled to the level of its own tail: from twice the longest
    partition on, tails differ in little but level. A shared tail makes many sources cheaper. With `switches_tail` the
    convolver begins with nothing shared, and `share` says how much is, with the same crossfades as an IR exchange.

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
        self._starts = [stage.start for stage in stages]
        # With one stage the tail would be the whole IR, which cannot be shared.
        can_share = len(stages) > 1
        self._switches = can_share and switches_tail and not shared_tail
        self._sharing = Sharing.TAIL if can_share and shared_tail else Sharing.NOTHING
        self._has_shared = self._switches or self._sharing is not Sharing.NOTHING
        self.sources = sources
        self.channels = channels
        self.block_size = block_size
        self.ir_samples = ir_samples
        last = len(stages) - 1
        self._shareable = range(1 if self._switches else last, len(stages)) if self._has_shared else range(0)
        """The numbers of the stages that can be shared."""
        kind = _any_size_convolver() if any_size else _compiled_convolver()
        self._engine: Any = kind(
            self._partitioning,
            sources,
            channels,
            own=range(len(stages) - (self._has_shared and not self._switches)),
            shared=self._shareable,
        )
        self._layout = self._partitioning, channels
        self._irs: list[PartitionedIr | None] = [None] * sources
        self._energies = np.zeros((len(stages), sources))
        self._retired: deque[tuple[int, PartitionedIr]] = deque()
        # Compiled code uses addresses, so a replaced IR must stay in memory until its source's turn, and during the
        # window that is computed from it then.
        self._retires_after = (TURNS + 2) * stages[-1].ticks
        self._shared: PartitionedIr | None = None
        self._shared_before: PartitionedIr | None = None
        self._shared_chosen_at = -1
        self._came_at = np.full(sources, -1)
        """The number of the block in which each source got its first IR; -1 before."""

    def prepare(
        self, ir: npt.NDArray[np.floating], *, like: PartitionedIr | None = None, same_from: int = 0
    ) -> PartitionedIr:
        """Cut an IR (channels, 1..ir_samples) into partitions and transform them for `set_ir`. This is most of the cost
        of an exchange, and any thread may do it.

        If the IR equals another one from sample `same_from` on, pass the other one as `like`: stages that begin there
        or later are reused, and exchanging the two IRs does not touch these stages. Then `ir` may end at `same_from`.

        Raises ValueError for another shape, and for samples that are not finite or so large that a product could
        overflow: either would corrupt all later output.
        """
        # guard: a response has samples
        if ir.ndim != 2 or ir.shape[0] != self.channels or not 1 <= ir.shape[1] <= self.ir_samples:
            raise ValueError(f"expected an IR ({self.channels}, 1..{self.ir_samples}), got shape {ir.shape}")
        if like is not None and like.layout != self._layout:
            raise ValueError("the IR that it is like was prepared for another convolver")
        samples = _single(ir)
        prepared = self._engine.prepare(samples, None if like is None else like.filters, same_from)
        energies = tuple(accumulate(reversed(prepared.energies)))[::-1]
        # Energy says it at once of nearly all; neither is true of what is no number.
        # guard: a response is sound
        if not (energies[0] <= LOUDEST or -LOUDEST <= ir.min() <= ir.max() <= LOUDEST):
            raise ValueError(f"impulse response has samples that are not finite, or beyond {LOUDEST:g}")
        return PartitionedIr(self._layout, prepared, energies)

    @property
    def preparation(self) -> Hashable:
        """A key that is equal for convolvers which prepare IRs in the same way and may share them."""
        return self._layout

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
        self._engine.want(source, prepared.filters)
        if not self._has_shared:
            return
        is_early = previous is not None and prepared.energies[1:] == previous.energies[1:]
        self._energies[:, source] = prepared.energies
        if not is_early or self._shared is previous:
            self._choose_shared()

    def share(self, sharing: Sharing) -> None:
        """Make all sources share as much as `sharing` says. From the next block on, inputs go to other stages; what
        they have taken in before rings out. Only for a convolver made with `switches_tail`; without effect if its IRs
        are too short."""
        if self._switches and sharing is not self._sharing:
            self._sharing = sharing
            self._choose_shared()

    @property
    def early_samples(self) -> int:
        """The samples of an IR that no sources share, however much is shared: those of the first stage."""
        return min(self.ir_samples, self._partitioning.stages[0].end)

    @property
    def _first_shared(self) -> int:
        """The number of the first stage that is shared now; the number of stages if none is."""
        stages = len(self._starts)
        return {Sharing.NOTHING: stages, Sharing.TAIL: stages - 1, Sharing.REVERBERATION: 1}[self._sharing]

    def _retire(self, ir: PartitionedIr) -> None:
        self._retired.append((self._engine.blocks + self._retires_after, ir))

    def _choose_shared(self) -> None:
        """Choose whose response is shared, and the level at which each source feeds it; the level of a new source
        applies at once.

        The choice depends on the IRs of the next block and on what was shared in the last block, but not on IRs that
        were set and replaced in between, because an offline render never sees those.
        """
        if self._shared_chosen_at != self._engine.blocks:
            self._shared_chosen_at, self._shared_before = self._engine.blocks, self._shared
        first = self._first_shared
        energies = self._energies[min(first, len(self._starts) - 1)]
        at = int(np.argmax(energies > 0))
        # Where no source feeds it any more, it rings out.
        shared = self._irs[at] if energies[at] > 0 else self._shared_before
        if self._shared is not None and self._shared is not shared:
            self._retire(self._shared)
        self._shared = shared
        self._engine.want_shared(None if shared is None else shared.filters)
        gains = np.sqrt(energies / energies[at]) if energies[at] > 0 else np.zeros(self.sources)
        newcomers = self._came_at == self._engine.blocks
        for number in self._shareable:
            is_shared = number >= first
            self._engine.take_in(number, not is_shared, gains if is_shared else 0 * gains, newcomers)

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
        self._energies[:, source] = 0
        self._engine.clear(source)
        if self._has_shared:
            self._choose_shared()

    def reset(self) -> None:
        """Forget everything, as if newly constructed."""
        self._engine.reset()
        self._irs = [None] * self.sources
        self._energies.fill(0)
        self._retired.clear()
        self._shared = self._shared_before = None
        self._shared_chosen_at = -1
        self._came_at.fill(-1)


def _single(samples: npt.NDArray[np.floating]) -> FloatArray:
    """The samples in single precision, infinite where they are too large."""
    if samples.dtype == np.float32:
        return samples  # as most are; setting and resetting the error state would take longer than the rest
    with np.errstate(over="ignore"):
        return samples.astype(np.float32)


# Importing either engine takes a third of a second, and most processes need only one of them.
def _compiled_convolver() -> Any:
    from server.rendering.compiled_convolver import CompiledConvolver

    return CompiledConvolver


def _any_size_convolver() -> Any:
    from server.rendering.any_size_convolver import AnySizeConvolver

    return AnySizeConvolver
