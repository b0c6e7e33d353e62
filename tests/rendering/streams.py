"""What tests of convolvers are made of: signals, responses, and SciPy's one-shot FFT convolution in float64."""

import numpy as np
import pytest
from scipy.signal import fftconvolve

from tests.signals import noise

SAMPLE_RATE = 24_000
BLOCK_SIZES = (64, 128, 256)

BOTH_KINDS = pytest.mark.parametrize(
    "any_size", [pytest.param(False, id="compiled"), pytest.param(True, id="any size")]
)
"""Of convolver: a test takes `any_size`."""


def decaying_ir(seed, samples, channels=2, t60_s=0.4):
    decay = 10 ** (-3 * np.arange(samples) / (t60_s * SAMPLE_RATE))
    return (noise(seed, channels, samples) * decay).astype(np.float32)


def convolve(dry, ir):
    """Oracle: (n,) with (c, m) to the first n samples, float64."""
    return fftconvolve(dry[np.newaxis].astype(float), ir.astype(float), axes=1)[:, : dry.size]


def stream(convolver, dry, changes=()):
    """Feed (s, n) block by block; `changes` are (block, source, ir), made before that block."""
    size = convolver.block_size
    blocks = []
    for index in range(dry.shape[1] // size):
        for block, source, ir in changes:
            if block == index:
                convolver.set_ir(source, ir)
        blocks.append(convolver.process(dry[:, index * size : (index + 1) * size]))
    return np.concatenate(blocks, axis=1)
