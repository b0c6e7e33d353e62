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
    """An impulse response (IR) transformed for every stage: one array (channel, partition, bin) per stage, and the sum
    of squares of the stage's samples. Immutable."""

    spectra: tuple[Spectra, ...]
    energies: tuple[float, ...]


class AnySizeConvolver:
    """The NumPy engine of `server.rendering.convolver.Convolver`, which documents the methods."""

    def __init__(
        self,
        partitioning: Partitioning,
        sources: int,
        channels: int,
        *,
        own: range,
        shared: range,
    ) -> None:
        self._partitioning = partitioning
        block_size, stages = partitioning.block_size, partitioning.stages
        self.silent = np.zeros(sources, np.int64)
        self.exchanged = np.zeros(sources, np.int64)
        self.blocks = 0
        self._wanted: list[SpectralFilter | None] = [None] * sources
        self._shared_wanted: list[SpectralFilter | None] = [None]
        self._fade_in = raised_cosine(block_size)
        self._own = {number: _StageState(stages[number], number, sources, channels) for number in own}
        self._shared = {number: _StageState(stages[number], number, 1, channels) for number in shared}
        self._own_gain = {number: np.zeros((2, sources), np.float32) for number in own if number in shared}
        self._shared_gain = {number: np.zeros((2, sources), np.float32) for number in shared}

    def prepare(self, ir: FloatArray, like: SpectralFilter | None = None, same_from: int = 0) -> SpectralFilter:
        spectra, energies = [], []
        for number, stage in enumerate(self._partitioning.stages):
            if like is not None and stage.start >= same_from:
                spectra.append(like.spectra[number])
                energies.append(like.energies[number])
                continue
            piece = ir[:, stage.start : stage.end]
            count = -(-piece.shape[1] // stage.size)
            padded = np.pad(piece, ((0, 0), (0, count * stage.size - piece.shape[1])))
            spectra.append(scipy.fft.rfft(padded.reshape(len(ir), count, stage.size), 2 * stage.size))
            energies.append(float(np.einsum("cn,cn->", piece, piece)))
        return SpectralFilter(tuple(spectra), tuple(energies))

    def want(self, source: int, filters: SpectralFilter) -> None:
        self._wanted[source] = filters

    def want_shared(self, filters: SpectralFilter | None) -> None:
        self._shared_wanted[0] = filters

    def take_in(self, number: int, own: bool, shared: FloatArray, at_once: npt.NDArray[np.bool]) -> None:
        """As `CompiledConvolver.take_in` does."""
        for gain, gains in ((self._own_gain.get(number), np.float32(own)), (self._shared_gain[number], shared)):
            if gain is not None:
                gain[1] = gains
                gain[0, at_once] = gain[1, at_once]

    def process(self, blocks: FloatArray, output: FloatArray) -> None:
        shape = self.silent.size, self._partitioning.block_size
        if blocks.shape != shape:
            raise ValueError(f"expected a block {shape}, got {blocks.shape}")
        quiet = self._partitioning.quiet_blocks
        self.silent[:] = np.where(blocks.any(axis=1), 0, self.silent + 1)
        sounds = np.array([filters is not None for filters in self._wanted]) & (self.silent < quiet)
        samples = np.where(sounds[:, np.newaxis], blocks, np.float32(0))
        output.fill(0)
        for number, stage in self._own.items():
            own = self._taken_in(samples, sounds, self._own_gain[number]) if number in self._own_gain else samples
            stage.process(own, sounds, self._wanted, output, self.blocks)
        is_shared = np.array([self._shared_wanted[0] is not None])
        for number, stage in self._shared.items():
            mix = np.sum(self._taken_in(samples, sounds, self._shared_gain[number]), axis=0, keepdims=True)
            stage.process(mix, is_shared, self._shared_wanted, output, self.blocks)
        self.exchanged[:] = self._own[0].exchanged
        self.blocks += 1

    def _taken_in(self, samples: FloatArray, sounds: npt.NDArray[np.bool], gain: FloatArray) -> FloatArray:
        """The inputs at their gains (2, source), which move to what is wanted."""
        now, then = gain[:, :, np.newaxis]
        taken = (now + (then - now) * self._fade_in) * samples
        gain[0, sounds] = gain[1, sounds]
        return np.asarray(taken, np.float32)

    def clear(self, source: int) -> None:
        self._wanted[source] = None
        self.silent[source] = 0
        for gain in (*self._own_gain.values(), *self._shared_gain.values()):
            gain[:, source] = 0
        for stage in self._own.values():
            stage.clear(source)

    def reset(self) -> None:
        for source in range(len(self._wanted)):
            self.clear(source)
        self._shared_wanted[0] = None
        self.exchanged.fill(0)
        self.blocks = 0
        for stage in (*self._own.values(), *self._shared.values()):
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
