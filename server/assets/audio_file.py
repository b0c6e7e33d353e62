"""Reading audio files whose headers may be wrong.

Programs that write to a pipe leave the size field at zero or at its maximum, transfers break off, and editors forget to
correct a size. So the header is compared with the file, and differences are reported.

Arrays are `(sample, channel)`.
"""

import re
import stat
import struct
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt
import soundfile

FloatArray = npt.NDArray[np.float32]

MOST_BYTES = 2**31
MOST_VALUES = 2**28
"""Most samples over all channels: a gigabyte, or an hour and a half of mono at 48 kHz."""
SLOWEST_RATE_HZ, FASTEST_RATE_HZ = 2_000, 768_000
_BLOCKS = (16_384, 1024, 16)
_UNKNOWN_SIZES = range(0x7FFFF000, 0x100000000)
"""Sizes that programs write when they do not know the length beforehand."""
_CHUNK_NAME = re.compile(rb"[ -~]{4}")


class AudioFileError(Exception):
    """The file holds no sound that can be read. The message says why."""


@dataclass(frozen=True)
class Recording:
    """Decoded audio: `samples` (sample, channel). `finding` says how the header and the file differ, and is empty if
    they agree. With `is_cut` the end is missing."""

    samples: FloatArray
    sample_rate: int
    finding: str = ""
    is_cut: bool = False

    @property
    def duration_s(self) -> float:
        return len(self.samples) / self.sample_rate


Limit = Callable[[soundfile.SoundFile], int]
"""Says of an opened file how many samples, over all channels, may be read. It may raise AudioFileError."""


def unlimited(_: soundfile.SoundFile) -> int:
    """Lets `MOST_VALUES` samples be read of any file."""
    return MOST_VALUES


def read_audio(path: Path, limit: Limit = unlimited) -> Recording:
    """Read any file that libsndfile reads. The content decides the format, not the name. `limit` is asked before
    anything is decoded. Raises AudioFileError, also for more samples than `limit` allows."""
    content = _content(path)
    sizes = _sizes(content)
    if sizes is not None and sizes.is_short:
        content = sizes.corrected(content)
    try:
        samples, rate, promised = _decoded(content, limit)
    except (OSError, soundfile.LibsndfileError) as exc:
        reason = str(getattr(exc, "error_string", exc)).rstrip(".") or "damaged"
        raise AudioFileError(f"not an audio file that can be read ({reason})") from exc
    if not SLOWEST_RATE_HZ <= rate <= FASTEST_RATE_HZ:
        raise AudioFileError(f"its rate of {rate} Hz is not one of audio, {SLOWEST_RATE_HZ} to {FASTEST_RATE_HZ} Hz")
    return _compared(Recording(samples, rate), sizes, promised, content)


def _content(path: Path) -> bytes:
    try:
        status = path.stat()
        if stat.S_ISDIR(status.st_mode):
            raise AudioFileError("is a directory")
        if not stat.S_ISREG(status.st_mode):
            raise AudioFileError("is not a regular file")
        if status.st_size > MOST_BYTES:
            raise AudioFileError(f"is {status.st_size} bytes long; at most {MOST_BYTES} are read")
        return path.read_bytes()
    except (OSError, ValueError) as exc:
        raise AudioFileError(getattr(exc, "strerror", None) or str(exc)) from exc


def _decoded(content: bytes, limit: Limit) -> tuple[FloatArray, int, int]:
    """Samples, rate, and the number of samples by the header. A damaged stream is read up to the damage."""
    parts: list[FloatArray] = []
    rate = promised = 0
    # A decoding error loses its whole block, so smaller blocks are tried next.
    for block in _BLOCKS:
        # Without a file name, so that the content alone decides the format.
        with soundfile.SoundFile(BytesIO(content)) as file:
            rate, promised, most = file.samplerate, file.frames, limit(file)
            for part in parts:
                file.read(len(part), dtype="float32")
            if _is_read_to_its_end(file, block, parts, most):
                break
    if not parts:
        raise AudioFileError("not an audio file that can be read (its first samples are damaged)")
    return np.concatenate(parts), rate, promised


def _is_read_to_its_end(file: soundfile.SoundFile, block: int, parts: list[FloatArray], most: int) -> bool:
    """Read the rest and append it to `parts`. Returns False if a decoding error ends it early."""
    values = sum(part.size for part in parts)
    while True:
        try:
            part = file.read(block, dtype="float32", always_2d=True)
        except soundfile.LibsndfileError:
            return False
        parts.append(part)
        values += part.size
        if values > most:
            raise AudioFileError(f"it holds more than {most} samples; cut it")
        if len(part) < block:
            return True


def _compared(read: Recording, sizes: "_Sizes | None", promised: int, content: bytes) -> Recording:
    """The recording with a finding, if the header and the file disagree."""
    amount = f"{len(read.samples)} samples ({read.duration_s:.3g} s) were read"
    finding, is_cut = "", False
    if sizes is not None and sizes.is_short:
        claimed = "does not say how much sound follows" if sizes.is_unknown else f"tells of {sizes.declared} bytes"
        finding = f"its header {claimed}, and the file holds {sizes.present}: {amount}"
    elif sizes is not None and sizes.is_unknown:
        finding = f"its header does not say how much sound follows: {amount}"
    elif sizes is not None and sizes.present < sizes.declared:
        finding, is_cut = f"it is cut off: of {sizes.declared} bytes of sound it holds {sizes.present}; {amount}", True
    elif promised > len(read.samples) or _lacks_its_last_page(content):
        finding, is_cut = f"it is cut off: it promises more than it holds; {amount}", True
    return Recording(read.samples, read.sample_rate, finding, is_cut)


@dataclass(frozen=True)
class _Sizes:
    """Size of the sound in bytes: `declared` by the header, and `present` in the file from byte `start` on. `fields`
    has the offset and the `struct` format of each size field."""

    declared: int
    present: int
    start: int
    is_unknown: bool
    fields: tuple[tuple[int, str], ...]
    is_short: bool
    """Whether more sound follows than the header declares."""

    def corrected(self, content: bytes) -> bytes:
        changed = bytearray(content)
        for at, form in self.fields:
            struct.pack_into(form, changed, at, min(self.present, 2 ** (8 * struct.calcsize(form)) - 1))
        return bytes(changed)


def _sizes(content: bytes) -> _Sizes | None:
    """Sizes in a file of the RIFF family, AIFF or AU; None for any other content."""
    kind, form = content[:4], content[8:12]
    if kind in {b"RIFF", b"RIFX", b"RF64", b"BW64"} and form == b"WAVE":
        return _sizes_in_chunks(content, b"data", ">I" if kind == b"RIFX" else "<I")
    if kind == b"FORM" and form in {b"AIFF", b"AIFC"}:
        return _sizes_in_chunks(content, b"SSND", ">I")
    if kind == b".snd" and len(content) >= 24:
        start, declared = struct.unpack(">II", content[4:12])
        present = max(0, len(content) - start)
        is_unknown = declared == 0xFFFFFFFF
        return _Sizes(declared, present, start, is_unknown, (), is_short=False)
    return None


def _sizes_in_chunks(content: bytes, sound: bytes, form: str) -> _Sizes | None:
    at, long_size = 12, None
    while at + 8 <= len(content):
        name, (size,) = content[at : at + 4], struct.unpack_from(form, content, at + 4)
        start = at + 8
        if name == b"ds64" and start + 16 <= len(content):
            long_size = start + 8
        if name == sound:
            fields = [(at + 4, form)]
            if size == 0xFFFFFFFF and long_size is not None:
                (size,) = struct.unpack_from("<Q", content, long_size)
                fields = [(long_size, "<Q")]
            present = len(content) - start
            is_unknown = (size in _UNKNOWN_SIZES and size > present) or (size == 0 and present > 0)
            follows = content[start + size :] if size < present else b""
            is_short = size < present and sound == b"data" and not _is_chunks(follows, size % 2, form)
            # Chunks after the declared sound are not sound.
            return _Sizes(size, present, start, is_unknown and (size > 0 or is_short), tuple(fields), is_short)
        at = start + size + size % 2
    return None


def _is_chunks(content: bytes, padding: int, form: str) -> bool:
    """Whether these bytes are whole chunks, tags that players append, or nothing."""
    if not content.strip(b"\0") or content[padding:].startswith((b"TAG", b"APETAGEX")):
        return True
    for at in {padding, 0}:  # not all programs pad
        while at + 8 <= len(content) and _CHUNK_NAME.fullmatch(content, at, at + 4):
            (size,) = struct.unpack_from(form, content, at + 4)
            at += 8 + size + size % 2
        if at >= len(content) or (at + 8 > len(content) and not content[at:].strip(b"\0")):
            # A chunk that reaches beyond the file by more than its padding is sound that looks like a chunk's name.
            return at <= len(content) + 1
    return False


def _lacks_its_last_page(content: bytes) -> bool:
    """Whether an Ogg file lacks the page that ends its stream, or a part of it."""
    if not content.startswith(b"OggS"):
        return False
    at = content.rfind(b"OggS")
    header = content[at : at + 27]
    if len(header) < 27 or not header[5] & 4:
        return True
    lacing = content[at + 27 : at + 27 + header[26]]
    return len(lacing) < header[26] or at + 27 + len(lacing) + sum(lacing) > len(content)


def to_mono(samples: FloatArray, channel: int | None = None) -> tuple[FloatArray, str]:
    """Mix (sample, channel) down to (sample,); also returns a warning, which may be empty.

    The result is the average of the channels, or the one that `channel` names, counted from 0. If the channels have
    opposite phase and would cancel, the louder one is used. Raises AudioFileError if the channel does not exist.
    """
    channels = samples.shape[1]
    if channel is not None:
        if not channel < channels:
            raise AudioFileError(f"it has no channel {channel + 1}, only {channels}")
        return np.ascontiguousarray(samples[:, channel]), ""
    if channels > 1 and (share := _cancelled_share(samples)) > _MOST_CANCELLED:
        louder = int(np.argmax(np.sum(np.square(samples, dtype=np.float64), axis=0)))
        warning = (
            f"its {channels} channels cancel each other ({share:.0%} of the sound is of opposite phase); "
            f"channel {louder + 1}, the louder, is played alone"
        )
        return np.ascontiguousarray(samples[:, louder]), warning
    return samples.mean(axis=1, dtype=np.float32), ""


_MOST_CANCELLED = 0.1
_STRETCH = 8192
_LEAST_OF_UNRELATED = 0.4


def _cancelled_share(samples: FloatArray) -> float:
    """Share of the energy in stretches where channels cancel. There averaging leaves less than 0.4 of the energy that
    it would leave of uncorrelated channels; for two equally loud channels that is a correlation below -0.6."""
    starts = np.arange(0, len(samples), _STRETCH)
    energy = np.add.reduceat(np.square(samples, dtype=np.float64).sum(axis=1), starts)
    of_sum = np.add.reduceat(np.square(samples.sum(axis=1, dtype=np.float64)), starts)
    return float(energy[of_sum < _LEAST_OF_UNRELATED * energy].sum() / max(energy.sum(), 1e-300))
