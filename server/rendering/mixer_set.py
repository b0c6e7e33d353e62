"""The mixers of one renderer: one for a head with two ears, one for a single ear without a head, or one alone for
ambisonic channels. A head may also have mixers with a bus (`server.rendering.bus`), which are those with the number of
its ambisonic channels. Each mixer is made when it is needed and dropped when all sound in it has rung out; the same
goes for its convolver. There are at most two at a time.

Making one takes milliseconds, so `prepare` and `prepare_hearing` do it on another thread before the rendering thread
needs it. All other methods are for the rendering thread.
"""

from collections.abc import Callable, Iterator

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Quaternion
from server.rendering.bus import Bus
from server.rendering.convolver import Convolver, PartitionedIr, Sharing
from server.rendering.direct_path import DirectPath
from server.rendering.mixing import Mixer

Slot = tuple[Mixer, int]

_MOST = 2
"""Mixers that compiled code mixes for one listener."""


class MixerSet:
    """The mixers of a renderer. There is at most one for each number of channels that responses may have, which are
    `hearings`. `new_direct`, `new_convolver` and `new_bus` take such a number and make the parts of a mixer."""

    def __init__(
        self,
        *,
        slots: int,
        block_size: int,
        hearings: tuple[int, ...],
        new_direct: Callable[[int], DirectPath | None],
        new_convolver: Callable[[int], Convolver],
        new_bus: Callable[[int], Bus | None],
    ) -> None:
        self._slots = slots
        self._block_size = block_size
        self._hearings = hearings
        self._usual = 2 if 2 in hearings else hearings[0]
        self._new_direct = new_direct
        self._new_convolver = new_convolver
        self._new_bus = new_bus
        self._spare_mixers: dict[int, Mixer] = {}
        self._spare_convolvers: dict[int, Convolver] = {}
        self.clear()

    def clear(self) -> None:
        """Drop all mixers and all sound in them."""
        self._mixers: dict[int, Mixer] = {}
        self._sharing = Sharing.NOTHING
        self._orientation: Quaternion | None = None
        self._leaving: list[Slot] = []  # they ramp down in the next block
        self._ringing: list[Slot] = []  # they have ramped down and ring out
        self._hushed: list[Slot] = []  # only their IRs ring out

    def __iter__(self) -> Iterator[Mixer]:
        return iter(self._mixers.values())

    def prepare(self, ir: npt.NDArray[np.floating], *, like: PartitionedIr | None, same_from: int) -> PartitionedIr:
        """Prepare an IR (channel, samples) for the mixer with the same number of channels, as `Convolver.prepare` does.

        Raises ValueError for another shape or a sample that is not finite.
        """
        channels = ir.shape[0] if ir.ndim == 2 and ir.shape[0] in self._hearings else self._usual
        self.prepare_hearing(channels)
        return self.preparer(channels).prepare(ir, like=like, same_from=same_from)

    def preparer(self, channels: int) -> Convolver:
        """The convolver of the mixer with this number of channels; made now if there is none yet."""
        known = self._mixers.get(channels)
        convolver = None if known is None else known.convolver
        if convolver is None:
            convolver = self._spare_convolvers.get(channels)
        if convolver is None:
            convolver = self._spare_convolvers[channels] = self._new_convolver(channels)
        return convolver

    def prepare_hearing(self, channels: int) -> None:
        """Make the mixer with this number of channels, unless it exists."""
        if channels not in self._mixers and channels not in self._spare_mixers:
            self._spare_mixers[channels] = self._new_mixer(channels)

    def of(self, channels: int) -> Mixer:
        """The mixer with this number of channels; made now if there is none yet."""
        if channels not in self._mixers:
            mixer = self._spare_mixers.pop(channels, None) or self._new_mixer(channels)
            if self._orientation is not None:
                mixer.set_orientation(self._orientation)
            self._mixers[channels] = mixer
        return self._mixers[channels]

    def is_free(self, channels: int) -> bool:
        """Whether the mixer with this number of channels is free of sound, and may exist beside the others."""
        mixer = self._mixers.get(channels)
        return len(self._mixers) < _MOST if mixer is None else len(mixer.free_slots) == self._slots

    def convolver_of(self, mixer: Mixer) -> Convolver:
        """The convolver of a mixer; made and connected now if there is none yet."""
        if mixer.convolver is None:
            convolver = self._spare_convolvers.pop(mixer.channels, None) or self._new_convolver(mixer.channels)
            convolver.share(self._sharing)
            mixer.connect(convolver)
            return convolver
        return mixer.convolver

    def share(self, sharing: Sharing) -> None:
        self._sharing = sharing
        for mixer in self:
            if mixer.convolver is not None:
                mixer.convolver.share(sharing)

    def set_orientation(self, orientation: Quaternion) -> None:
        if orientation != self._orientation:
            self._orientation = orientation
            for mixer in self:
                mixer.set_orientation(orientation)

    @property
    def rests(self) -> bool:
        """Whether `let_go` has nothing to do until an emitter is removed or moves to another mixer."""
        return len(self._mixers) == 1 and not (self._leaving or self._ringing or self._hushed)

    def leave(self, mixer: Mixer, slot: int, *, has_played: bool) -> None:
        """Ramp a slot down over the next block, and let it ring out."""
        self._unhush(mixer, slot)
        if has_played:
            mixer.gain[1, slot] = 0.0
            self._leaving.append((mixer, slot))
        else:
            mixer.release(slot)

    def hush(self, mixer: Mixer, slot: int) -> None:
        """Stop sending a slot to its IR, and let the IR ring out."""
        mixer.send[1, slot] = 0.0
        self._hushed.append((mixer, slot))

    def resume(self, mixer: Mixer, slot: int, send: float, *, has_played: bool) -> None:
        """Send a slot to its current IR again; if the slot is already playing, fade the send in over the next block."""
        mixer.send[1, slot] = send
        if not self._unhush(mixer, slot) and has_played:
            mixer.send[0, slot] = 0.0

    def _unhush(self, mixer: Mixer, slot: int) -> bool:
        if is_hushed := (mixer, slot) in self._hushed:
            self._hushed.remove((mixer, slot))
        return is_hushed

    def let_go(self, heard: set[Mixer], sending: set[Mixer]) -> None:
        """Free, after a block, the slots and IRs that have rung out. Also drop the mixers that are not in `heard` (with
        emitters, now or soon), and the convolvers whose mixers are not in `sending` (to IRs, now or soon)."""
        for mixer, slot in self._leaving:
            mixer.stop(slot)
            self._ringing.append((mixer, slot))
        self._leaving.clear()
        # guard: a slot is not taken while it rings out
        for mixer, slot in [each for each in self._ringing if each[0].is_quiet(each[1])]:
            self._ringing.remove((mixer, slot))
            # guard: who has rung out makes room
            mixer.release(slot)
        for mixer, slot in [each for each in self._hushed if each[0].has_no_response(each[1])]:
            self._hushed.remove((mixer, slot))
            if mixer.convolver is not None:
                mixer.convolver.clear(slot)
        ringing = {mixer for mixer, _ in (*self._ringing, *self._hushed)}
        for channels, mixer in tuple(self._mixers.items()):
            if mixer not in ringing and mixer not in heard and mixer.has_rung_out:
                del self._mixers[channels]
            elif mixer.convolver is not None and mixer not in ringing and mixer not in sending:
                mixer.connect(None)

    def _new_mixer(self, channels: int) -> Mixer:
        direct = self._new_direct(channels)
        bus = self._new_bus(channels)
        return Mixer(channels=channels, slots=self._slots, block_size=self._block_size, direct=direct, bus=bus)
