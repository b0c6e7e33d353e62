"""A convolver in NumPy for block sizes that are no power of two, such as the 480 samples of an offline render.

It uses the same stages, windows and IR exchanges as the compiled one, but a stage does all the work of a window at
once, when the window is full.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.fft

from server.rendering.fade import raised_cosine
from server.rendering.partitions import TURNS, Partitioning, Stage

FloatArray = npt.NDArray[np.float32]
Spectra = npt.NDArray[np.complex64]


@dataclass(frozen=True)
class SpectralFilter:
    """An impulse response (IR) transformed for every stage: one array (channel, partition, bin) per stage.
    Immutable."""

    spectra: tuple[Spectra, ...]


class AnySizeConvolver:
    """The NumPy engine of `server.rendering.convolver.Convolver`, which documents the methods."""

    def __init__(
        self,
        partitioning: Partitioning,
        sources: int,
        channels: int,
        *,
        has_shared_tail: bool,
        has_own_tails: bool,
    ) -> None:
        self._partitioning = partitioning
        block_size, stages = partitioning.block_size, partitioning.stages
        self.silent = np.zeros(sources, np.int64)
        self.exchanged = np.zeros(sources, np.int64)
        self.tail_gain = np.zeros((2, sources), np.float32)
        self.blocks = 0
        self._wanted: list[SpectralFilter | None] = [None] * sources
        self._own_tails_wanted: list[SpectralFilter | None] = [None] * sources
        self._tail_wanted: list[SpectralFilter | None] = [None]
        self._tail_silent = np.zeros(1, np.int64)
        self._fade_in = raised_cosine(block_size)
        last = len(stages) - 1
        self._stages = [
            _StageState(stage, number, sources, channels)
            for number, stage in enumerate(stages)
            if number < last or has_own_tails
        ]
        self._own_tails = self._stages[-1] if has_own_tails else None
        self._shared_tail = _StageState(stages[last], last, 1, channels) if has_shared_tail else None

    def prepare(self, ir: FloatArray, like: SpectralFilter | None = None, same_from: int = 0) -> SpectralFilter:
        spectra = []
        for number, stage in enumerate(self._partitioning.stages):
            if like is not None and stage.start >= same_from:
                spectra.append(like.spectra[number])
                continue
            piece = ir[:, stage.start : stage.end]
            count = -(-piece.shape[1] // stage.size)
            padded = np.pad(piece, ((0, 0), (0, count * stage.size - piece.shape[1])))
            spectra.append(scipy.fft.rfft(padded.reshape(len(ir), count, stage.size), 2 * stage.size))
        return SpectralFilter(tuple(spectra))

    def want(self, source: int, filters: SpectralFilter) -> None:
        self._wanted[source] = self._own_tails_wanted[source] = filters

    def want_own_tail(self, source: int, filters: SpectralFilter) -> None:
        """Set a different filter for a source's last stage; call it after `want`, which sets all stages."""
        self._own_tails_wanted[source] = filters

    def want_tail(self, filters: SpectralFilter | None) -> None:
        self._tail_wanted[0] = filters

    def process(self, blocks: FloatArray, output: FloatArray) -> None:
        shape = self.silent.size, self._partitioning.block_size
        if blocks.shape != shape:
            raise ValueError(f"expected a block {shape}, got {blocks.shape}")
        quiet = self._partitioning.quiet_blocks
        self.silent[:] = np.where(blocks.any(axis=1), 0, self.silent + 1)
        sounds = np.array([filters is not None for filters in self._wanted]) & (self.silent < quiet)
        samples = np.where(sounds[:, np.newaxis], blocks, np.float32(0))
        self._tail_silent[0] = 0 if sounds.any() else self._tail_silent[0] + 1
        output.fill(0)
        for stage in self._stages:
            wanted = self._own_tails_wanted if stage is self._own_tails else self._wanted
            stage.process(samples, sounds, wanted, output, self.blocks)
        if self._shared_tail is not None:
            now, then = self.tail_gain[:, :, np.newaxis]
            tail = np.sum((now + (then - now) * self._fade_in) * samples, axis=0, keepdims=True)
            self.tail_gain[0, sounds] = self.tail_gain[1, sounds]
            tail_sounds = np.array([self._tail_wanted[0] is not None]) & (self._tail_silent < quiet)
            self._shared_tail.process(tail, tail_sounds, self._tail_wanted, output, self.blocks)
        self.exchanged[:] = self._stages[0].exchanged
        self.blocks += 1

    def clear(self, source: int) -> None:
        self._wanted[source] = self._own_tails_wanted[source] = None
        self.silent[source] = 0
        self.tail_gain[:, source] = 0
        for stage in self._stages:
            stage.clear(source)

    def reset(self) -> None:
        for source in range(len(self._wanted)):
            self.clear(source)
        self._tail_wanted[0] = None
        self._tail_silent.fill(0)
        self.exchanged.fill(0)
        self.blocks = 0
        for stage in (*self._stages, *([self._shared_tail] if self._shared_tail else [])):
            stage.reset()


class _StageState:
    def __init__(self, stage: Stage, number: int, sources: int, channels: int) -> None:
        self.sources = sources
        self._stage = stage
        self._number = number
        self._block_size = stage.size // stage.ticks
        self._window = np.zeros((sources, 2 * stage.size), np.float32)
        self._spectra: Spectra = np.zeros((sources, stage.partitions, stage.size + 1), np.complex64)
        self._current: list[SpectralFilter | None] = [None] * sources
        self._heard = np.zeros((channels, stage.size), np.float32)
        self._made = np.zeros((channels, stage.size), np.float32)
        self._fade_out = raised_cosine(stage.size)[::-1].copy()
        self.exchanged = np.zeros(sources, np.bool)

    def process(
        self,
        samples: FloatArray,
        sounds: npt.NDArray[np.bool],
        wanted: list[SpectralFilter | None],
        output: FloatArray,
        blocks: int,
    ) -> None:
        tick = blocks % self._stage.ticks
        at = tick * self._block_size
        self._window[:, self._stage.size + at : self._stage.size + at + self._block_size] = samples
        if self._number > 0:
            output += self._heard[:, at : at + self._block_size]
        if tick == self._stage.ticks - 1:
            made = self._filter(sounds, wanted, blocks // self._stage.ticks)
            if self._number == 0:
                output += made
            self._heard, self._made = self._made, made
            self._window[:, : self._stage.size] = self._window[:, self._stage.size :]

    def _filter(self, sounds: npt.NDArray[np.bool], wanted: list[SpectralFilter | None], window: int) -> FloatArray:
        """Filter the window that is now full and return its output (channel, size)."""
        self._spectra = np.roll(self._spectra, 1, axis=1)
        self._spectra[:, 0] = scipy.fft.rfft(self._window)
        shape = len(self._made), self._stage.size + 1
        mix, surplus = np.zeros(shape, np.complex64), np.zeros(shape, np.complex64)
        for source, new in enumerate(wanted):
            old = self._current[source]
            if old is not None and new is not None and self._number > 0 and (window + source) % TURNS:
                new = old  # it is not this source's turn
            self._current[source] = new
            self.exchanged[source] = sounds[source] and old is not None and old is not new
            if new is None or not sounds[source]:
                continue
            with_new = self._product(new, source)
            mix += with_new
            if self.exchanged[source] and old is not None:
                surplus += self._product(old, source) - with_new
        output = scipy.fft.irfft(mix)[:, self._stage.size :]
        if self.exchanged.any():
            output = output + self._fade_out * scipy.fft.irfft(surplus)[:, self._stage.size :]
        return np.asarray(output, np.float32)

    def _product(self, filters: SpectralFilter, source: int) -> Spectra:
        spectra = filters.spectra[self._number]
        return np.asarray(np.sum(spectra * self._spectra[source, : spectra.shape[1]], axis=1))

    def clear(self, source: int) -> None:
        self._current[source] = None
        self._window[source] = 0
        self._spectra[source] = 0

    def reset(self) -> None:
        for source in range(self.sources):
            self.clear(source)
        self._heard.fill(0)
        self._made.fill(0)
        self.exchanged.fill(False)
