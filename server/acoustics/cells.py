"""Cells: runs of consecutive frames or frequency bins, each represented by one value."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class Axis:
    """A partition of consecutive steps into cells. `edges` holds the first step of each cell and, last, the end."""

    edges: npt.NDArray[np.int64]

    @property
    def cells(self) -> int:
        return len(self.edges) - 1

    @property
    def widths(self) -> npt.NDArray[np.int64]:
        return np.diff(self.edges)

    def pool(self) -> npt.NDArray[np.float32]:
        """(step, cell) matrix that averages steps into cells; steps count from the first edge."""
        step = np.arange(self.edges[0], self.edges[-1])[:, None]
        inside = (step >= self.edges[:-1]) & (step < self.edges[1:])
        return (inside / self.widths).astype(np.float32)

    def spread(self) -> npt.NDArray[np.float32]:
        """(cell, step) matrix that interpolates linearly between cell centres; constant beyond the outermost
        centres."""
        centres = (self.edges[:-1] + self.edges[1:] - 1) / 2
        steps = np.arange(self.edges[0], self.edges[-1])
        later = np.clip(np.searchsorted(centres, steps), min(1, self.cells - 1), self.cells - 1)
        before = np.maximum(later - 1, 0)
        apart = np.where(later > before, centres[later] - centres[before], 1.0)
        share = np.clip((steps - centres[before]) / apart, 0, 1)
        weights = np.zeros((self.cells, len(steps)), dtype=np.float32)
        weights[later, steps - self.edges[0]] = share
        weights[before, steps - self.edges[0]] += (1 - share).astype(np.float32)
        return weights
