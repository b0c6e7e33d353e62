"""Audio files as clients upload them, and how they may be broken."""

from io import BytesIO

import numpy as np
import soundfile

KINDS = {
    "wav": ("WAV", "PCM_16"),
    "float wav": ("WAV", "FLOAT"),
    "flac": ("FLAC", "PCM_24"),
    "vorbis": ("OGG", "VORBIS"),
    "opus": ("OGG", "OPUS"),
    "mp3": ("MP3", "MPEG_LAYER_III"),
}


def tone(seconds, sample_rate=48_000, channels=1):
    """A tone of 440 Hz with a little noise; (sample, channel)"""
    time_s = np.arange(round(seconds * sample_rate)) / sample_rate
    noise = np.random.default_rng(1).standard_normal((time_s.size, channels))
    return (0.3 * np.sin(2 * np.pi * 440 * time_s)[:, np.newaxis] + 0.01 * noise).astype(np.float32)


def encoded(kind, seconds=0.5, sample_rate=48_000, channels=1):
    file = BytesIO()
    form, subtype = KINDS[kind]
    soundfile.write(file, tone(seconds, sample_rate, channels), sample_rate, format=form, subtype=subtype)
    return file.getvalue()


def mutated(content, rng):
    """The file with some bytes changed, cut out, doubled, or with its end missing."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 8)):
        at, count = int(rng.integers(0, len(data))), int(rng.integers(1, 64))
        match rng.integers(0, 5):
            case 0:
                data[at : at + count] = rng.bytes(count)
            case 1:
                del data[at : at + count]
            case 2:
                data[at:at] = data[at : at + count]
            case 3:
                data[at : at + 4] = int(rng.choice([0, 0xFFFFFFFF, 0x7FFFFFFF, 2**31, 1])).to_bytes(4, "little")
            case 4:
                del data[max(1, at) :]
        if not data:
            return b"\0"
    return bytes(data)
