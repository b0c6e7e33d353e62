"""The sound that one listener receives from many emitters: the direct sound of each, which follows poses in every
block, and the reflected sound, convolved with impulse responses (IRs) that arrive at their own rate.

The renderer knows neither scenes nor fields. Its caller passes the path of each direct sound (`PathTarget`) and IRs
that begin after the direct sound. Each IR comes with a token that identifies it, and the renderer reports which token
was used in a block. The output depends only on the calls and on the blocks between which they were made, to the last
bit: a live session and an offline render that make the same calls at the same sample clock give the same samples.

Every change is free of clicks: an IR changes by a crossfade, a path by Doppler shift and crossfades, a gain by a ramp.
A removed emitter's input is ramped to zero, after which its reverberation rings out. An added emitter begins at the
first sample of its source.

Instead of ears there may be ambisonic channels in world axes, to be turned where they are decoded. Then paths are
encoded with their directions, IRs have as many channels, and the listener's orientation changes nothing.

A head may also hear IRs that are ambisonic: they go to a bus (`server.rendering.bus`), which turns and decodes the sum
of all emitters. Then a turn of the head needs no other IRs.

Parts that are not needed do not exist. The convolver is made with the first IR and dropped when the last has rung out;
without a head, paths and IRs have one channel. When an emitter moves between hearing with and without a head, its input
fades from one mixer to the other, and what it played before rings out in the old one.

`render_all` renders many listeners in one call without the interpreter's lock.
"""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Quaternion
from server.acoustics.spherical_harmonics import harmonic_count
from server.core.errors import NafirError
from server.rendering.bus import Bus
from server.rendering.convolver import Convolver, FloatArray, PartitionedIr, Sharing
from server.rendering.direct_path import DirectPath, PathTarget
from server.rendering.head_decoder import HeadDecoder
from server.rendering.hrtf import HeadFilters
from server.rendering.ingest import require_gain
from server.rendering.mixer_set import MixerSet
from server.rendering.mixing import Mixer, is_read_by_compiled_code
from server.rendering.output import Output, Rendered, mix_all
from server.rendering.partitions import BLOCK_SIZES, is_block_size, is_power_of_two
from server.rendering.sources import FADE_SAMPLES, Source, is_over, stop_playback


class UnknownEmitterError(NafirError):
    """No emitter has this id."""


class DuplicateEmitterError(NafirError):
    """An emitter already has this id."""


class RendererFullError(NafirError):
    """There is no room for another emitter: the maximum is present, or removed ones are still ringing out in every
    spare slot."""


@dataclass(eq=False)
class _Emitter:
    mixer: Mixer
    slot: int
    source: Source
    awaits_ir: bool
    since: int | None = None
    """The sample clock at which the source began, if that was in an earlier renderer."""
    token: int | None = None
    next_token: int | None = None
    send: float = 1.0
    has_ir: bool = False
    """Whether it has an IR that is in use; an IR that was dropped may still ring out."""
    has_path: bool = False
    has_played: bool = False
    is_held: bool = False
    """Whether it does not begin yet, although it could."""

    @property
    def can_begin(self) -> bool:
        """Whether it has all that it needs to be heard, and is not held."""
        has_response = self.has_ir or not self.awaits_ir
        return not self.is_held and has_response and (self.has_path or self.mixer.direct is None)


class Renderer:
    """Renders one listener with at most `max_emitters` emitters and `outputs` channels: two ears (0 is the left one),
    or one; with an `order`, its ambisonic channels: ACN order, SN3D norm. `decoders` are those of the head by which it
    can hear IRs of as many channels as they have.

    `filters` are the head for direct paths, at `sample_rate`; without them there are only IRs, which must then include
    the direct sound. `air_db_per_m` is the absorption of air per octave band. With a `ceiling`, no sample of the
    output exceeds it (`server.rendering.limiter`). `has_head` says whether to begin with a head. Raises ValueError for
    a `block_size` that is not one of `BLOCK_SIZES`.

    Only one thread at a time may use it, except `prepare`, `early_samples` and `prepare_hearing`, which one other
    thread may call meanwhile.
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
        order: int | None = None,
        decoders: Sequence[HeadDecoder] = (),
    ) -> None:
        if not is_block_size(block_size):
            raise ValueError(f"block_size is {BLOCK_SIZES}, not {block_size}")
        self.block_size = block_size
        self.ir_samples = ir_samples
        self.max_emitters = max_emitters
        self.order = order
        """The order of ambisonic channels; None for ears."""
        self.outputs = outputs if order is None else harmonic_count(order)
        # The factories below refer to this and not to the renderer, which would be freed only by the collector.
        decoder_of = self._decoders = {harmonic_count(decoder.order): decoder for decoder in decoders}
        # Twice the number of emitters: a removed emitter keeps its slot until its reverberation has rung out.
        slots = 2 * max_emitters

        def direct_of(channels: int) -> DirectPath | None:
            if filters is None:
                return None
            return DirectPath(
                slots=slots,
                block_size=block_size,
                sample_rate=sample_rate,
                filters=filters if channels == 2 or channels in decoder_of else None,
                speed_of_sound=speed_of_sound,
                air_db_per_m=air_db_per_m,
                order=order,
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

        def bus_of(channels: int) -> Bus | None:
            decoder = decoder_of.get(channels)
            return None if decoder is None else Bus(decoder, block_size=block_size)

        self._mixers = MixerSet(
            slots=slots,
            block_size=block_size,
            hearings=(1, 2, *decoder_of) if order is None else (self.outputs,),
            new_direct=direct_of,
            new_convolver=convolver_of,
            new_bus=bus_of,
        )
        self._mixer = self._mixers.of(self.outputs if order is not None else 2 if has_head else 1)
        """The mixer for new emitters."""
        self._output = Output(channels=self.outputs, block_size=block_size, sample_rate=sample_rate, ceiling=ceiling)
        self._emitters: dict[str, _Emitter] = {}
        self._changed: list[_Emitter] = []  # since the last block
        self.exchanged = False
        """Whether an IR was exchanged in the last block."""
        self._blocks_rendered = 0

    @property
    def sample_clock(self) -> int:
        """Clock of the first sample of the next block: samples rendered so far."""
        return self._blocks_rendered * self.block_size

    @property
    def runs_by_itself(self) -> bool:
        """Whether several blocks may be rendered in one call, because nothing has to be done between them."""
        return (
            self._mixers.rests
            and all(mixer.is_compiled and mixer.plays_by_itself for mixer in self._mixers)
            and all(emitter.has_played or is_read_by_compiled_code(emitter.source) for emitter in self._changed)
        )

    @property
    def samples_silenced(self) -> int:
        """How many output samples so far were not finite and were replaced by silence; it should always be 0."""
        limiter = self._output.limiter
        return 0 if limiter is None else limiter.samples_silenced

    @property
    def convolvers(self) -> int:
        """How many convolvers exist: one while IRs are in use, and two for a while after switching between hearing with
        and without a head."""
        return sum(mixer.convolver is not None for mixer in self._mixers)

    @property
    def channels(self) -> int:
        """The number of channels of IRs for new emitters: 2 for a head, 1 for a single ear without one, or those of a
        bus or of ambisonics."""
        return self._mixer.channels

    def applied(self, emitter_id: str) -> int | None:
        """The token of the IR that the head of the convolver used at the end of the last block; None before the
        first."""
        return self._emitter(emitter_id).token

    def prepare(
        self, ir: npt.NDArray[np.floating], *, like: PartitionedIr | None = None, same_from: int = 0
    ) -> PartitionedIr:
        """Prepare an IR (1 or 2 or all ambisonic channels, 1..ir_samples) for `set_ir`. This is most of its cost, and
        any thread may do it. It costs less if the IR equals, from sample `same_from` on, the IR from which `like` was
        made. One channel is for hearing without a head. An IR for a bus is advanced by as much as its decoder is late.

        Raises ValueError for another shape or a sample that is not finite.
        """
        decoder = self._decoders.get(len(ir)) if ir.ndim == 2 else None
        if decoder is not None and ir.shape[1] > 0:
            ir = ir[:, min(decoder.delay, ir.shape[1] - 1) :]
            same_from = max(0, same_from - decoder.delay)
        return self._mixers.prepare(ir, like=like, same_from=same_from)

    def early_samples(self, channels: int) -> int:
        """The samples of an IR of so many channels that emitters never share. The rest of an IR may be kept when they
        are exchanged: prepare them with the whole IR as `like`, and this as `same_from`."""
        decoder = self._decoders.get(channels)
        return self._mixers.preparer(channels).early_samples + (0 if decoder is None else decoder.delay)

    @property
    def preparation(self) -> Hashable:
        """A key that is equal for renderers which prepare IRs of two ears in the same way and may share them."""
        return self._mixers.preparer(2).preparation

    def prepare_hearing(self, channels: int) -> None:
        """Prepare for `set_channels`, on any thread."""
        self._mixers.prepare_hearing(channels)

    def set_channels(self, channels: int) -> None:
        """Switch to hearing with a head (2 channels), without one (1) or by a bus, for new emitters and those without
        IRs. An emitter that has an IR follows with its first IR of this number of channels."""
        self._mixer = self._mixers.of(channels)
        for emitter in self._emitters.values():
            if not emitter.has_ir and emitter.mixer is not self._mixer:
                self._hand_over(emitter, self._mixer)

    def can_set_channels(self, channels: int) -> bool:
        """Whether there is room for all emitters to be heard with this number of channels: earlier sound in that mixer
        has rung out."""
        return channels == self._mixer.channels or self._mixers.is_free(channels)

    def skip_to(self, sample_clock: int) -> None:
        """Set the clock of a renderer that has rendered nothing yet, to a whole number of blocks."""
        self._blocks_rendered = sample_clock // self.block_size

    def add_emitter(
        self,
        emitter_id: str,
        source: Source,
        *,
        gain: float = 1.0,
        awaits_ir: bool = True,
        since: int | None = None,
    ) -> None:
        """Add an emitter that plays `source`, scaled by `gain` (linear amplitude, within `LOUDEST_GAIN`).

        With `awaits_ir` it is silent and its source waits until it has an IR; where direct paths are rendered, it also
        waits for a path. A source that began at an earlier clock, `since`, does not begin anew: it fades in over a
        block, where it would be by then. Raises DuplicateEmitterError, RendererFullError, and ValueError for a gain
        that would overflow.
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
        self._emitters[emitter_id] = _Emitter(self._mixer, slot, source, awaits_ir, since)
        # guard: an emitter begins at its gain
        self._mixer.set_gain(slot, gain)
        self._mixer.send[:, slot] = 1.0

    def hold(self, emitter_id: str) -> None:
        """Let an emitter not begin before `release`, even if it could. Raises UnknownEmitterError."""
        self._emitter(emitter_id).is_held = True

    def release(self, emitter_id: str, since: int | None = None) -> None:
        """Let an emitter begin as soon as it can: from the beginning, or fading in where it would be if it had begun at
        the clock `since`. Raises UnknownEmitterError."""
        emitter = self._emitter(emitter_id)
        emitter.is_held, emitter.since = False, since
        self._changed.append(emitter)

    def has_begun(self, emitter_id: str) -> bool:
        """Whether an emitter plays. Raises UnknownEmitterError."""
        return self._emitter(emitter_id).has_played

    def take_gain(self, emitter_id: str, other: "Renderer") -> None:
        """Have the gain of an emitter that has not begun be that of the same emitter of another renderer, in the middle
        of a ramp, too. Raises UnknownEmitterError."""
        emitter, theirs = self._emitter(emitter_id), other._emitter(emitter_id)
        emitter.mixer.gain[:, emitter.slot] = theirs.mixer.gain[1, theirs.slot]
        emitter.mixer.ramp[emitter.slot] = theirs.mixer.ramp[theirs.slot]

    def remove_emitter(self, emitter_id: str) -> None:
        """Ramp an emitter down over the next block and let it ring out; its id is free at once.

        Raises UnknownEmitterError.
        """
        emitter = self._emitter(emitter_id)
        del self._emitters[emitter_id]
        self._changed = [other for other in self._changed if other is not emitter]
        self._mixers.leave(emitter.mixer, emitter.slot, has_played=emitter.has_played)

    def set_gain(self, emitter_id: str, gain: float, *, ramp: int = 0) -> None:
        """Set a linear gain, reached by the end of the next block or, linearly in decibels, over the next `ramp`
        samples. An emitter that has not begun to play has it at once.

        Raises UnknownEmitterError, and ValueError for a gain that would overflow, or a ramp from or to silence.
        """
        emitter = self._emitter(emitter_id)
        mixer, slot = emitter.mixer, emitter.slot
        # guard: no gain is set that would overflow
        require_gain(gain)
        if ramp > 0 and min(gain, mixer.gain[1, slot]) <= 0:
            raise ValueError("a ramp in decibels has a gain above 0 at either end")
        if not emitter.has_played:
            mixer.set_gain(slot, gain)
        elif ramp > 0:
            mixer.ramp_gain(slot, gain, ramp)
        else:
            mixer.reach_gain(slot, gain)

    def stop_emitter(self, emitter_id: str, clock: int, *, fade: int = FADE_SAMPLES) -> None:
        """Fade an emitter's clip out over `fade` samples from `clock` on, or from the next block if that is later; if
        the clip has not begun by then, it is never heard. The newest call counts until the fade begins. Raises
        UnknownEmitterError, and ValueError for a source that is no clip."""
        emitter = self._emitter(emitter_id)
        if not is_read_by_compiled_code(emitter.source):
            raise ValueError(f"emitter {emitter_id!r} plays no clip")
        if emitter.has_played:
            record = emitter.mixer.playback_of(emitter.slot, emitter.source)
            stop_playback(record, stops_in=clock - self.sample_clock, fade=fade)
        else:
            emitter.source.stop(clock, fade)

    def has_ended(self, emitter_id: str) -> bool:
        """Whether an emitter's clip is over and has rung out. Raises UnknownEmitterError."""
        emitter = self._emitter(emitter_id)
        if not (emitter.has_played and is_read_by_compiled_code(emitter.source)):
            return False
        mixer, slot = emitter.mixer, emitter.slot
        return is_over(mixer.playback_of(slot, emitter.source)) and mixer.is_quiet(slot)

    def set_reverberation_gain(self, emitter_id: str, gain: float) -> None:
        """Set an additional linear gain for the convolved sound only, reached by the end of the next block: a
        directional emitter sends less into the room than ahead. Raises UnknownEmitterError."""
        emitter = self._emitter(emitter_id)
        emitter.send = gain
        if emitter.has_ir or not emitter.has_played:
            sends = emitter.mixer.send
            sends[1, emitter.slot] = require_gain(gain)
            if not emitter.has_played:
                sends[0, emitter.slot] = gain

    def set_ir(self, emitter_id: str, ir: npt.NDArray[np.floating] | PartitionedIr, token: int | None = None) -> None:
        """Set the IR from the next block on. This starts the emitter or, if it is already playing, crossfades to the
        new IR.

        If several are set before the same block, the newest counts. An IR with a different number of channels moves the
        emitter to the mixer with that number. Raises UnknownEmitterError, and ValueError as `prepare`.
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
        """Stop sending an emitter to its IR, which rings out; its direct sound continues. Raises
        UnknownEmitterError."""
        emitter = self._emitter(emitter_id)
        emitter.awaits_ir = False
        if emitter.has_ir:
            emitter.has_ir = False
            self._mixers.hush(emitter.mixer, emitter.slot)
        self._changed.append(emitter)

    def share(self, sharing: Sharing) -> None:
        """Make all emitters share as much of their responses as `sharing` says. Only for a renderer that switches
        tails."""
        self._mixers.share(sharing)

    def set_path(self, emitter_id: str, target: PathTarget) -> None:
        """Set the path of an emitter's direct sound from the next block on. Raises UnknownEmitterError."""
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
        """Call `set_path` for several emitters at once: lengths (n,), unit vectors of arrival (n, 3), gains (n,
        band)."""
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
        """Set whether an emitter's direct sound is rendered along its path, and whether distance and air attenuate it.
        The change fades over the next block. Raises UnknownEmitterError."""
        emitter = self._emitter(emitter_id)
        if emitter.mixer.direct is not None:
            emitter.mixer.direct.set_muted(emitter.slot, not is_heard)
            emitter.mixer.direct.set_losses(emitter.slot, distance=distance, air=air)

    def set_orientation(self, orientation: Quaternion) -> None:
        """Turn the listener's head from the next block on."""
        self._mixers.set_orientation(orientation)

    def process(self) -> FloatArray:
        """Render the next block (channel, block_size) into a new array."""
        return render_all([self])[0].samples

    def reset(self) -> None:
        """Drop all emitters and their reverberation, and reset the clock to 0."""
        # guard: a reset forgets what sounded
        self._mixers.clear()
        if self._output.limiter is not None:
            self._output.limiter.reset()
        self._mixer = self._mixers.of(self._mixer.channels)
        self._emitters.clear()
        self._changed.clear()
        self._blocks_rendered = 0

    def _begin(self) -> tuple[Output, list[Mixer]]:
        """Apply the changes that were requested since the last block."""
        for emitter in self._changed:
            if emitter.can_begin:
                emitter.token = emitter.next_token
                if not emitter.has_played:
                    emitter.has_played = True
                    self._start(emitter)
                    emitter.mixer.play(emitter.slot, emitter.source)
        self._changed.clear()
        return self._output, list(self._mixers)

    def _start(self, emitter: _Emitter) -> None:
        """Tell a source the clock at which it begins, or has begun."""
        since = self.sample_clock if emitter.since is None else emitter.since
        if is_read_by_compiled_code(emitter.source):
            emitter.source.begin(since)
        if emitter.since is not None:
            emitter.source.skip(max(0, self.sample_clock - since))
            emitter.mixer.gain[0, emitter.slot] = 0.0

    def _finish(self, blocks: Sequence[Rendered]) -> None:
        """Free everything that has rung out."""
        self._blocks_rendered += len(blocks)
        self.exchanged = any(block.is_exchange for block in blocks)
        if self._mixers.rests:
            return
        emitters = self._emitters.values()
        sending = {emitter.mixer for emitter in emitters if emitter.has_ir or emitter.awaits_ir}
        self._mixers.let_go({self._mixer, *(emitter.mixer for emitter in emitters)}, sending)

    def _hand_over(self, emitter: _Emitter, mixer: Mixer) -> None:
        """Move an emitter to another mixer: over the next block its sound fades out of the one and into the other."""
        slot = mixer.take_slot()
        if slot is None:
            raise RendererFullError("too many emitters heard this way before still ring out")
        before, from_slot = emitter.mixer, emitter.slot
        mixer.gain[:, slot], mixer.ramp[slot] = before.gain[1, from_slot], before.ramp[from_slot]
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
    """Render the next block of each renderer, all in one call without the interpreter's lock. A renderer that
    `runs_by_itself` may be listed several times in a row, and then renders that many blocks: the later ones find much
    of their data in the caches."""
    runs = [(renderer, sum(1 for _ in same)) for renderer, same in groupby(renderers)]
    made = mix_all([(*renderer._begin(), count) for renderer, count in runs])
    for (renderer, _), blocks in zip(runs, made, strict=True):
        renderer._finish(blocks)
    return [block for blocks in made for block in blocks]
