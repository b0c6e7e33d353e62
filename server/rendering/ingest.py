"""The one door by which sound enters, be it a file, an array of a caller's, or what a client sends as it goes.

Behind it nothing is checked any more. One NaN would stay in every filter it met; a number that overflows later would
end as one; a denormal number is inaudible and slow.
"""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]

LOUDEST = 1e6
"""Full scale is 1. Integers written as float reach 2^31, and nobody wants to hear them so."""
LOUDEST_GAIN = 1e3
"""Linear: 60 dB."""
_TINY = np.finfo(np.float32).tiny


class DryAudio:
    """Mono `samples` (n,) float32, read-only: each finite, within `LOUDEST`, and zero or no denormal.

    What is no audio (not finite, or beyond) became silence, counted in `silenced`; denormals too, uncounted. Raises
    ValueError for another shape.
    """

    __slots__ = ("samples", "silenced")

    def __init__(self, samples: npt.ArrayLike) -> None:
        with np.errstate(invalid="ignore", over="ignore"):  # signalling NaNs; doubles beyond the largest float
            # guard: samples come in as floats
            given = np.asarray(samples, np.float32)
            # guard: audio has one channel
            if given.ndim != 1:
                raise ValueError(f"audio is mono, got shape {given.shape}")
            magnitude = np.abs(given)
            is_audio = magnitude <= LOUDEST
            # guard: denormal samples are zero
            # guard: what is no audio is silence
            self.samples: FloatArray = np.where(is_audio & (magnitude >= _TINY), given, np.float32(0))
        # guard: what came in cannot be changed
        self.samples.flags.writeable = False
        self.silenced = given.size - int(np.count_nonzero(is_audio))

    @property
    def size(self) -> int:
        return self.samples.size


def require_gain(gain: float) -> float:
    """Raises ValueError for a linear gain that is no number, or beyond `LOUDEST_GAIN` either way."""
    # guard: a gain does not overflow
    if not abs(gain) <= LOUDEST_GAIN:
        raise ValueError(f"a gain is finite and at most {LOUDEST_GAIN:g}, got {gain:g}")
    return gain
