"""The entry check for all audio: files, arrays from callers, and live samples from clients.

Later code checks nothing any more. A NaN would stay in every filter it reaches; a number that overflows later would
become one; a denormal number is inaudible and slow.
"""

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]

LOUDEST = 1e6
"""The largest magnitude accepted, where full scale is 1. Integers written as float reach 2^31, which is certainly a
mistake."""
LOUDEST_GAIN = 1e3
"""The largest gain accepted, linear: 60 dB."""
_TINY = np.finfo(np.float32).tiny


class DryAudio:
    """Mono `samples` (n,) float32, read-only. Each is finite, within `LOUDEST`, and not denormal.

    Samples that are not finite or exceed the limit were replaced by zero and counted in `silenced`; denormal samples
    were replaced too, but not counted. Raises ValueError for another shape.
    """

    __slots__ = ("samples", "silenced")

    def __init__(self, samples: npt.ArrayLike) -> None:
        with np.errstate(invalid="ignore", over="ignore"):  # signalling NaNs, and doubles beyond the largest float
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
    """Raise ValueError if a linear gain is not a number, or if its magnitude exceeds `LOUDEST_GAIN`."""
    # guard: a gain does not overflow
    if not abs(gain) <= LOUDEST_GAIN:
        raise ValueError(f"a gain is finite and at most {LOUDEST_GAIN:g}, got {gain:g}")
    return gain
