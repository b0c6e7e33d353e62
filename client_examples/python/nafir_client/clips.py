"""Audio files as dry sound for live emitters."""

from pathlib import Path

import numpy as np

from nafir_client.errors import ClipError, MissingExtraError
from nafir_client.wire import Samples


def load_clip(path: Path | str, sample_rate: int) -> Samples:
    """(n,) samples of a file at `sample_rate`, its channels mixed. Raises ClipError or MissingExtraError."""
    try:
        import soundfile
        import soxr
    except ImportError as exc:
        raise MissingExtraError("soundfile and soxr", "clips", "reading audio files") from exc
    try:
        samples, rate = soundfile.read(path, dtype="float32", always_2d=True)
    except soundfile.LibsndfileError as exc:
        raise ClipError(f"{path}: {exc.error_string}") from exc
    mono = samples.mean(axis=1)
    energy = np.sum(samples**2, axis=0)
    if samples.shape[1] * np.sum(mono**2) < 0.4 * energy.mean():  # channels of opposite phase would cancel
        mono = samples[:, np.argmax(energy)]
    resampled: Samples = soxr.resample(mono, rate, sample_rate)
    return resampled


def claps(sample_rate: int) -> Samples:
    """(n,) two seconds of four claps."""
    bursts = np.random.default_rng(0).standard_normal((4, sample_rate // 2)) / 8
    decay = np.exp(-np.arange(sample_rate // 2) / (0.01 * sample_rate))
    return (bursts * decay).ravel().astype(np.float32)
