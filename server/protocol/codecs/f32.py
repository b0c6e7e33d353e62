"""Samples as IEEE 754 single precision, little endian."""

import numpy as np

from server.protocol.codecs.codec import Codec, FloatArray


def _encode(samples: FloatArray) -> bytes:
    return samples.astype("<f4", copy=False).tobytes()


def _decode(data: bytes, offset: int) -> FloatArray:
    return np.frombuffer(data, "<f4", offset=offset).astype(np.float32)


F32 = Codec("f32", 4, "IEEE 754 single with full scale 1", _encode, _decode)
