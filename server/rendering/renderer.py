"""What one listener hears of many emitters: each one's direct sound, which follows poses in every block, and what
follows it, convolved with impulse responses (IRs) that come at their own rate.

The renderer knows neither scenes nor fields. Whoever calls it hands in where sound comes from (`PathTarget`) and IRs
that begin after the direct sound, with a token that says what they stand for, and asks which token a block was rendered
with. Its output is a function of the calls and of the blocks between which they were made, to the last bit: a live
session and an offline render that make the same calls at the same sample clock give the same samples.

Whatever changes does so without a click: an IR by a crossfade, a path by Doppler and crossfades, a gain by a ramp, a
removed emitter by a ramp of its input to zero, after which its reverberation rings out. An added emitter begins at the
first sample of its source.

`render_all` renders many listeners in one call without the interpreter's lock.
"""

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import Quaternion
from server.errors import NafirError
from server.rendering.convolver import Convolver, FloatArray, PartitionedIr
from server.rendering.direct_path import DirectPath, PathTarget
from server.rendering.hrtf import KEMAR, HeadFilters, Hrtf
from server.rendering.mixing import Mixer, mix_all
from server.rendering.sources import ClipPlayer, Source
from server.rendering.still_paths import StillPaths


class UnknownEmitterError(NafirError):
    """No emitter of that id is present."""


class DuplicateEmitterError(NafirError):
    """An emitter of that id is present already."""


class RendererFullError(NafirError):
    """No room for one more emitter: the most allowed are present, or removed ones ring out in every spare slot."""


@dataclass
class _Emitter:
    slot: int
    source: Source
    token: int | None = None
    next_token: int | None = None
    has_ir: bool = False
    has_path: bool = False
    has_played: bool = False


class Renderer:
    """One listener, at most `max_emitters` emitters, both ears (0 is the left one).

    `filters` are the head that direct paths are heard through, at `sample_rate`; without them there are only IRs, which
    then carry the direct sound too. `air_db_per_m` (7,) is what air absorbs per octave band.

    One thread at a time may use it, except `prepare`, which any thread may call.
    """

    def __init__(
        self,
        *,
        block_size: int,
        ir_samples: int,
        sample_rate: int,
        filters: HeadFilters | None,
        speed_of_sound: float,
        air_db_per_m: npt.NDArray[np.floating],
        max_emitters: int = 16,
        shared_tail: bool = False,
        switches_tail: bool = False,
    ) -> None:
        self.block_size = block_size
        self.ir_samples = ir_samples
        self.max_emitters = max_emitters
        # As many slots again for removed emitters, which hold theirs until their reverberation has rung out.
        slots = 2 * max_emitters
        self._convolver = Convolver(
            sources=slots,
            channels=2,
            block_size=block_size,
            ir_samples=ir_samples,
            shared_tail=shared_tail,
            switches_tail=switches_tail,
        )
        self._direct = None
        if filters is not None:
            self._direct = DirectPath(
                slots=slots,
                block_size=block_size,
                sample_rate=sample_rate,
                filters=filters,
                speed_of_sound=speed_of_sound,
                air_db_per_m=air_db_per_m,
            )
        self._orientation: Quaternion | None = None
        self._mixer = Mixer(self._convolver, self._direct)
        self._emitters: dict[str, _Emitter] = {}
        self._changed: list[_Emitter] = []  # since the last block
        self._has_changed = False  # before the last block
        self._leaving: list[_Emitter] = []  # ramp down in the next block
        self._ringing: list[int] = []  # slots of those gone since
        self._free_slots = list(range(slots))
        self._blocks_rendered = 0

    @property
    def sample_clock(self) -> int:
        """Clock of the first sample of the next block: samples rendered so far."""
        return self._blocks_rendered * self.block_size

    @property
    def exchanged(self) -> bool:
        """Whether an IR was exchanged in the block last rendered."""
        return self._has_changed and bool(self._convolver.exchanged)

    def applied(self, emitter_id: str) -> int | None:
        """Token of the IR in effect, in its head, at the end of the block last rendered; None before the first."""
        return self._emitter(emitter_id).token

    def prepare(
        self, ir: npt.NDArray[np.floating], *, like: PartitionedIr | None = None, same_from: int = 0
    ) -> PartitionedIr:
        """Make an IR (2, 1..ir_samples) ready for `set_ir`: most of its cost, on any thread; less of it where the IR
        is, from sample `same_from` on, that of which `like` was made.

        Raises ValueError for another shape or a sample that is not finite.
        """
        return self._convolver.prepare(ir, like=like, same_from=same_from)

    @property
    def preparation(self) -> Hashable:
        """Renderers of which this is equal prepare IRs alike, and may share them."""
        return self._convolver.preparation

    def add_emitter(self, emitter_id: str, source: Source, *, gain: float = 1.0) -> None:
        """Add an emitter that plays `source`, scaled by `gain` (linear amplitude).

        It is silent, its source waiting, until it has an IR and, where direct paths are heard, a path. Raises
        DuplicateEmitterError and RendererFullError.
        """
        if emitter_id in self._emitters:
            raise DuplicateEmitterError(f"emitter {emitter_id!r} is present already")
        if len(self._emitters) >= self.max_emitters:
            raise RendererFullError(f"at most {self.max_emitters} emitters")
        if not self._free_slots:
            raise RendererFullError("too many emitters removed just now still ring out")
        slot = min(self._free_slots)
        self._free_slots.remove(slot)
        self._emitters[emitter_id] = _Emitter(slot, source)
        self._mixer.gain[:, slot] = gain
        self._mixer.send[:, slot] = 1.0

    def remove_emitter(self, emitter_id: str) -> None:
        """Ramp an emitter down over the next block and let it ring out; its id is free at once.

        Raises UnknownEmitterError.
        """
        emitter = self._emitter(emitter_id)
        del self._emitters[emitter_id]
        self._changed = [other for other in self._changed if other is not emitter]
        if emitter.has_played:
            self._mixer.gain[1, emitter.slot] = 0.0
            self._leaving.append(emitter)
        else:
            self._release(emitter.slot)

    def set_gain(self, emitter_id: str, gain: float) -> None:
        """Reach a linear gain by the end of the next block. Raises UnknownEmitterError."""
        self._reach(self._mixer.gain, emitter_id, gain)

    def set_reverberation_gain(self, emitter_id: str, gain: float) -> None:
        """Reach a linear gain of what is convolved, beside that of the emitter, by the end of the next block: an
        emitter that beams sends a room less than it sends ahead. Raises UnknownEmitterError."""
        self._reach(self._mixer.send, emitter_id, gain)

    def _reach(self, gains: FloatArray, emitter_id: str, gain: float) -> None:
        emitter = self._emitter(emitter_id)
        gains[1, emitter.slot] = gain
        if not emitter.has_played:
            gains[0, emitter.slot] = gain

    def set_ir(self, emitter_id: str, ir: npt.NDArray[np.floating] | PartitionedIr, token: int | None = None) -> None:
        """Hand in an IR for the next block, which starts the emitter or, if it sounds already, crossfades to that IR.

        Of several handed in before it, the newest counts. Raises UnknownEmitterError, and ValueError as `prepare`.
        """
        emitter = self._emitter(emitter_id)
        self._convolver.set_ir(emitter.slot, ir)
        emitter.next_token = token
        emitter.has_ir = True
        self._changed.append(emitter)

    def share_tail(self, is_shared: bool) -> None:
        """Have all emitters share one late tail, or none; only of a renderer that switches tails."""
        self._convolver.share_tail(is_shared)

    def set_path(self, emitter_id: str, target: PathTarget) -> None:
        """Have the direct sound come along a path from the next block on. Raises UnknownEmitterError."""
        gains_db = np.asarray(target.band_gain_db)
        self.set_paths(
            [emitter_id], np.array([target.length_m]), np.asarray(target.arrival)[np.newaxis], gains_db[np.newaxis]
        )

    def set_paths(
        self,
        emitter_ids: Sequence[str],
        lengths_m: npt.NDArray[np.floating],
        arrivals: npt.NDArray[np.floating],
        band_gains_db: npt.NDArray[np.floating],
    ) -> None:
        """`set_path` of several emitters at once: lengths (n,), unit vectors of arrival (n, 3), gains (n, band)."""
        emitters = [self._emitter(emitter_id) for emitter_id in emitter_ids]
        for emitter in emitters:
            if not emitter.has_path:
                emitter.has_path = True
                self._changed.append(emitter)
        if self._direct is not None:
            self._direct.set_targets([emitter.slot for emitter in emitters], lengths_m, arrivals, band_gains_db)

    def set_orientation(self, orientation: Quaternion) -> None:
        """Turn the listener's head: the direct sound follows with the next block."""
        if self._direct is not None and orientation != self._orientation:
            self._orientation = orientation
            self._direct.set_orientation(orientation)

    def process(self) -> FloatArray:
        """Render the next block (2, block_size), in an array of its own."""
        return render_all([self])[0]

    def reset(self) -> None:
        """Drop every emitter and its reverberation, and start the clock again."""
        for emitter in (*self._emitters.values(), *self._leaving):
            self._release(emitter.slot)
        self._convolver.reset()
        if self._direct is not None:
            self._direct.reset()
            self._orientation = None
        self._emitters.clear()
        self._changed.clear()
        self._leaving.clear()
        self._ringing.clear()
        self._free_slots = list(range(self._convolver.sources))
        self._blocks_rendered = 0

    def _begin(self) -> Mixer:
        """Put into effect what was handed in since the last block."""
        for emitter in self._changed:
            if emitter.has_ir and (emitter.has_path or self._direct is None):
                emitter.token = emitter.next_token
                if not emitter.has_played:
                    emitter.has_played = True
                    self._mixer.play(emitter.slot, emitter.source)
        self._has_changed = bool(self._changed)
        self._changed.clear()
        return self._mixer

    def _finish(self) -> FloatArray:
        """Let go of what has rung out; the block just mixed."""
        self._blocks_rendered += 1
        for emitter in self._leaving:
            self._mixer.stop(emitter.slot)
            self._ringing.append(emitter.slot)
        self._leaving.clear()
        for slot in [slot for slot in self._ringing if self._is_quiet(slot)]:
            self._ringing.remove(slot)
            self._release(slot)
        return self._mixer.output.copy()

    def _is_quiet(self, slot: int) -> bool:
        return self._convolver.is_quiet(slot) and (self._direct is None or self._direct.is_quiet(slot))

    def _emitter(self, emitter_id: str) -> _Emitter:
        try:
            return self._emitters[emitter_id]
        except KeyError:
            raise UnknownEmitterError(f"no emitter {emitter_id!r}") from None

    def _release(self, slot: int) -> None:
        self._convolver.clear(slot)
        if self._direct is not None:
            self._direct.clear(slot)
        self._mixer.stop(slot)
        self._free_slots.append(slot)


def render_all(renderers: Sequence[Renderer]) -> list[FloatArray]:
    """Render the next block (2, block_size) of each, all in one call without the interpreter's lock."""
    mix_all([renderer._begin() for renderer in renderers])
    return [renderer._finish() for renderer in renderers]


def warm_up(block_sizes: Iterable[int]) -> None:
    """Compile what renders, or load it from disk, and compute the constants of each block size: a renderer, or a
    response of paths at rest, made after this costs nothing more."""
    sample_rate = 24_000
    filters = HeadFilters.from_hrtf(Hrtf.read(KEMAR, sample_rate))
    flat, ahead = np.zeros(len(OCTAVE_BANDS_HZ)), np.array([(1.0, 0.0, 0.0)])
    still = StillPaths(filters, speed_of_sound=343.0, air_db_per_m=flat)
    still.add(np.ones(1), ahead, flat[None], (0.0, 0.0, 0.0, 1.0), np.zeros((2, 1), np.float32))
    for block_size in block_sizes:
        longest = 64 * block_size  # every stage
        renderer = Renderer(
            block_size=block_size,
            ir_samples=longest,
            sample_rate=sample_rate,
            filters=filters,
            speed_of_sound=343.0,
            air_db_per_m=flat,
            max_emitters=1,
        )
        renderer.add_emitter("", ClipPlayer(np.ones(1, np.float32), loop=True))
        renderer.set_ir("", np.ones((2, longest), np.float32))
        renderer.set_path("", PathTarget(1.0, (1.0, 0.0, 0.0), flat))
        renderer.process()
