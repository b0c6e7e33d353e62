"""The only fade of the renderer: a raised cosine over one block, for gains and for the exchange of impulse
responses."""

import numpy as np
import numpy.typing as npt


def raised_cosine(block_size: int) -> npt.NDArray[np.float32]:
    """Rise from 0 to 1, sampled at the middle of each sample so that the reversed fade is exactly its complement."""
    phase = np.pi * (np.arange(block_size) + 0.5) / block_size
    return (0.5 - 0.5 * np.cos(phase)).astype(np.float32)
