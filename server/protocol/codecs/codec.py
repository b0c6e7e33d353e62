"""What an encoding of samples is."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Codec:
    """An encoding of samples with full scale at 1, each in as many bytes; `meaning` completes "NAME is ..." in the
    description of the stream.

    `encode` gives the bytes of samples in C order. `decode` gives (n,) samples from an offset in bytes to the end, and
    raises ValueError where the last sample is incomplete.
    """

    name: str
    bytes_per_sample: int
    meaning: str
    encode: Callable[[FloatArray], bytes]
    decode: Callable[[bytes, int], FloatArray]
