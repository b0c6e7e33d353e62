"""What one listener hears of many emitters: each one's direct sound, which follows poses in every block, and what
follows it, convolved with impulse responses (IRs) that come at their own rate.

The renderer knows neither scenes nor fields. Whoever calls it hands in where sound comes from (`PathTarget`) and IRs
that begin after the direct sound, with a token that says what they stand for, and asks which token a block was rendered
with. Its output is a function of the calls and of the blocks between which they were made, to the last bit: a live
session and an offline render that make the same calls at the same sample clock give the same samples.

Whatever changes does so without a click: an IR by a crossfade, a path by Doppler and crossfades, a gain by a ramp, a
removed emitter by a ramp of its input to zero, after which its reverberation rings out. An added emitter begins at the
first sample of its source.

What nobody asked for is not there. The convolver comes with the first IR and goes when the last has rung out; without a
head, paths and IRs have one channel. Heard with a head and without one, an emitter fades from one to the other at the
input: what it played before rings out the way it was heard.

`render_all` renders many listeners in one call without the interpreter's lock.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Quaternion
from server.core.errors import NafirError
from server.rendering.convolver import Convolver, FloatArray, PartitionedIr
from server.rendering.direct_path import DirectPath, PathTarget
from server.rendering.hrtf import HeadFilters
from server.rendering.ingest import require_gain
from server.rendering.mixer_set import MixerSet
from server.rendering.mixing import Mixer, is_read_by_compiled_code
from server.rendering.output import Output, Rendered, mix_all
from server.rendering.partitions import BLOCK_SIZES, is_block_size, is_power_of_two
from server.rendering.sources import Source


class UnknownEmitterError(NafirError):
    """No emitter of that id is present."""


class DuplicateEmitterError(NafirError):
    """An emitter of that id is present already."""


class RendererFullError(NafirError):
    """No room for one more emitter: the most allowed are present, or removed ones ring out in every spare slot."""


@dataclass
class _Emitter:
    mixer: Mixer
    slot: int
    source: Source
    awaits_ir: bool
    token: int | None = None
    next_token: int | None = None
    send: float = 1.0
    has_ir: bool = False
    """Whether it has one that is to be heard; one that is not may still ring out."""
    has_path: bool = False
    has_played: bool = False


class Renderer:
    """One listener, at most `max_emitters` emitters, `outputs` channels: two ears (0 is the left one), or one.

    `filters` are the head that direct paths are heard through, at `sample_rate`; without them there are only IRs, which
    then carry the direct sound too. `air_db_per_m` (7,) is what air absorbs per octave band. With a `ceiling` no sample
    of the output is beyond it (`server.rendering.limiter`). `has_head` says whether to begin with a head. Raises
    ValueError for a `block_size` that is none of `BLOCK_SIZES`.

    One thread at a time may use it, except `prepare` and `prepare_hearing`, which one other thread may call meanwhile.
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
        ceiling: float | None = None,
        outputs: int = 2,
        has_head: bool = True,
    ) -> None:
        if not is_block_size(block_size):
            raise ValueError(f"block_size is {BLOCK_SIZES}, not {block_size}")
        self.block_size = block_size
        self.ir_samples = ir_samples
        self.max_emitters = max_emitters
        self.outputs = outputs
        # As many slots again for removed emitters, which hold theirs until their reverberation has rung out.
        slots = 2 * max_emitters

        def direct_of(channels: int) -> DirectPath | None:
            if filters is None:
                return None
            return DirectPath(
                slots=slots,
                block_size=block_size,
                sample_rate=sample_rate,
                filters=filters if channels == 2 else None,
                speed_of_sound=speed_of_sound,
                air_db_per_m=air_db_per_m,
            )

        def convolver_of(channels: int) -> Convolver:
            return Convolver(
                sources=slots,
                channels=channels,
                block_size=block_size,
                ir_samples=ir_samples,
                shared_tail=shared_tail,
                switches_tail=switches_tail,
                any_size=not is_power_of_two(block_size),
            )

        self._mixers = MixerSet(slots=slots, block_size=block_size, new_direct=direct_of, new_convolver=convolver_of)
        self._mixer = self._mixers.of(2 if has_head else 1)
        """What new emitters are heard through."""
        self._output = Output(channels=outputs, block_size=block_size, sample_rate=sample_rate, ceiling=ceiling)
        self._emitters: dict[str, _Emitter] = {}
        self._changed: list[_Emitter] = []  # since the last block
        self.exchanged = False
        """Whether an IR was exchanged in the block last rendered."""
        self._blocks_rendered = 0

    @property
    def sample_clock(self) -> int:
        """Clock of the first sample of the next block: samples rendered so far."""
        return self._blocks_rendered * self.block_size

    @property
    def runs_by_itself(self) -> bool:
        """Whether several blocks may be rendered in one call: nothing has to be looked after between them."""
        return (
            self._mixers.rests
            and all(mixer.is_compiled and mixer.plays_by_itself for mixer in self._mixers)
            and all(emitter.has_played or is_read_by_compiled_code(emitter.source) for emitter in self._changed)
        )

    @property
    def samples_silenced(self) -> int:
        """Rendered so far that were not finite, which none should be; they were made silence."""
        limiter = self._output.limiter
        return 0 if limiter is None else limiter.samples_silenced

    @property
    def convolvers(self) -> int:
        """How many there are: one where IRs are heard, for a while two where a head was put on or taken off."""
        return sum(mixer.convolver is not None for mixer in self._mixers)

    @property
    def channels(self) -> int:
        """What new emitters are heard with: two ears of a head, or one without."""
        return self._mixer.channels

    def applied(self, emitter_id: str) -> int | None:
        """Token of the IR in effect, in its head, at the end of the block last rendered; None before the first."""
        return self._emitter(emitter_id).token

    def prepare(
        self, ir: npt.NDArray[np.floating], *, like: PartitionedIr | None = None, same_from: int = 0
    ) -> PartitionedIr:
        """Make an IR (1 or 2, 1..ir_samples) ready for `set_ir`: most of its cost, on any thread; less of it where the
        IR is, from sample `same_from` on, that of which `like` was made. One channel is for ears without a head.

        Raises ValueError for another shape or a sample that is not finite.
        """
        return self._mixers.prepare(ir, like=like, same_from=same_from)

    @property
    def preparation(self) -> Hashable:
        """Renderers of which this is equal prepare IRs of two channels alike, and may share them."""
        return self._mixers.preparer(2).preparation

    def prepare_hearing(self, channels: int) -> None:
        """Make ready for `set_channels`, on any thread."""
        self._mixers.prepare_hearing(channels)

    def set_channels(self, channels: int) -> None:
        """Have emitters without IRs, and those to come, be heard by two ears of a head, or by one of none. Those that
        have an IR follow with the first one of so many channels."""
        self._mixer = self._mixers.of(channels)
        for emitter in self._emitters.values():
            if not emitter.has_ir and emitter.mixer is not self._mixer:
                self._hand_over(emitter, self._mixer)

    def can_hear_with(self, channels: int) -> bool:
        """Whether there is room for every emitter to be heard so: what was heard that way before has rung out."""
        return channels == self._mixer.channels or self._mixers.is_free(channels)

    def add_emitter(self, emitter_id: str, source: Source, *, gain: float = 1.0, awaits_ir: bool = True) -> None:
        """Add an emitter that plays `source`, scaled by `gain` (linear amplitude, within `LOUDEST_GAIN`).

        It is silent, its source waiting, until it has an IR, if it `awaits_ir`, and, where direct paths are heard, a
        path. Raises DuplicateEmitterError, RendererFullError, and ValueError for a gain that would overflow.
        """
        # guard: a refused gain leaves no emitter behind
        require_gain(gain)
        # guard: two emitters have not one id
        if emitter_id in self._emitters:
            raise DuplicateEmitterError(f"emitter {emitter_id!r} is present already")
        # guard: a renderer has room for so many
        if len(self._emitters) >= self.max_emitters:
            raise RendererFullError(f"at most {self.max_emitters} emitters")
        slot = self._mixer.take_slot()
        if slot is None:
            raise RendererFullError("too many emitters removed just now still ring out")
        self._emitters[emitter_id] = _Emitter(self._mixer, slot, source, awaits_ir)
        # guard: an emitter begins at its gain
        self._mixer.gain[:, slot] = gain
        self._mixer.send[:, slot] = 1.0

    def remove_emitter(self, emitter_id: str) -> None:
        """Ramp an emitter down over the next block and let it ring out; its id is free at once.

        Raises UnknownEmitterError.
        """
        emitter = self._emitter(emitter_id)
        del self._emitters[emitter_id]
        self._changed = [other for other in self._changed if other is not emitter]
        self._mixers.leave(emitter.mixer, emitter.slot, has_played=emitter.has_played)

    def set_gain(self, emitter_id: str, gain: float) -> None:
        """Reach a linear gain by the end of the next block. Raises UnknownEmitterError, and ValueError for a gain that
        would overflow."""
        emitter = self._emitter(emitter_id)
        self._reach(emitter.mixer.gain, emitter, gain)

    def set_reverberation_gain(self, emitter_id: str, gain: float) -> None:
        """Reach a linear gain of what is convolved, beside that of the emitter, by the end of the next block: an
        emitter that beams sends a room less than it sends ahead. Raises UnknownEmitterError."""
        emitter = self._emitter(emitter_id)
        emitter.send = gain
        if emitter.has_ir or not emitter.has_played:
            self._reach(emitter.mixer.send, emitter, gain)

    def _reach(self, gains: FloatArray, emitter: _Emitter, gain: float) -> None:
        # guard: no gain is set that would overflow
        gains[1, emitter.slot] = require_gain(gain)
        if not emitter.has_played:
            gains[0, emitter.slot] = gain

    def set_ir(self, emitter_id: str, ir: npt.NDArray[np.floating] | PartitionedIr, token: int | None = None) -> None:
        """Hand in an IR for the next block, which starts the emitter or, if it sounds already, crossfades to that IR.

        Of several handed in before it, the newest counts. One with other channels than the emitter is heard by has it
        heard by those. Raises UnknownEmitterError, and ValueError as `prepare`.
        """
        emitter = self._emitter(emitter_id)
        prepared = ir if isinstance(ir, PartitionedIr) else self.prepare(ir)
        mixer = self._mixers.of(prepared.channels)
        if emitter.mixer is not mixer:
            self._hand_over(emitter, mixer)
        self._mixers.convolver_of(mixer).set_ir(emitter.slot, prepared)
        if not emitter.has_ir:
            emitter.has_ir = True
            self._mixers.resume(mixer, emitter.slot, emitter.send, has_played=emitter.has_played)
        emitter.next_token = token
        self._changed.append(emitter)

    def drop_ir(self, emitter_id: str) -> None:
        """Send an emitter to its IR no more, which rings out; it goes on without. Raises UnknownEmitterError."""
        emitter = self._emitter(emitter_id)
        emitter.awaits_ir = False
        if emitter.has_ir:
            emitter.has_ir = False
            self._mixers.hush(emitter.mixer, emitter.slot)
        self._changed.append(emitter)

    def share_tail(self, is_shared: bool) -> None:
        """Have all emitters share one late tail, or none; only of a renderer that switches tails."""
        self._mixers.share_tail(is_shared)

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
        for mixer in self._mixers:
            if mixer.direct is None:
                continue
            slots = [emitter.slot for emitter in emitters if emitter.mixer is mixer]
            if len(slots) == len(emitters):
                mixer.direct.set_targets(slots, lengths_m, arrivals, band_gains_db)
            elif slots:
                rows = [number for number, emitter in enumerate(emitters) if emitter.mixer is mixer]
                mixer.direct.set_targets(slots, lengths_m[rows], arrivals[rows], band_gains_db[rows])

    def enable_direct(self, emitter_id: str, *, is_heard: bool = True, distance: bool = True, air: bool = True) -> None:
        """Whether an emitter's direct sound is heard by itself, and loses anything with distance and to the air; fades
        over the next block. Raises UnknownEmitterError."""
        emitter = self._emitter(emitter_id)
        if emitter.mixer.direct is not None:
            emitter.mixer.direct.set_muted(emitter.slot, not is_heard)
            emitter.mixer.direct.set_losses(emitter.slot, distance=distance, air=air)

    def set_orientation(self, orientation: Quaternion) -> None:
        """Turn the listener's head: the direct sound follows with the next block."""
        self._mixers.set_orientation(orientation)

    def process(self) -> FloatArray:
        """Render the next block (channel, block_size), in an array of its own."""
        return render_all([self])[0].samples

    def reset(self) -> None:
        """Drop every emitter and its reverberation, and start the clock again."""
        # guard: a reset forgets what sounded
        self._mixers.clear()
        if self._output.limiter is not None:
            self._output.limiter.reset()
        self._mixer = self._mixers.of(self._mixer.channels)
        self._emitters.clear()
        self._changed.clear()
        self._blocks_rendered = 0

    def _begin(self) -> tuple[Output, list[Mixer]]:
        """Put into effect what was handed in since the last block."""
        for emitter in self._changed:
            has_response = emitter.has_ir or not emitter.awaits_ir
            if has_response and (emitter.has_path or emitter.mixer.direct is None):
                emitter.token = emitter.next_token
                if not emitter.has_played:
                    emitter.has_played = True
                    emitter.mixer.play(emitter.slot, emitter.source)
        self._changed.clear()
        return self._output, list(self._mixers)

    def _finish(self, blocks: Sequence[Rendered]) -> None:
        """Let go of what has rung out."""
        self._blocks_rendered += len(blocks)
        self.exchanged = any(block.is_exchange for block in blocks)
        if self._mixers.rests:
            return
        emitters = self._emitters.values()
        sending = {emitter.mixer for emitter in emitters if emitter.has_ir or emitter.awaits_ir}
        self._mixers.let_go({self._mixer, *(emitter.mixer for emitter in emitters)}, sending)

    def _hand_over(self, emitter: _Emitter, mixer: Mixer) -> None:
        """Have an emitter be heard through another mixer: over the next block its sound fades out of the one and into
        the other."""
        slot = mixer.take_slot()
        if slot is None:
            raise RendererFullError("too many emitters heard this way before still ring out")
        before, from_slot = emitter.mixer, emitter.slot
        mixer.gain[:, slot] = before.gain[1, from_slot]
        mixer.send[:, slot] = emitter.send
        if mixer.direct is not None and before.direct is not None:
            mixer.direct.copy_slot(slot, before.direct, from_slot)
        if emitter.has_played:
            mixer.gain[0, slot] = 0.0
            mixer.take_over(slot, before, from_slot)
        self._mixers.leave(before, from_slot, has_played=emitter.has_played)
        emitter.mixer, emitter.slot = mixer, slot

    def _emitter(self, emitter_id: str) -> _Emitter:
        try:
            return self._emitters[emitter_id]
        except KeyError:
            raise UnknownEmitterError(f"no emitter {emitter_id!r}") from None


def render_all(renderers: Sequence[Renderer]) -> list[Rendered]:
    """Render the next block of each, all in one call without the interpreter's lock. One that `runs_by_itself` may
    stand there several times, in a row, and gets as many blocks: of all that they read, those after the first find much
    in the caches."""
    runs = [(renderer, sum(1 for _ in same)) for renderer, same in groupby(renderers)]
    made = mix_all([(*renderer._begin(), count) for renderer, count in runs])
    for (renderer, _), blocks in zip(runs, made, strict=True):
        renderer._finish(blocks)
    return [block for blocks in made for block in blocks]
