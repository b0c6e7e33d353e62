"""Training responses coded by audio codecs, as Luo et al. (NeurIPS 2022) stored them for their baselines: AAC at 24 and
Opus at 12 kbit/s per stream.

About a hundred responses, with silence between them, are coded into one file, which is faster than one file per
response. The delay that a codec adds at the start is removed by the decoder, as the container specifies. Files are made
when a response in them is needed, and are stored beside the dataset.

Axes: the responses of one pair are `(yaw, channel, sample)`.
"""

import hashlib
import shutil
import subprocess
import tempfile
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import soundfile

from training.baselines.held_out import EvaluationError, HeldOut

_GAP_S = 0.1  # longer than the windows of either codec
_PER_FILE = 96  # responses
_SAMPLED_FILES = 8
_PEAK = 0.5  # a coded wave may overshoot what went in
_OPEN_FILES = 30

Track = Callable[[range, str], Iterable[int]]


@dataclass(frozen=True)
class AudioCodec:
    """encode and decode are command lines, in which `{source}`, `{target}` and `{rate}` stand for the files and the
    sample rate. The source of the first and the target of the second are WAV files of floats."""

    name: str
    suffix: str
    encode: tuple[str, ...]
    decode: tuple[str, ...]

    @property
    def is_installed(self) -> bool:
        return all(shutil.which(command[0]) for command in (self.encode, self.decode))

    def run(self, command: tuple[str, ...], source: Path, target: Path, rate: int) -> None:
        """Raises EvaluationError if the program is missing or fails."""
        filled = [part.format(source=source, target=target, rate=rate) for part in command]
        try:
            subprocess.run(filled, check=True, capture_output=True, text=True)
        except FileNotFoundError as exc:
            raise EvaluationError(f"{self.name}: needs the program {filled[0]}, which is not installed") from exc
        except subprocess.CalledProcessError as exc:
            last = (exc.stderr.strip().splitlines() or ["no message"])[-1]
            raise EvaluationError(f"{self.name}: {filled[0]} failed: {last}") from exc


_FFMPEG = ("ffmpeg", "-nostdin", "-v", "error", "-y", "-i", "{source}", "-threads", "1")
_TO_WAV = (*_FFMPEG, "-ar", "{rate}", "-c:a", "pcm_f32le", "{target}")
AAC = AudioCodec("aac", ".m4a", (*_FFMPEG, "-c:a", "aac", "-b:a", "24k", "{target}"), _TO_WAV)
OPUS = AudioCodec(
    "opus",
    ".opus",
    ("opusenc", "--quiet", "--bitrate", "12", "--cvbr", "--music", "--comp", "10", "{source}", "{target}"),
    ("opusdec", "--quiet", "--float", "--rate", "{rate}", "{source}", "{target}"),
)
_LIKE_MUSIC = ("-vbr", "constrained", "-application", "audio", "-compression_level", "10")
_OPUS_OF_FFMPEG = AudioCodec(
    "opus", ".opus", (*_FFMPEG, "-c:a", "libopus", "-b:a", "12k", *_LIKE_MUSIC, "{target}"), _TO_WAV
)


def opus() -> AudioCodec:
    """opus-tools with the paper's settings (constrained variable bit rate, music, complexity 10) if they are installed,
    otherwise ffmpeg with the same encoder. ffmpeg cannot tell it that the signal is music, so at this bit rate it codes
    most frames with its speech coder (SILK), and opus-tools all with CELT."""
    return _OPUS_OF_FFMPEG if not OPUS.is_installed and _OPUS_OF_FFMPEG.is_installed else OPUS


class CodedResponses:
    """The training pairs of a dataset after coding and decoding, by pair. Several threads may use one."""

    def __init__(self, codec: AudioCodec, held_out: HeldOut, *, track: Track = lambda files, _: files) -> None:
        """Codes a few files, evenly spread over all. Raises EvaluationError if the codec's program is missing or fails,
        as reading a pair does, too."""
        self._codec = codec
        self._held_out = held_out
        self._slot = held_out.samples + round(_GAP_S * held_out.sample_rate)
        training = np.flatnonzero(held_out.pairs.training)
        per_file = max(1, _PER_FILE // len(held_out.yaws))
        files = range(0, len(training), per_file)
        self._pairs = [training[start : start + per_file] for start in files]
        self._place = {int(pair): divmod(number, per_file) for number, pair in enumerate(training)}
        self._decoded: OrderedDict[int, npt.NDArray[np.float16]] = OrderedDict()
        self._locks = [threading.Lock() for _ in self._pairs]
        self._lock = threading.Lock()
        self._folder = held_out.folder / "coded" / f"{codec.name}-{self._digest()[:16]}"
        self._folder.mkdir(parents=True, exist_ok=True)
        sampled = np.linspace(0, len(self._pairs) - 1, min(_SAMPLED_FILES, len(self._pairs))).round().astype(int)
        self._sampled = [int(number) for number in sampled]
        for index in track(range(len(self._sampled)), f"coding ({codec.name})"):
            self._ensure_coded(self._sampled[index])

    @property
    def storage_bytes(self) -> int:
        """The estimated size of all coded responses, from the files that were coded first, with four bytes per response
        for its gain."""
        sampled = sum(self._path(number).stat().st_size for number in self._sampled)
        of_sampled, of_all = (
            sum(len(self._pairs[number]) for number in numbers) for numbers in (self._sampled, range(len(self._pairs)))
        )
        return round(sampled * of_all / of_sampled) + of_all * len(self._held_out.yaws) * 4

    def decoding_ms(self) -> float:
        """Milliseconds per response, measured now on a whole file."""
        start = time.perf_counter()
        self._read(0)
        return 1e3 * (time.perf_counter() - start) / (len(self._pairs[0]) * len(self._held_out.yaws))

    def __getitem__(self, pair: int) -> npt.NDArray[np.float16]:
        """(yaw, channel, sample)"""
        file, position = self._place[pair]
        with self._locks[file]:
            with self._lock:
                decoded = self._decoded.get(file)
            if decoded is None:
                self._ensure_coded(file)
                decoded = self._read(file)
            with self._lock:
                self._decoded[file] = decoded
                self._decoded.move_to_end(file)
                while len(self._decoded) > _OPEN_FILES:
                    self._decoded.popitem(last=False)
        return np.asarray(decoded[position])

    def _digest(self) -> str:
        held_out = self._held_out
        described = repr((self._codec, held_out.sample_rate, held_out.samples, held_out.channels, _GAP_S, _PEAK))
        digest = hashlib.sha256(described.encode())
        digest.update(held_out.pairs.training.tobytes())
        for pair in np.flatnonzero(held_out.pairs.training)[[0, -1]]:
            digest.update(held_out.pairs.response(int(pair)).tobytes())
        return digest.hexdigest()

    def _path(self, number: int) -> Path:
        return self._folder / f"{number:04d}{self._codec.suffix}"

    def _ensure_coded(self, number: int) -> None:
        """Codes a file unless it exists. The file gets its final name when it is whole, and after its gains, so that an
        interrupted run can be resumed."""
        if self._path(number).exists():
            return
        held_out = self._held_out
        responses = np.concatenate([held_out.pairs.response(int(pair)) for pair in self._pairs[number]])
        peaks = np.maximum(np.abs(responses).max(axis=(1, 2)), 1e-9)
        signal = np.zeros((len(responses), self._slot, held_out.channels), dtype=np.float32)
        signal[:, : held_out.samples] = np.swapaxes(responses * (_PEAK / peaks)[:, None, None], 1, 2)
        with tempfile.TemporaryDirectory(dir=self._folder) as scratch:
            source, target = Path(scratch) / "plain.wav", Path(scratch) / f"coded{self._codec.suffix}"
            soundfile.write(source, signal.reshape(-1, held_out.channels), held_out.sample_rate, subtype="FLOAT")
            self._codec.run(self._codec.encode, source, target, held_out.sample_rate)
            np.save(self._gains(number), (peaks / _PEAK).astype(np.float32))
            target.replace(self._path(number))

    def _gains(self, number: int) -> Path:
        return self._folder / f"{number:04d}.npy"

    def _read(self, number: int) -> npt.NDArray[np.float16]:
        """(pair, yaw, channel, sample)"""
        held_out = self._held_out
        with tempfile.TemporaryDirectory() as scratch:
            target = Path(scratch) / "decoded.wav"
            self._codec.run(self._codec.decode, self._path(number), target, held_out.sample_rate)
            signal, _ = soundfile.read(target, dtype="float32", always_2d=True)
        gains = np.load(self._gains(number))
        whole = np.zeros((len(gains) * self._slot, held_out.channels), dtype=np.float32)
        kept = min(len(whole), len(signal))
        whole[:kept] = signal[:kept, : held_out.channels]
        responses = np.swapaxes(whole.reshape(len(gains), self._slot, -1)[:, : held_out.samples], 1, 2)
        responses = responses * gains[:, None, None]
        rows = responses.reshape(len(self._pairs[number]), len(held_out.yaws), *responses.shape[1:])
        return np.asarray(rows, np.float16)
