"""Decodes an uploaded file in a process of its own, into a wav file that the server reads without danger.

Decoders are large C libraries, and an upload may be made to break them. So the process may take only so much memory,
processor time and disk, and whatever becomes of it, the server only learns that the file cannot be decoded. What a file
is and how long, is read from its header first: more than is allowed is refused before room is made for it.

    python -m server.assets.upload_decoder FILE TARGET LIMITS

`LIMITS` are those of `DecodingLimits` in JSON. The answer is one line of JSON: `Decoded`, or a `code` and a `detail`.
"""

import asyncio
import contextlib
import json
import math
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Final

import soundfile

from server.assets.audio_file import AudioFileError
from server.assets.clips import read_mono
from server.core.errors import RequestError
from server.runtime.priority import become_background

FORMATS: Final = {"WAV": "wav", "WAVEX": "wav", "RF64": "wav", "FLAC": "flac", "OGG": "ogg", "MP3": "mp3"}
"""The formats that are taken, by libsndfile's names. Ogg files hold Vorbis, Opus or FLAC."""
LOWEST_RATE_HZ, HIGHEST_RATE_HZ = 8_000, 192_000
_MEMORY_BYTES = 2**30
"""Memory for decoding, besides what the process has when it begins."""
_ANSWER_BYTES = 64 * 1024


@dataclass(frozen=True)
class DecodingLimits:
    """The longest file, the most channels, and the most samples over all channels; and how long decoding may take."""

    seconds: float
    channels: int = 8
    values: int = 2**25
    decoding_s: float = 20.0


@dataclass(frozen=True)
class Decoded:
    """A wav file of mono float samples at the upload's rate. `warning` says what was odd about the upload, or is
    empty."""

    frames: int
    sample_rate: int
    warning: str

    @property
    def duration_s(self) -> float:
        return self.frames / self.sample_rate


class TooLongError(AudioFileError):
    """The file has more samples or channels than allowed."""


def within(limits: DecodingLimits, file: soundfile.SoundFile) -> int:
    """How many samples, over all channels, may be read of a file with this header. Raises AudioFileError if it is of
    another format, and TooLongError if it holds more than that."""
    if file.format not in FORMATS:
        taken = ", ".join(dict.fromkeys(FORMATS.values()))
        raise AudioFileError(f"its format is {file.format}, and none of {taken} (with Vorbis, Opus or FLAC in ogg)")
    if file.channels > limits.channels:
        raise TooLongError(f"it has {file.channels} channels; at most {limits.channels} are taken")
    if not LOWEST_RATE_HZ <= file.samplerate <= HIGHEST_RATE_HZ:
        allowed = f"{LOWEST_RATE_HZ} to {HIGHEST_RATE_HZ} Hz"
        raise AudioFileError(f"its sample rate is {file.samplerate} Hz; {allowed} are taken")
    most = min(math.ceil(limits.seconds * file.samplerate), limits.values // file.channels)
    if file.frames > most:
        lasts, may = f"it lasts {file.frames / file.samplerate:.3g} s", f"{most / file.samplerate:.3g} s"
        of_this = f"of {file.channels} channels at {file.samplerate} Hz"
        raise TooLongError(f"{lasts}; {of_this} at most {may} are taken")
    return int(most * file.channels)


async def decode_apart(source: Path, target: Path, limits: DecodingLimits) -> Decoded:
    """Decode `source` into `target` in a process of its own, which ends with this call at the latest. Raises
    RequestError undecodable_clip, or clip_too_long."""
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", __name__, str(source), str(target), json.dumps(asdict(limits))),
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    assert process.stdout is not None
    try:
        async with asyncio.timeout(limits.decoding_s):
            line = await process.stdout.read(_ANSWER_BYTES)
            await process.wait()
    except TimeoutError:
        raise RequestError("undecodable_clip", f"decoding it took longer than {limits.decoding_s:g} s") from None
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
        await process.wait()
    try:
        answer = json.loads(line)
        return Decoded(int(answer["frames"]), int(answer["sample_rate"]), str(answer["warning"]))
    except KeyError:
        status = 507 if answer["code"] == "storage_failed" else 422
        raise RequestError(answer["code"], answer["detail"], status=status) from None
    except ValueError:
        failed = "its decoder failed: the file is damaged, or it takes too much"
        raise RequestError("undecodable_clip", failed) from None


class _Target:
    """A file for libsndfile to write, which would lose what the disk says: its first error is kept."""

    def __init__(self, file: IO[bytes]) -> None:
        self.error: OSError | None = None
        self.seek, self.tell = file.seek, file.tell
        self._file = file

    def write(self, data: bytes) -> int:
        if self.error is None:
            try:
                return self._file.write(data)
            except OSError as exc:
                self.error = exc
        return 0


def decode_file(source: Path, target: IO[bytes], limits: DecodingLimits) -> Decoded:
    """Decode in this process. Raises AudioFileError, and OSError if the disk does not take it."""
    samples, rate, warnings = read_mono(source, limit=lambda file: within(limits, file))
    written = _Target(target)
    try:
        soundfile.write(written, samples, rate, format="WAV", subtype="FLOAT")
    except (AssertionError, soundfile.LibsndfileError):  # it counts what was written by an assertion
        if written.error is None:
            raise
    if written.error is not None:
        raise written.error
    return Decoded(len(samples), rate, "; ".join(warnings))


def _confine(limits: DecodingLimits) -> None:
    """Limit what this process may take, where the system can."""
    become_background()
    try:
        import resource
    except ImportError:  # not a POSIX system
        return
    if sys.platform == "linux":
        taken = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (taken + _MEMORY_BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_CPU, (math.ceil(limits.decoding_s),) * 2)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4 * limits.values + 4096,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def main(arguments: Sequence[str]) -> None:
    """Write the answer to standard output."""
    source, target, limits_text = arguments
    limits = DecodingLimits(**json.loads(limits_text))
    _confine(limits)
    answer: dict[str, object]
    try:
        with Path(target).open("wb") as file:
            answer = asdict(decode_file(Path(source), file, limits))
            file.flush()
            os.fsync(file.fileno())
    except TooLongError as exc:
        answer = {"code": "clip_too_long", "detail": str(exc)}
    except AudioFileError as exc:
        answer = {"code": "undecodable_clip", "detail": str(exc)}
    except MemoryError:
        answer = {"code": "undecodable_clip", "detail": "decoding it takes more memory than an upload may"}
    except (OSError, soundfile.LibsndfileError) as exc:
        problem = exc.strerror if isinstance(exc, OSError) else exc  # not where the server has its files
        answer = {"code": "storage_failed", "detail": f"the decoded sound could not be written: {problem}"}
    sys.stdout.write(json.dumps(answer))


if __name__ == "__main__":
    main(sys.argv[1:])
