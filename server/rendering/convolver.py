"""Partitioned convolution of several sources with impulse responses that may change while they sound.

Uniformly partitioned overlap-save (Wefers 2015, chapter 5): the impulse response (IR) is cut into partitions of one
block, each transformed once at twice the block size; each input block is transformed once; a block of output is the sum
over partitions p of spectrum p times the input spectrum of p blocks ago. The first partition meets the newest block, so
nothing is delayed.

Letters: s sources, c output channels, b block size, p partitions, f = b + 1 bins. Everything is float32 / complex64.

Sources are summed in the frequency domain in order of their number, and one that is silent adds nothing at all: what a
source adds does not depend, to the last bit, on which others came and went before.

A new IR is exchanged by running both over the same input spectra for one block and crossfading the two outputs in the
time domain. Interpolating the spectra instead would wrap around in time (a click) and comb.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft

from server.rendering.fade import raised_cosine

FloatArray = npt.NDArray[np.float32]
Spectra = npt.NDArray[np.complex64]


@dataclass(frozen=True)
class PartitionedIr:
    """An impulse response made ready for convolvers of one block size; immutable, so threads may share it."""

    conjugate_spectra: Spectra
    """(f, c, p). Conjugated because `numpy.vecdot`, the fastest kernel here, conjugates its first operand."""
    samples: int

    @property
    def block_size(self) -> int:
        return int(self.conjugate_spectra.shape[0]) - 1

    @property
    def channels(self) -> int:
        return int(self.conjugate_spectra.shape[1])

    @property
    def partitions(self) -> int:
        return int(self.conjugate_spectra.shape[2])


def partition_ir(ir: npt.NDArray[np.floating], block_size: int) -> PartitionedIr:
    """Cut and transform an IR (c, n), n >= 1. It costs more than an exchange: call it away from the audio thread.

    Raises ValueError for another shape, and for a sample that is not finite, which would spoil every output to come.
    """
    if ir.ndim != 2 or ir.shape[0] < 1 or ir.shape[1] < 1:
        raise ValueError(f"an impulse response is (channel, sample) and not empty, got shape {ir.shape}")
    if not np.isfinite(ir).all():
        raise ValueError("impulse response has samples that are not finite")
    channels, samples = ir.shape
    partitions = -(-samples // block_size)
    padded = np.zeros((channels, partitions * block_size), np.float32)
    padded[:, :samples] = ir
    spectra = scipy.fft.rfft(padded.reshape(channels, partitions, block_size), 2 * block_size)
    conjugate = np.ascontiguousarray(np.conj(spectra).transpose(2, 0, 1))
    conjugate.flags.writeable = False
    return PartitionedIr(conjugate, samples)


class Convolver:
    """`sources` mono inputs, each with its own IR of `channels` channels, mixed into one output of `channels`.

    One thread at a time may use it, except `prepare`, which any thread may call.
    """

    def __init__(self, *, sources: int, channels: int, block_size: int, ir_samples: int) -> None:
        if min(sources, channels, block_size, ir_samples) < 1:
            raise ValueError("sources, channels, block_size and ir_samples must be at least 1")
        self.sources = sources
        self.channels = channels
        self.block_size = block_size
        self.ir_samples = ir_samples
        self._partitions = -(-ir_samples // block_size)
        bins = block_size + 1
        # Each spectrum is stored twice, p apart, so that the last p are always contiguous, newest first. A source never
        # used costs no memory: the pages of np.zeros are mapped on first use.
        self._spectra: Spectra = np.zeros((sources, bins, 2 * self._partitions), np.complex64)
        self._newest = 0
        self._input = np.zeros((sources, 2 * block_size), np.float32)  # the block before, and this one
        self._silent_blocks = np.zeros(sources, np.int64)
        self._irs: list[PartitionedIr | None] = [None] * sources
        self._next_irs: list[PartitionedIr | None] = [None] * sources
        self._has_run = np.zeros(sources, np.bool)  # with an IR
        self._exchanged: tuple[int, ...] = ()
        self._mix = np.zeros((2, bins, channels), np.complex64)  # 0: with the new IRs, 1: what the old ones add to that
        self._products = np.zeros((2, bins, channels), np.complex64)
        self._fade_out = raised_cosine(block_size)[::-1, np.newaxis].copy()

    def prepare(self, ir: npt.NDArray[np.floating]) -> PartitionedIr:
        """Transform an IR (channels, 1..ir_samples) for `set_ir`; ValueError for another shape or a non-finite one."""
        if ir.ndim != 2 or ir.shape[0] != self.channels or not 1 <= ir.shape[1] <= self.ir_samples:
            raise ValueError(f"expected an IR ({self.channels}, 1..{self.ir_samples}), got shape {ir.shape}")
        return partition_ir(ir, self.block_size)

    def set_ir(self, source: int, ir: npt.NDArray[np.floating] | PartitionedIr) -> None:
        """Give a source its IR: at once before its first block, and by a crossfade over the next block from then on.

        A fade completes within its block, so none is ever restarted; of several IRs that arrive before it, only the
        newest is heard. Raises ValueError as `prepare`.
        """
        filters = ir if isinstance(ir, PartitionedIr) else self.prepare(ir)
        same_layout = (filters.channels, filters.block_size) == (self.channels, self.block_size)
        if not same_layout or filters.samples > self.ir_samples:
            raise ValueError("the IR was prepared for another convolver")
        if not self._has_run[source]:
            self._irs[source] = filters
        else:
            self._next_irs[source] = filters

    def process(self, blocks: FloatArray) -> FloatArray:
        """One block (sources, b) in, the mix (channels, b) of the same instant out, in an array of its own.

        Rows of sources without an IR are ignored. Input must be finite: gate live audio where it enters.
        """
        running = [source for source, ir in enumerate(self._irs) if ir is not None]
        self._has_run[running] = True
        sounding = self._advance(blocks, running)
        exchanging = tuple(source for source in running if self._next_irs[source] is not None)
        self._mix.fill(0)
        for source in sounding:
            self._accumulate(source)
        for source in exchanging:
            self._irs[source], self._next_irs[source] = self._next_irs[source], None
        self._exchanged = exchanging

        if exchanging:
            output, surplus = scipy.fft.irfft(self._mix, axis=1)[:, self.block_size :]
            output += self._fade_out * surplus
        else:
            output = scipy.fft.irfft(self._mix[0], axis=0)[self.block_size :]
        return np.ascontiguousarray(output.T)

    def _advance(self, blocks: FloatArray, running: list[int]) -> list[int]:
        """Take in one block; return the sources that sound, those whose last p + 2 input blocks are not all zero.

        Two more than the partitions: a spectrum spans two blocks, and the oldest one has yet to be overwritten.
        """
        size = self.block_size
        self._newest = (self._newest - 1) % self._partitions
        fed = blocks.any(axis=1)
        self._silent_blocks[fed] = 0
        self._silent_blocks[~fed] += 1
        sounding = [source for source in running if not self.is_quiet(source)]
        if sounding:
            self._input[sounding, :size] = self._input[sounding, size:]
            self._input[sounding, size:] = blocks[sounding]
            spectra = scipy.fft.rfft(self._input[sounding])
            self._spectra[sounding, :, self._newest] = spectra
            self._spectra[sounding, :, self._newest + self._partitions] = spectra
        return sounding

    def _accumulate(self, source: int) -> None:
        current, following = self._irs[source], self._next_irs[source]
        assert current is not None
        if following is None:
            self._mix[0] += self._filter(source, current, self._products[0])
        else:
            new = self._filter(source, following, self._products[0])
            old = self._filter(source, current, self._products[1])
            self._mix[0] += new
            self._mix[1] += np.subtract(old, new, out=old)

    def _filter(self, source: int, ir: PartitionedIr, out: Spectra) -> Spectra:
        recent = self._spectra[source, :, np.newaxis, self._newest : self._newest + ir.partitions]
        return np.vecdot(ir.conjugate_spectra, recent, out=out)

    @property
    def exchanged(self) -> tuple[int, ...]:
        """Sources whose IR was exchanged in the block last processed."""
        return self._exchanged

    def is_fading(self, source: int) -> bool:
        """Whether the next block will exchange the IR of this source."""
        return self._next_irs[source] is not None

    def is_quiet(self, source: int) -> bool:
        """Whether this source has rung out: it adds exactly nothing until it is fed a sample that is not zero."""
        return self._irs[source] is None or bool(self._silent_blocks[source] >= self._partitions + 2)

    def clear(self, source: int) -> None:
        """Forget a source, IR and signal. Silence it first (`is_quiet`) unless a click is welcome."""
        self._irs[source] = None
        self._next_irs[source] = None
        self._silent_blocks[source] = 0
        if self._has_run[source]:
            self._has_run[source] = False
            self._spectra[source] = 0
            self._input[source] = 0

    def reset(self) -> None:
        """Forget everything, as if just constructed."""
        for source in range(self.sources):
            self.clear(source)
        self._newest = 0
        self._exchanged = ()
