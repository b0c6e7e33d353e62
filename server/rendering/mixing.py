"""One block of many renderers in one call: gains, direct paths and convolution, without the interpreter's lock.

A `Mixer` holds the arrays of one renderer. Slots are rows: what an emitter plays lies in `dry` (slot, block), is scaled
by its gain for the direct path, and by its send besides for the convolver. Both reach what is wanted by the end of a
block, along a raised cosine.
"""

from collections.abc import Sequence

import numpy as np

from server.compiled import HAS_NUMBA
from server.rendering.convolver import Convolver, FloatArray
from server.rendering.direct_path import DirectPath
from server.rendering.fade import raised_cosine
from server.rendering.sources import ClipPlayer, Source

if HAS_NUMBA:
    from server.rendering.by_reference import Reference
    from server.rendering.mixing_kernel import mix_mixers, record_of


class Mixer:
    """`gain` and `send` are (2, slot): in effect, and wanted. A slot that does not play adds nothing new."""

    def __init__(self, convolver: Convolver, direct: DirectPath | None) -> None:
        slots, size = convolver.sources, convolver.block_size
        self.convolver = convolver
        self.direct = direct
        self.dry = np.zeros((slots, size), np.float32)
        self.gain = np.zeros((2, slots), np.float32)
        self.send = np.zeros((2, slots), np.float32)
        self.plays = np.zeros(slots, np.int64)
        self.clip, self.clip_samples, self.clip_at, self.clip_loops = (np.zeros(slots, np.int64) for _ in range(4))
        self._sources: dict[int, Source] = {}
        self._clips: dict[int, FloatArray] = {}
        self.output = np.zeros((convolver.channels, size), np.float32)
        self.fade_in = raised_cosine(size)
        if HAS_NUMBA:
            self.direct_state = Reference(direct.state) if direct is not None else None
            self.record = record_of(self)
            self.address = int(self.record.ctypes.data)

    def play(self, slot: int, source: Source) -> None:
        """Have a slot play what a source makes, from the next block on. Compiled code reads clips by itself."""
        self.plays[slot] = 1
        if HAS_NUMBA and isinstance(source, ClipPlayer):
            self.clip[slot] = source.clip.ctypes.data
            self.clip_samples[slot], self.clip_at[slot], self.clip_loops[slot] = source.clip.size, 0, source.loop
            self._clips[slot] = source.clip  # alive as long as it is played
        else:
            self._sources[slot] = source

    def stop(self, slot: int) -> None:
        """Have a slot fall silent."""
        self.plays[slot] = 0
        self.clip[slot] = 0
        self._clips.pop(slot, None)
        self._sources.pop(slot, None)

    def fill(self) -> None:
        """Have those sources play that Python has to ask."""
        for slot, source in self._sources.items():
            source.process(self.dry[slot])


def mix_all(mixers: Sequence[Mixer]) -> None:
    """The next block of each, in its `output`."""
    for mixer in mixers:
        mixer.fill()
    if HAS_NUMBA:
        like = next((mixer.direct_state for mixer in mixers if mixer.direct_state is not None), None)
        mix_mixers(np.array([mixer.address for mixer in mixers], np.int64), like)
        for mixer in mixers:
            mixer.convolver.release()
        return
    for mixer in mixers:
        _mix(mixer)


def _mix(mixer: Mixer) -> None:
    plays = mixer.plays.astype(bool)
    mixer.dry[~plays] = 0
    mixer.dry *= _ramp(mixer.gain, mixer.fade_in)
    sent = mixer.dry * _ramp(mixer.send, mixer.fade_in)
    for ramp in (mixer.gain, mixer.send):
        ramp[0, plays] = ramp[1, plays]
    mixer.convolver.process(sent, mixer.output)
    if mixer.direct is not None:
        mixer.direct.process(mixer.dry, mixer.output)


def _ramp(ends: FloatArray, fade_in: FloatArray) -> FloatArray:
    now, then = ends[:, :, np.newaxis]
    return np.asarray(now + (then - now) * fade_in, np.float32)
