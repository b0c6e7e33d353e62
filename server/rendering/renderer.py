"""What one listener hears of many emitters: clips played, scaled and convolved with impulse responses (IRs).

The renderer knows neither poses nor fields. Whoever calls it hands in IRs, with a token that says what they stand for,
and asks which token a block was rendered with. Its output is a function of the calls and of the blocks between which
they were made, to the last bit: a live session and an offline render that make the same calls at the same sample clock
give the same samples.

Whatever changes does so without a click: an IR by a crossfade, a gain by a ramp, a removed emitter by a ramp of its
input to zero, after which its reverberation rings out. An added emitter begins at the first sample of its clip.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.errors import NafirError
from server.rendering.convolver import Convolver, FloatArray, PartitionedIr
from server.rendering.fade import raised_cosine


class UnknownEmitterError(NafirError):
    """No emitter of that id is present."""


class DuplicateEmitterError(NafirError):
    """An emitter of that id is present already."""


class RendererFullError(NafirError):
    """No room for one more emitter: the most allowed are present, or removed ones ring out in every spare slot."""


class ClipPlayer:
    """Plays mono samples (n,), n >= 1, block by block: once and then silence, or round and round without a gap."""

    def __init__(self, clip: FloatArray, *, loop: bool) -> None:
        if clip.ndim != 1 or clip.size == 0:
            raise ValueError(f"a clip is mono and not empty, got shape {clip.shape}")
        self._clip = clip
        self._loop = loop
        self._position = 0

    def process(self, out: FloatArray) -> None:
        """Fill `out` (b,) with the next samples."""
        written = 0
        while written < out.size:
            piece = self._clip[self._position : self._position + out.size - written]
            if piece.size == 0:  # only once, and over
                out[written:] = 0
                return
            out[written : written + piece.size] = piece
            written += piece.size
            self._position += piece.size
            if self._loop and self._position == self._clip.size:
                self._position = 0

    def reset(self) -> None:
        self._position = 0


@dataclass
class _Emitter:
    slot: int
    player: ClipPlayer
    gain: float
    next_gain: float
    token: int | None = None
    next_token: int | None = None
    has_ir: bool = False
    has_played: bool = False


class Renderer:
    """One listener, at most `max_emitters` emitters, `channels` output channels (0 is the left ear).

    One thread at a time may use it, except `prepare`, which any thread may call.
    """

    def __init__(self, *, block_size: int, ir_samples: int, channels: int = 2, max_emitters: int = 16) -> None:
        self.block_size = block_size
        self.ir_samples = ir_samples
        self.channels = channels
        self.max_emitters = max_emitters
        # As many slots again for removed emitters, which hold theirs until their reverberation has rung out.
        slots = 2 * max_emitters
        self._convolver = Convolver(sources=slots, channels=channels, block_size=block_size, ir_samples=ir_samples)
        self._input = np.zeros((slots, block_size), np.float32)
        self._fade_in = raised_cosine(block_size)
        self._emitters: dict[str, _Emitter] = {}
        self._leaving: list[_Emitter] = []  # ramp down in the next block
        self._ringing: list[int] = []  # slots of those gone since
        self._free_slots = list(range(slots))
        self._blocks_rendered = 0

    @property
    def sample_clock(self) -> int:
        """Clock of the first sample of the next block: samples rendered so far."""
        return self._blocks_rendered * self.block_size

    @property
    def emitter_ids(self) -> tuple[str, ...]:
        """Emitters present, in order of arrival."""
        return tuple(self._emitters)

    @property
    def exchanged(self) -> bool:
        """Whether an IR was exchanged in the block last rendered."""
        return bool(self._convolver.exchanged)

    def applied(self, emitter_id: str) -> int | None:
        """Token of the IR in effect at the end of the block last rendered; None before the first."""
        return self._emitter(emitter_id).token

    def prepare(self, ir: npt.NDArray[np.floating]) -> PartitionedIr:
        """Make an IR (channels, 1..ir_samples) ready for `set_ir`: most of its cost, on any thread.

        Raises ValueError for another shape or a sample that is not finite.
        """
        return self._convolver.prepare(ir)

    def add_emitter(self, emitter_id: str, clip: FloatArray, *, gain: float = 1.0, loop: bool = True) -> None:
        """Add an emitter that plays `clip` (n,), n >= 1, at the scene's rate, scaled by `gain` (linear amplitude).

        It is silent, its clip waiting at the first sample, until its first IR. Raises DuplicateEmitterError and
        RendererFullError.
        """
        if emitter_id in self._emitters:
            raise DuplicateEmitterError(f"emitter {emitter_id!r} is present already")
        if len(self._emitters) >= self.max_emitters:
            raise RendererFullError(f"at most {self.max_emitters} emitters")
        if not self._free_slots:
            raise RendererFullError("too many emitters removed just now still ring out")
        player = ClipPlayer(clip, loop=loop)
        slot = min(self._free_slots)
        self._free_slots.remove(slot)
        self._emitters[emitter_id] = _Emitter(slot, player, gain, gain)

    def remove_emitter(self, emitter_id: str) -> None:
        """Ramp an emitter down over the next block and let it ring out; its id is free at once.

        Raises UnknownEmitterError.
        """
        emitter = self._emitter(emitter_id)
        del self._emitters[emitter_id]
        if emitter.has_played:
            emitter.next_gain = 0.0
            self._leaving.append(emitter)
        else:
            self._release(emitter.slot)

    def set_gain(self, emitter_id: str, gain: float) -> None:
        """Reach a linear gain by the end of the next block. Raises UnknownEmitterError."""
        self._emitter(emitter_id).next_gain = gain

    def set_ir(self, emitter_id: str, ir: npt.NDArray[np.floating] | PartitionedIr, token: int | None = None) -> None:
        """Hand in an IR for the next block, which starts the emitter or, if it sounds already, crossfades to that IR.

        Of several handed in before it, the newest counts. Raises UnknownEmitterError, and ValueError as `prepare`.
        """
        emitter = self._emitter(emitter_id)
        self._convolver.set_ir(emitter.slot, ir)
        emitter.next_token = token
        emitter.has_ir = True

    def process(self) -> FloatArray:
        """Render the next block (channels, block_size), in an array of its own."""
        for emitter in (*self._emitters.values(), *self._leaving):
            self._play(emitter)
        output = self._convolver.process(self._input)
        self._blocks_rendered += 1
        for emitter in self._leaving:
            self._input[emitter.slot] = 0
            self._ringing.append(emitter.slot)
        self._leaving.clear()
        for slot in [slot for slot in self._ringing if self._convolver.is_quiet(slot)]:
            self._ringing.remove(slot)
            self._release(slot)
        return output

    def reset(self) -> None:
        """Drop every emitter and its reverberation, and start the clock again."""
        self._convolver.reset()
        self._input.fill(0)
        self._emitters.clear()
        self._leaving.clear()
        self._ringing.clear()
        self._free_slots = list(range(self._convolver.sources))
        self._blocks_rendered = 0

    def _emitter(self, emitter_id: str) -> _Emitter:
        try:
            return self._emitters[emitter_id]
        except KeyError:
            raise UnknownEmitterError(f"no emitter {emitter_id!r}") from None

    def _play(self, emitter: _Emitter) -> None:
        if not emitter.has_ir:
            return
        if not emitter.has_played:
            emitter.gain = emitter.next_gain
            emitter.has_played = True
        block = self._input[emitter.slot]
        emitter.player.process(block)
        if emitter.next_gain != emitter.gain:
            block *= emitter.gain + (emitter.next_gain - emitter.gain) * self._fade_in
            emitter.gain = emitter.next_gain
        elif emitter.gain != 1.0:
            block *= emitter.gain
        emitter.token = emitter.next_token

    def _release(self, slot: int) -> None:
        self._convolver.clear(slot)
        self._input[slot] = 0
        self._free_slots.append(slot)
