"""WAV files of 32-bit floats, the same bytes for the same samples.

They are byte for byte what `scipy.io.wavfile.write` makes, whose import takes a third of a second. libsndfile would put
the time of day into WAV files of floats (PEAK chunk).
"""

import struct

import numpy as np
import numpy.typing as npt

_IEEE_FLOAT = 3


def wav_bytes(samples: npt.NDArray[np.float32], sample_rate: int) -> bytes:
    """A file of samples (channel, n)."""
    channels, frames = samples.shape
    data = samples.T.astype("<f4").tobytes()
    frame_bytes = 4 * channels
    described = struct.pack(
        "<HHIIHHH", _IEEE_FLOAT, channels, sample_rate, sample_rate * frame_bytes, frame_bytes, 32, 0
    )
    chunks = ((b"fmt ", described), (b"fact", struct.pack("<I", frames)), (b"data", data))
    content = b"WAVE" + b"".join(name + struct.pack("<I", len(chunk)) + chunk for name, chunk in chunks)
    return b"RIFF" + struct.pack("<I", len(content)) + content
