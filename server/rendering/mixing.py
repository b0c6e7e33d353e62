"""One listener's sound with a given number of channels: gains, direct paths and convolution. Compiled code
(`server.rendering.mixing_kernel`) mixes it, or this module for block sizes that compiled code does not support.

Each emitter has a slot, which is a row of `dry` (slot, block). Its samples are scaled by its gain for the direct path,
and by gain and send for the convolver. Both reach their wanted values by the end of a block, along a raised cosine. A
gain may also follow a ramp, linear in decibels: then it is multiplied by a factor that ends as 1.

A mixer has a convolver only while something is sent to it, and otherwise costs nothing for it. Where there is a bus,
the convolver's channels are decoded by it to the two ears of the direct paths.
"""

from typing import TypeGuard

import numpy as np

from server.acoustics.geometry import Quaternion
from server.kernels.by_reference import Reference
from server.rendering.bus import Bus
from server.rendering.convolver import Convolver, FloatArray
from server.rendering.direct_path import DirectPath
from server.rendering.fade import raised_cosine
from server.rendering.mixing_kernel import RAMP, enter_convolver, record_of
from server.rendering.partitions import is_power_of_two
from server.rendering.sources import PLAYBACK, ClipPlayer, Source


def is_read_by_compiled_code(source: Source) -> TypeGuard[ClipPlayer]:
    """Whether compiled code can read the source; for others, Python must fetch each block."""
    return isinstance(source, ClipPlayer)


class Mixer:
    """Mixes the sound of its slots. `channels` are those of responses, and of the output too unless there is a `bus`.
    `gain` and `send` (2, slot): the values in effect, and the wanted values. A slot
    that does not play adds nothing new. `is_compiled` says whether compiled code does the mixing; it requires blocks of
    a power of two."""

    def __init__(
        self, *, channels: int, slots: int, block_size: int, direct: DirectPath | None, bus: Bus | None = None
    ) -> None:
        self.is_compiled = is_power_of_two(block_size)
        self.channels = channels
        self.slots = slots
        self.direct = direct
        self.bus = bus
        self.convolver: Convolver | None = None
        self.free_slots = list(range(slots))
        self.dry = np.zeros((slots, block_size), np.float32)
        self.gain = np.zeros((2, slots), np.float32)
        self.send = np.zeros((2, slots), np.float32)
        self.ramp = np.zeros(slots, RAMP)
        self.plays = np.zeros(slots, np.int64)
        self.playback = np.zeros(slots, PLAYBACK)
        self._sources: dict[int, Source] = {}
        self._clips: dict[int, FloatArray] = {}
        self._followed: dict[int, FloatArray] = {}
        self.output = np.zeros((channels if bus is None else 2, block_size), np.float32)
        self.fade_in = raised_cosine(block_size)
        if self.is_compiled:
            self.direct_state = Reference(direct.state) if direct is not None else None
            self.record = record_of(self)
            self.address = int(self.record.ctypes.data)

    def connect(self, convolver: Convolver | None) -> None:
        """Send to a convolver with the same numbers of sources and channels from the next block on, or to none."""
        self.convolver = convolver
        if self.is_compiled:
            enter_convolver(self.record, None if convolver is None else convolver.compiled)

    def set_orientation(self, orientation: Quaternion) -> None:
        """Turn the head of direct paths and bus."""
        if self.direct is not None:
            self.direct.set_orientation(orientation)
        if self.bus is not None:
            self.bus.set_orientation(orientation)

    def take_slot(self) -> int | None:
        """Reserve a slot that has rung out; None if there is none."""
        if not self.free_slots:
            return None
        slot = min(self.free_slots)
        self.free_slots.remove(slot)
        return slot

    def release(self, slot: int) -> None:
        """Free a slot: forget what it played and everything that was sent from it."""
        self.stop(slot)
        if self.convolver is not None:
            self.convolver.clear(slot)
        if self.direct is not None:
            self.direct.clear(slot)
        self.free_slots.append(slot)

    def is_quiet(self, slot: int) -> bool:
        """Whether a slot has rung out."""
        return (self.convolver is None or self.convolver.is_quiet(slot)) and (
            self.direct is None or self.direct.is_quiet(slot)
        )

    def has_no_response(self, slot: int) -> bool:
        """Whether nothing is sent from a slot to the convolver, and everything sent earlier has rung out."""
        return self.convolver is None or (not self.send[:, slot].any() and self.convolver.is_quiet(slot))

    def play(self, slot: int, source: Source) -> None:
        """Play a source in a slot from the next block on. Compiled code reads clips itself."""
        self.plays[slot] = 1
        if self.is_compiled and is_read_by_compiled_code(source):
            self.playback[slot] = source.playback
            self._clips[slot] = source.clip  # kept alive as long as it is played
        else:
            self._sources[slot] = source

    def take_over(self, slot: int, other: "Mixer", from_slot: int) -> None:
        """Play the source of another mixer's slot, from the same sample on. The other slot gets one more block of it,
        to fade out."""
        self.plays[slot] = 1
        if from_slot in other._clips:
            self.playback[slot] = other.playback[from_slot]
            self._clips[slot] = other._clips[from_slot]
        else:
            self._sources[slot] = other._sources[from_slot]
            self._followed[slot] = other.dry[from_slot]

    def playback_of(self, slot: int, source: ClipPlayer) -> np.void:
        """The PLAYBACK record by which a slot plays `source`."""
        record: np.void = self.playback[slot] if slot in self._clips else source.playback
        return record

    def set_gain(self, slot: int, gain: float) -> None:
        """Set a gain at once."""
        self.gain[:, slot] = gain
        self.ramp[slot] = 0

    def reach_gain(self, slot: int, gain: float) -> None:
        """Reach a gain by the end of the next block."""
        ramp = self.ramp[slot]
        if ramp["left"]:
            self.gain[0, slot] *= ramp["factor"]
            self.ramp[slot] = 0
        self.gain[1, slot] = gain

    def ramp_gain(self, slot: int, gain: float, samples: int) -> None:
        """Let the gain go to another one, linearly in decibels, over the next `samples`. Both are above 0."""
        ramp, wanted = self.ramp[slot], float(self.gain[1, slot])
        factor = (float(ramp["factor"]) if ramp["left"] else 1.0) * wanted / gain
        self.ramp[slot] = samples, factor, factor ** (-1 / samples)
        self.gain[0, slot] *= gain / wanted
        self.gain[1, slot] = gain

    def stop(self, slot: int) -> None:
        """Silence a slot at once."""
        self.plays[slot] = 0
        self.dry[slot] = 0
        if self.is_compiled and self.convolver is not None:
            self.convolver.compiled.input[slot] = 0
        self.playback[slot] = 0
        self.ramp[slot] = 0
        self._clips.pop(slot, None)
        self._sources.pop(slot, None)
        self._followed.pop(slot, None)

    @property
    def has_rung_out(self) -> bool:
        """Whether the bus, if there is one, adds nothing any more to what slots and responses do."""
        return self.bus is None or self.bus.is_quiet

    @property
    def plays_by_itself(self) -> bool:
        """Whether compiled code reads all of its sources, so that Python fetches none."""
        return not self._sources

    def fill(self) -> None:
        """Fetch the next block from the sources that compiled code cannot read."""
        for slot, source in self._sources.items():
            if slot not in self._followed:
                source.process(self.dry[slot])

    def follow(self) -> None:
        """Copy the blocks that another mixer fetched from a source that both play; call it after `fill` of all
        mixers."""
        for slot, played in self._followed.items():
            np.copyto(self.dry[slot], played)
        self._followed.clear()


def mix(mixer: Mixer) -> None:
    """Compute the next block, of any size, and write it to the mixer's `output`."""
    plays = mixer.plays.astype(bool)
    mixer.dry[~plays] = 0
    for slot in np.flatnonzero(mixer.ramp["left"]):
        if plays[slot]:
            _follow_ramp(mixer.ramp[slot], mixer.dry[slot])
    mixer.dry *= _ramp(mixer.gain, mixer.fade_in)
    mixer.gain[0, plays] = mixer.gain[1, plays]
    convolved = None
    if mixer.convolver is not None:
        sent = mixer.dry * _ramp(mixer.send, mixer.fade_in)
        mixer.send[0] = mixer.send[1]
        convolved = mixer.convolver.process(sent, mixer.output if mixer.bus is None else None)
    if convolved is None or mixer.bus is not None:
        mixer.output.fill(0)
    if mixer.bus is not None:
        mixer.bus.process(convolved, mixer.output)
    if mixer.direct is not None:
        mixer.direct.process(mixer.dry, mixer.output)


def _follow_ramp(ramp: np.void, row: FloatArray) -> None:
    count = min(int(ramp["left"]), row.size)
    row[:count] *= (ramp["factor"] * ramp["step"] ** np.arange(1, count + 1)).astype(np.float32)
    ramp["factor"] *= ramp["step"] ** count
    ramp["left"] -= count


def _ramp(ends: FloatArray, fade_in: FloatArray) -> FloatArray:
    now, then = ends[:, :, np.newaxis]
    return np.asarray(now + (then - now) * fade_in, np.float32)
