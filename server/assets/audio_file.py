"""Audio files, read as what they hold and not as what their headers claim.

Programs that write to a pipe leave the size of the sound at zero or at its largest; transfers break off; editors forget
to correct a size. So the header is compared with the file, and what was found is said.

Arrays are `(sample, channel)`.
"""

import re
import stat
import struct
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
import numpy.typing as npt
import soundfile

FloatArray = npt.NDArray[np.float32]

MOST_BYTES = 2**31
MOST_VALUES = 2**28
"""Of all channels: an hour and a half of mono at 48 kHz, a gigabyte."""
SLOWEST_RATE_HZ, FASTEST_RATE_HZ = 2_000, 768_000
_BLOCKS = (16_384, 1024, 16)
_UNKNOWN_SIZES = range(0x7FFFF000, 0x100000000)
"""What programs write who cannot know how long the sound will be."""
_CHUNK_NAME = re.compile(rb"[ -~]{4}")


class AudioFileError(Exception):
    """A file that holds no sound that can be read; says why."""


@dataclass(frozen=True)
class Recording:
    """`samples` (sample, channel). `finding` says what the header has wrong and what was read, if anything; `is_cut`
    that the end is missing."""

    samples: FloatArray
    sample_rate: int
    finding: str = ""
    is_cut: bool = False

    @property
    def duration_s(self) -> float:
        return len(self.samples) / self.sample_rate


def read_audio(path: Path) -> Recording:
    """Any file that libsndfile reads; its content decides what it is. Raises AudioFileError, also for one that holds
    more than `MOST_VALUES`."""
    content = _content(path)
    sizes = _sizes(content)
    if sizes is not None and sizes.is_short:
        content = sizes.corrected(content)
    try:
        samples, rate, promised = _decoded(content)
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


def _decoded(content: bytes) -> tuple[FloatArray, int, int]:
    """Samples, rate, and how many samples the header promises. A stream that breaks off is read until there."""
    parts: list[FloatArray] = []
    rate = promised = 0
    # An error takes all of its block with it, so smaller blocks follow.
    for block in _BLOCKS:
        # Without a name, so that the content alone decides what it is.
        with soundfile.SoundFile(BytesIO(content)) as file:
            rate, promised = file.samplerate, file.frames
            for part in parts:
                file.read(len(part), dtype="float32")
            if _is_read_to_its_end(file, block, parts):
                break
    if not parts:
        raise AudioFileError("not an audio file that can be read (its first samples are damaged)")
    return np.concatenate(parts), rate, promised


def _is_read_to_its_end(file: soundfile.SoundFile, block: int, parts: list[FloatArray]) -> bool:
    """Whether the rest was read, and put behind `parts`; False where it breaks off before."""
    values = sum(part.size for part in parts)
    while True:
        try:
            part = file.read(block, dtype="float32", always_2d=True)
        except soundfile.LibsndfileError:
            return False
        parts.append(part)
        values += part.size
        if values > MOST_VALUES:
            raise AudioFileError(f"it holds more than {MOST_VALUES} samples; cut it")
        if len(part) < block:
            return True


def _compared(read: Recording, sizes: "_Sizes | None", promised: int, content: bytes) -> Recording:
    """With what the header and the file disagree about."""
    told = f"{len(read.samples)} samples ({read.duration_s:.3g} s) were read"
    finding, is_cut = "", False
    if sizes is not None and sizes.is_short:
        claimed = "does not say how much sound follows" if sizes.is_unknown else f"tells of {sizes.declared} bytes"
        finding = f"its header {claimed}, and the file holds {sizes.held}: {told}"
    elif sizes is not None and sizes.is_unknown:
        finding = f"its header does not say how much sound follows: {told}"
    elif sizes is not None and sizes.held < sizes.declared:
        finding, is_cut = f"it is cut off: of {sizes.declared} bytes of sound it holds {sizes.held}; {told}", True
    elif promised > len(read.samples) or _lacks_its_last_page(content):
        finding, is_cut = f"it is cut off: it promises more than it holds; {told}", True
    return Recording(read.samples, read.sample_rate, finding, is_cut)


@dataclass(frozen=True)
class _Sizes:
    """Bytes of sound by the header, `declared`, and by the file, from `start` on, `held`; `fields` are the places and
    formats of the numbers that declare them."""

    declared: int
    held: int
    start: int
    is_unknown: bool
    fields: tuple[tuple[int, str], ...]
    is_short: bool
    """More sound follows than is declared."""

    def corrected(self, content: bytes) -> bytes:
        changed = bytearray(content)
        for at, form in self.fields:
            struct.pack_into(form, changed, at, min(self.held, 2 ** (8 * struct.calcsize(form)) - 1))
        return bytes(changed)


def _sizes(content: bytes) -> _Sizes | None:
    """Of the RIFF family, AIFF and AU; None of others, and of what is none."""
    kind, form = content[:4], content[8:12]
    if kind in {b"RIFF", b"RIFX", b"RF64", b"BW64"} and form == b"WAVE":
        return _sizes_in_chunks(content, b"data", ">I" if kind == b"RIFX" else "<I")
    if kind == b"FORM" and form in {b"AIFF", b"AIFC"}:
        return _sizes_in_chunks(content, b"SSND", ">I")
    if kind == b".snd" and len(content) >= 24:
        start, declared = struct.unpack(">II", content[4:12])
        held = max(0, len(content) - start)
        is_unknown = declared == 0xFFFFFFFF
        return _Sizes(declared, held, start, is_unknown, (), is_short=False)
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
            held = len(content) - start
            is_unknown = (size in _UNKNOWN_SIZES and size > held) or (size == 0 and held > 0)
            follows = content[start + size :] if size < held else b""
            is_short = size < held and sound == b"data" and not _is_chunks(follows, size % 2, form)
            # Chunks behind the sound that is declared are no sound.
            return _Sizes(size, held, start, is_unknown and (size > 0 or is_short), tuple(fields), is_short)
        at = start + size + size % 2
    return None


def _is_chunks(content: bytes, padding: int, form: str) -> bool:
    """Whether these bytes are chunks to their end, tags that players append, or nothing."""
    if not content.strip(b"\0") or content[padding:].startswith((b"TAG", b"APETAGEX")):
        return True
    for at in {padding, 0}:  # not everybody pads
        while at + 8 <= len(content) and _CHUNK_NAME.fullmatch(content, at, at + 4):
            (size,) = struct.unpack_from(form, content, at + 4)
            at += 8 + size + size % 2
        if at >= len(content) or (at + 8 > len(content) and not content[at:].strip(b"\0")):
            # One that reaches beyond the file by more than its padding is sound that happens to look like a name.
            return at <= len(content) + 1
    return False


def _lacks_its_last_page(content: bytes) -> bool:
    """Of Ogg: whether the page that ends the stream is missing, or is not whole."""
    if not content.startswith(b"OggS"):
        return False
    at = content.rfind(b"OggS")
    header = content[at : at + 27]
    if len(header) < 27 or not header[5] & 4:
        return True
    lacing = content[at + 27 : at + 27 + header[26]]
    return len(lacing) < header[26] or at + 27 + len(lacing) + sum(lacing) > len(content)


def to_mono(samples: FloatArray, channel: int | None = None) -> tuple[FloatArray, str]:
    """(sample,) the average of the channels (sample, channel), or the one that is asked for, counted from 0; and what
    is to be said of it.

    Where averaging would cancel what the channels hold, since they are of opposite phase, the louder one stands for
    all. Raises AudioFileError for a channel that is not there.
    """
    channels = samples.shape[1]
    if channel is not None:
        if not channel < channels:
            raise AudioFileError(f"it has no channel {channel + 1}, only {channels}")
        return np.ascontiguousarray(samples[:, channel]), ""
    if channels > 1 and (share := _cancelled_share(samples)) > _MOST_CANCELLED:
        louder = int(np.argmax(np.sum(np.square(samples, dtype=np.float64), axis=0)))
        told = (
            f"its {channels} channels cancel each other ({share:.0%} of the sound is of opposite phase); "
            f"channel {louder + 1}, the louder, is played alone"
        )
        return np.ascontiguousarray(samples[:, louder]), told
    return samples.mean(axis=1, dtype=np.float32), ""


_MOST_CANCELLED = 0.1
_STRETCH = 8192
_LEAST_OF_UNRELATED = 0.4


def _cancelled_share(samples: FloatArray) -> float:
    """How much of the energy lies in stretches in which averaging leaves less than 0.4 of what it leaves of channels
    that have nothing to do with each other: of two that are equally loud, a correlation below -0.6."""
    starts = np.arange(0, len(samples), _STRETCH)
    energy = np.add.reduceat(np.square(samples, dtype=np.float64).sum(axis=1), starts)
    of_sum = np.add.reduceat(np.square(samples.sum(axis=1, dtype=np.float64)), starts)
    return float(energy[of_sum < _LEAST_OF_UNRELATED * energy].sum() / max(energy.sum(), 1e-300))
