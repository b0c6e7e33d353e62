"""The dry music of a listening test: stretches of clips, as long as a sound shall be, that are not silent."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from server.assets.clips import ClipLibrary, DecodeError, decode
from server.core.near_names import suggestion
from training.baselines.held_out import EvaluationError
from training.listening.loudness import loudness_lufs

DEFAULT_CLIPS = ("trumpet",)
_SILENT_LUFS = -60.0
_QUIETER_LU = 3.0
_STEP_S = 0.25
_FADE_S = 0.02


class Music:
    """Clips by name, and the stretches of each that are nearly as loud as the whole."""

    def __init__(self, clips: Sequence[str], sample_rate: int, seconds: float) -> None:
        """`clips` are names of bundled clips, or audio files. Raises EvaluationError for one that is unknown, too
        short, or silent."""
        self._sample_rate = sample_rate
        self._length = round(seconds * sample_rate)
        library = ClipLibrary(sample_rate)
        self._clips: dict[str, npt.NDArray[np.float32]] = {}
        for clip in clips:
            samples = _read(clip, library, sample_rate)
            if samples.size < self._length:
                raise EvaluationError(
                    f"--clip: {clip} is {samples.size / sample_rate:.1f} s long, and each sound takes {seconds:g} s: "
                    "give a longer one, or fewer --seconds"
                )
            name = " ".join(clip.split()) if clip in library.names else " ".join(Path(clip).stem.split())
            self._clips[name] = samples
        self._starts = {name: self._loud_starts(name, samples) for name, samples in self._clips.items()}

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self._clips)

    def stretch(self, name: str, rng: np.random.Generator) -> npt.NDArray[np.float64]:
        """(sample,) a stretch of the clip, faded in and out."""
        start = int(rng.choice(self._starts[name]))
        samples = self._clips[name][start : start + self._length].astype(np.float64)
        fade = 0.5 - 0.5 * np.cos(np.pi * np.arange(round(_FADE_S * self._sample_rate)) / (_FADE_S * self._sample_rate))
        samples[: len(fade)] *= fade
        samples[-len(fade) :] *= fade[::-1]
        return samples

    def _loud_starts(self, name: str, samples: npt.NDArray[np.float32]) -> list[int]:
        whole = loudness_lufs(samples[None], self._sample_rate)
        if whole < _SILENT_LUFS:
            raise EvaluationError(f"--clip: {name} is silent ({whole:.0f} LUFS): give one that is to be heard")
        starts = range(0, len(samples) - self._length + 1, round(_STEP_S * self._sample_rate))
        loud = {
            start: loudness_lufs(samples[None, start : start + self._length], self._sample_rate) for start in starts
        }
        least = min(whole, max(loud.values())) - _QUIETER_LU
        return [start for start, lufs in loud.items() if lufs >= least]


def _read(clip: str, library: ClipLibrary, sample_rate: int) -> npt.NDArray[np.float32]:
    if clip in library.names:
        return library.load(clip).samples
    if not Path(clip).is_file():
        hint = suggestion(clip, library.names)
        raise EvaluationError(f"--clip: there is neither a clip nor a file {clip!r}{hint}")
    try:
        return decode(Path(clip), sample_rate).samples
    except DecodeError as exc:
        raise EvaluationError(f"--clip: {exc}") from exc
