"""A codec's transform of all frames at once: several times as fast as frame by frame, and the same up to rounding.

Served responses use the codec's own transform, because their last bits depend on it.
"""

import numpy as np
import numpy.typing as npt
from scipy.fft import rfft

from server.acoustics.codec import Codec


def transform_at_once(codec: Codec, signal: npt.NDArray[np.floating]) -> npt.NDArray[np.complexfloating]:
    """Transforms (..., sample), of the codec's length, to (..., frequency, frame), as `Codec.transform` does, in the
    precision of the signal."""
    shifts = codec.n_fft // codec.hop
    hops = codec.frames + shifts - 1
    padded = np.zeros((*signal.shape[:-1], hops * codec.hop), signal.dtype)
    lead = codec.frame_lead_samples
    length = min(signal.shape[-1], padded.shape[-1] - lead)
    padded[..., lead : lead + length] = signal[..., :length]
    frames = np.lib.stride_tricks.sliding_window_view(padded, codec.n_fft, axis=-1)[..., :: codec.hop, :]
    windowed = frames * codec.window.astype(signal.dtype)
    return np.asarray(np.swapaxes(rfft(windowed), -1, -2))
