"""The buffer between the network and a sound card: never waits, and corrects for clocks that differ.

Blocks come in bursts and late; a sound card asks for frames when it needs them, by a clock of its own. What counts is
how much is left at the worst moment: the *reserve*, the least that was left after any read of the last four seconds.
A controller holds the reserve at a small target by playing up to 0.3 % faster or slower: five cents, which is not
heard. So the delay is as short as the network allows. If the buffer runs dry all the same, the target grows, and
shrinks again slowly.
"""

from collections import deque
from typing import Final

import numpy as np

from nafir_client.resampler import Resampler
from nafir_client.wire import Block, Samples

MOST_CHANGE: Final = 0.003
"""By how much the speed may be off: five cents."""
_GAIN_PER_S: Final = 0.1
"""Change of speed per second of reserve too much: a tenth of it is gone in a second. A drift of 100 ppm so costs a
millisecond."""
_PERIOD_S: Final = 0.5
_PERIODS: Final = 8
"""The reserve is the least of so many periods."""
_FADE_S: Final = 0.003
_GROWTH: Final = 2.0
_SHRINK_PER_S: Final = 0.998


class JitterBuffer:
    """One thread may push while another reads; neither waits for the other.

    `least_s` is the least reserve to aim for, and `longest_s` the most that may wait: of more, the oldest is left out.
    `output_rate` is the sound card's, by default the stream's.
    """

    def __init__(
        self,
        sample_rate: int,
        channels: int,
        *,
        output_rate: int | None = None,
        least_s: float = 0.01,
        longest_s: float = 0.5,
    ) -> None:
        self._rate = sample_rate
        self._channels = channels
        self._nominal = sample_rate / (output_rate or sample_rate)
        self._least_s = least_s
        self._longest = round(longest_s * sample_rate)
        # 128 frames is the shortest block.
        self._arrived: deque[Block] = deque(maxlen=2 * self._longest // 128)
        self._resampler = Resampler(channels, self._nominal)
        self._next_clock: int | None = None
        self._is_playing = False
        self._speed = 1.0
        self._target_s = 2 * least_s
        self._period = self._period_left = _PERIOD_S * sample_rate
        self._least_left: float | None = None
        self._reserves: deque[float] = deque(maxlen=_PERIODS)
        length = round(_FADE_S * sample_rate)
        rising = np.sin(0.5 * np.pi * (np.arange(length) + 0.5) / length) ** 2
        self._fade = rising[:, None].astype(np.float32)
        self.underruns = 0
        """How often there was too little to play."""
        self.frames_dropped = 0
        """Frames left out because too many waited."""

    @property
    def delay_s(self) -> float:
        """How long a sample that arrives now will wait, after the last read."""
        return self._resampler.waiting / self._rate + sum(block.frames for block in tuple(self._arrived)) / self._rate

    @property
    def speed(self) -> float:
        """How fast it is played, relative to the stream's clock as the sound card's says."""
        return self._speed

    def push(self, block: Block) -> None:
        self._arrived.append(block)

    def read(self, frames: int) -> Samples:
        """(frame, channel) the next frames at the output's rate, or silence."""
        self._take_arrived()
        starts = not self._is_playing
        if starts:
            if self._resampler.waiting < frames * self._nominal + self._target_s * self._rate:
                return np.zeros((frames, self._channels), np.float32)
            self._is_playing = True
        ratio = self._nominal * self._speed
        available = self._resampler.available(ratio)
        samples = self._resampler.pull(min(frames, available), ratio)
        if starts:
            length = min(len(samples), len(self._fade))
            samples[:length] *= self._fade[:length]
        if available < frames:
            return self._run_dry(frames, samples)
        self._control(frames)
        return samples

    def _take_arrived(self) -> None:
        while self._arrived:
            block = self._arrived.popleft()
            samples = block.samples
            missing = 0 if self._next_clock is None else block.sample_clock - self._next_clock
            if missing and self._is_playing:
                self._resampler.fade_out(self._fade[::-1])
                samples = samples.copy()
                length = min(len(samples), len(self._fade))
                samples[:length] *= self._fade[:length]
                # The server has left blocks out, whose time passes all the same.
                self._resampler.push(np.zeros((min(max(0, missing), self._longest), self._channels), np.float32))
            self._next_clock = block.sample_clock + block.frames
            self._resampler.push(samples)
        excess = self._resampler.waiting - self._longest
        if excess > 0:
            # So much more that it does not come to this at every block.
            frames = min(self._resampler.waiting, excess + self._longest // 2)
            self._resampler.drop(frames)
            self.frames_dropped += frames

    def _run_dry(self, frames: int, last: Samples) -> Samples:
        """What there is, faded out, and silence. Afterwards the buffer fills up again."""
        length = min(len(last), len(self._fade))
        if length:
            last[-length:] *= self._fade[::-1][-length:]
        self.underruns += 1
        self._is_playing = False
        self._target_s = min(self._target_s * _GROWTH, self._longest / self._rate / 2)
        self._reserves.clear()
        self._least_left, self._period_left, self._speed = None, self._period, 1.0
        return np.concatenate([last, np.zeros((frames - len(last), self._channels), np.float32)])

    def _control(self, frames: int) -> None:
        """Measure the reserve, and choose the speed once a period."""
        left = float(self._resampler.waiting)
        self._least_left = left if self._least_left is None else min(self._least_left, left)
        self._period_left -= frames * self._nominal
        if self._period_left > 0:
            return
        self._reserves.append(self._least_left / self._rate)
        self._least_left, self._period_left = None, self._period
        self._target_s = max(self._least_s, self._target_s * _SHRINK_PER_S**_PERIOD_S)
        excess_s = min(self._reserves) - self._target_s
        self._speed = 1 + min(MOST_CHANGE, max(-MOST_CHANGE, _GAIN_PER_S * excess_s))
