"""Samples as 16-bit integers, little endian."""

from typing import Final

import numpy as np

from server.protocol.codecs.codec import Codec, FloatArray

_FULL_SCALE: Final = 32767


def _encode(samples: FloatArray) -> bytes:
    return np.rint(np.clip(samples, -1, 1) * _FULL_SCALE).astype("<i2").tobytes()


def _decode(data: bytes, offset: int) -> FloatArray:
    return np.frombuffer(data, "<i2", offset=offset).astype(np.float32) / np.float32(_FULL_SCALE)


S16 = Codec("s16", 2, f"two's complement with {_FULL_SCALE} for full scale", _encode, _decode)
