"""Time-frequency cells: the resolution at which a field predicts, finer where the ear and the sound need it.

The first frames are predicted bin by bin. Later frames are noise whose expected level is smooth, so they are pooled
into cells that widen with time and frequency, and predictions are interpolated linearly between the centres of cells.
Pooling averages the randomness of one realisation away, and leaves a sixth of the numbers to predict.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.cells import Axis
from server.acoustics.codec import Codec

# Widths of cells after the fine frames, in frames and in bins: runs of (width, count); the last run goes to the end.
_FRAME_RUNS = ((2, 8), (4, 8), (8, None))
_BIN_RUNS = ((1, 32), (2, 16), (4, None))


def _edges(total: int, runs: tuple[tuple[int, int | None], ...], start: int = 0) -> npt.NDArray[np.int64]:
    edges = [start]
    for width, count in runs:
        while edges[-1] < total and (count is None or count > 0):
            edges.append(min(total, edges[-1] + width))
            count = None if count is None else count - 1
    return np.array(edges)


@dataclass(frozen=True)
class Cells:
    """The first `fine_frames` are predicted bin by bin, and the first `known_frames` of them with phase.

    There is hardly a phase to learn: of twelve frames of reflections without direct sound, a network learned the phase
    of none (its mean phasors explained less than half a percent). But a graph needs at least one such frame.
    """

    codec: Codec
    fine_frames: int = 24
    known_frames: int = 1

    @cached_property
    def late_frames(self) -> Axis:
        return Axis(_edges(self.codec.frames, _FRAME_RUNS, self.fine_frames))

    @cached_property
    def all_frames(self) -> Axis:
        """Cells over all frames, for interaural coherence; each fine frame is a cell of its own."""
        return Axis(np.concatenate([np.arange(self.fine_frames), self.late_frames.edges]))

    @cached_property
    def bands(self) -> Axis:
        return Axis(_edges(self.codec.bins, _BIN_RUNS))
