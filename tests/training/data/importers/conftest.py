"""Sources in the layouts they are published in, with sound that can be told from geometry alone."""

import os
from pathlib import Path

import numpy as np
import pytest

from training.data.dataset import SPEED_OF_SOUND

RATE = 16_000
_SAMPLES = 800


def wave(listener, emitter, yaw=None):
    """(channel, sample) float32: the direct sound alone, of an open field or, with a yaw, of two ears 18 cm apart that
    hear less from the other side."""
    offset = np.subtract(emitter, listener)
    if yaw is None:
        ears, gains = np.zeros((1, 3)), [1.0]
    else:
        left = np.array([-np.sin(yaw), np.cos(yaw), 0.0])
        ears = np.stack([0.09 * left, -0.09 * left])
        side = float(offset @ left) / np.linalg.norm(offset)
        gains = [1.0 + 0.8 * side, 1.0 - 0.8 * side]
    response = np.zeros((len(ears), _SAMPLES), np.float32)
    for channel, (ear, gain) in enumerate(zip(ears, gains, strict=True)):
        distance = np.linalg.norm(offset - ear)
        response[channel, round(RATE * distance / SPEED_OF_SOUND)] = gain / distance
    return response


@pytest.fixture
def measured_office() -> Path:
    """The recordings themselves may not be handed on with this code."""
    folder = os.environ.get("MEASURED_OFFICE")
    if not folder:
        pytest.skip("MEASURED_OFFICE names no folder")
    return Path(folder)
