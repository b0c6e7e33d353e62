"""Full responses as a listener hears them whose quality level has a bus: reflected sound as ambisonic channels, turned
and decoded to two ears as the renderer does it, and the direct sound through the filters of the head.

Axes: B poses; responses (B, 2, sample).
"""

import numpy as np
import numpy.typing as npt
import scipy.signal

from server.acoustics.geometry import Pose, Quaternion, orientations_of
from server.acoustics.spherical_harmonics import harmonic_count, rotation
from server.field.field import AcousticField
from server.rendering.head_decoder import HeadDecoder
from server.rendering.hrtf import HeadFilters, kemar
from server.responses.direct_sound import DirectSound
from server.responses.emitter_state import EmitterState
from server.responses.full_response import FullResponse
from server.responses.ir_request import composed_irs
from server.scene.bundle import Bundle


class HeardByBus:
    """Full responses by the bus of a field's level, through one head, for omnidirectional emitters. Raises ValueError
    for a level without a bus."""

    def __init__(self, field: AcousticField, filters: HeadFilters) -> None:
        if field.level.bus is None:
            raise ValueError(f"level {field.level.name} has no bus")
        self.field = field
        self._order = field.level.bus
        self._decoder = HeadDecoder.of(filters, self._order)
        self._direct_sound = DirectSound.of(field.bundle, filters)

    @property
    def bundle(self) -> Bundle:
        return self.field.bundle

    def impulse_responses(
        self, listeners: npt.ArrayLike, emitters: npt.ArrayLike, heads: npt.ArrayLike
    ) -> npt.NDArray[np.float32]:
        """Return responses as those of `FullResponse` are."""
        listeners, emitters, heads = (np.asarray(a, dtype=np.float64) for a in (listeners, emitters, heads))
        channels = harmonic_count(self._order)
        heard = np.zeros((len(listeners), 2, self.field.ir_samples), np.float32)
        for row, orientation in enumerate(orientations_of(heads)):
            head = Pose(tuple(listeners[row]), Quaternion(*orientation))
            emitter = [EmitterState(Pose(tuple(emitters[row])))]
            (reflected,) = composed_irs(self.field, self._direct_sound, head, emitter, channels)
            heard[row] = self._decode(rotation(orientation, self._order) @ reflected)
            self._direct_sound.add(heard[row : row + 1], head, emitter)
        return heard

    def _decode(self, turned: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the ears (2, sample) of channels (k, sample) in the head's axes, with the decoder's delay made up."""
        ears = scipy.signal.fftconvolve(turned[None], self._decoder.filters, axes=-1).sum(axis=1)
        return np.asarray(ears[:, self._decoder.delay : self._decoder.delay + turned.shape[-1]])


def full_response(field: AcousticField) -> FullResponse | HeardByBus:
    """Return what KEMAR hears at the level of a field."""
    if field.level.bus is None:
        return FullResponse.through_kemar(field)
    return HeardByBus(field, kemar(field.sample_rate))
