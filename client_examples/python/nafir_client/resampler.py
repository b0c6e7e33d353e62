"""Resampling by a ratio that may change slowly, as two clocks that drift apart need it.

An output sample is a sum of 32 input samples around its position, weighted by a sinc under a Kaiser window. The weights
are tabulated for 512 fractions of a sample, with linear interpolation between them, which is exact to -100 dB. Phase is
linear. At a ratio of 1 the output is the input, to the sample.
"""

import math

import numpy as np
import numpy.typing as npt

from nafir_client.wire import Samples

_REACH = 16
"""Input samples to each side of an output sample."""
_FRACTIONS = 512
_FADE = 128
_KAISER_BETA = 9.0


def _weights(cutoff: float) -> npt.NDArray[np.float64]:
    """(fraction, tap) weights of the taps, for each fraction of a sample. `cutoff` is a share of the band."""
    fractions = np.arange(_FRACTIONS + 1)[:, None] / _FRACTIONS
    distances = np.arange(1 - _REACH, _REACH + 1)[None] - fractions
    window = np.i0(_KAISER_BETA * np.sqrt(np.clip(1 - (distances / _REACH) ** 2, 0, 1))) / np.i0(_KAISER_BETA)
    weights = cutoff * np.sinc(cutoff * distances) * window
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), np.float64)


class Resampler:
    """Takes samples as they come and gives as many as are asked for. A ratio is input frames per output frame;
    `nominal` is the one around which it will be."""

    def __init__(self, channels: int, nominal: float = 1.0) -> None:
        self._weights = _weights(min(1.0, 1.0 / nominal))
        self._channels = channels
        self._ratio = nominal
        self.reset()

    def reset(self) -> None:
        """Forget all samples; the ratio stays."""
        self._waiting: Samples = np.zeros((_REACH - 1, self._channels), np.float32)
        self._position = float(_REACH - 1)
        """Of the next output sample, in samples of `_waiting`."""

    @property
    def waiting(self) -> int:
        """Input frames that have not been reached yet."""
        return len(self._waiting) - math.floor(self._position)

    def push(self, samples: Samples) -> None:
        """Append samples (frame, channel)."""
        self._waiting = np.concatenate([self._waiting, samples])

    def fade_out(self, fade: Samples) -> None:
        """Multiply the newest samples by a fade (frame, 1), or by its end if fewer wait."""
        length = min(len(fade), self.waiting)
        if length:
            self._waiting[-length:] *= fade[-length:]

    def drop(self, frames: int) -> None:
        """Leave out the oldest frames, at most those that wait; what is heard fades from one place to the other."""
        start = math.floor(self._position) + _REACH
        frames = min(frames, len(self._waiting) - start)
        if frames <= 0:
            return
        fade = min(_FADE, frames, len(self._waiting) - start - frames)
        share = ((np.arange(fade) + 0.5) / fade)[:, None].astype(np.float32) if fade else np.zeros((0, 1), np.float32)
        after = self._waiting[start + frames :].copy()
        after[:fade] = share * after[:fade] + (1 - share) * self._waiting[start : start + fade]
        self._waiting = np.concatenate([self._waiting[:start], after])

    def available(self, ratio: float) -> int:
        """How many frames can be pulled at the least while the ratio changes to this one."""
        last = len(self._waiting) - 1 - _REACH - self._position
        return max(0, math.floor(last / max(ratio, self._ratio)) + 1) if last >= 0 else 0

    def pull(self, frames: int, ratio: float) -> Samples:
        """(frame, channel) the next frames, at most `available`, while the ratio changes steadily to this one."""
        if not frames:
            return np.zeros((0, self._channels), np.float32)
        steps = self._ratio + (ratio - self._ratio) * np.arange(1, frames + 1) / frames
        ends = self._position + np.cumsum(steps)
        positions = np.concatenate([[self._position], ends[:-1]])
        whole = np.floor(positions).astype(np.intp)
        place = (positions - whole) * _FRACTIONS
        below = place.astype(np.intp)
        share = (place - below)[:, None]
        weights = (1 - share) * self._weights[below] + share * self._weights[below + 1]
        reached = np.lib.stride_tricks.sliding_window_view(self._waiting, 2 * _REACH, axis=0)[whole - _REACH + 1]
        samples: Samples = np.einsum("fct,ft->fc", reached, weights, dtype=np.float64).astype(np.float32)
        passed = math.floor(ends[-1]) - _REACH + 1
        self._waiting = self._waiting[passed:]
        self._position, self._ratio = float(ends[-1]) - passed, ratio
        return samples
