"""Time-frequency cells: the resolution at which a field predicts, finer where the ear and the sound need it.

The first frames are predicted bin by bin. Later ones are noise whose expected level is smooth, so they are pooled into
cells that widen with time and frequency; predictions are interpolated linearly between cell centres. Pooling averages
away the noise of one realisation, and there are six times fewer numbers to predict.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.cells import Axis
from server.acoustics.codec import Codec

# Widths in frames after the fine ones, then in bins: (width, count) runs, the last repeated to the end.
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
    """`fine_frames` are predicted bin by bin; `known_frames` of them with phase.

    There is hardly a phase to know: of twelve frames of reflections, without the direct sound, the network learned that
    of none (its mean phasors explained less than half a percent). A graph has to name one frame at least.
    """

    codec: Codec
    fine_frames: int = 24
    known_frames: int = 1

    @cached_property
    def late_frames(self) -> Axis:
        return Axis(_edges(self.codec.frames, _FRAME_RUNS, self.fine_frames))

    @cached_property
    def all_frames(self) -> Axis:
        """Cells over all frames, the fine ones single: for interaural coherence."""
        return Axis(np.concatenate([np.arange(self.fine_frames), self.late_frames.edges]))

    @cached_property
    def bands(self) -> Axis:
        return Axis(_edges(self.codec.bins, _BIN_RUNS))
