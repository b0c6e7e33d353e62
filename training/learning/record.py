"""How far a run was trained, and whether its error on held-back pairs was still falling when it ended.

An exported graph keeps such a record in its metadata, so that a table can tell how far from its end each network is.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Self

import numpy as np

MeasuredLoss = tuple[int, float]
"""A step, and the validation error after it."""

RECIPE_EPOCHS, RECIPE_POINTS = 200, 2000
"""The paper's recipe: this many epochs, each of which visits every training pair once at a random orientation, and this
many points of each response that is visited. Its steps have 20 responses."""
RECORD = "training"
"""The name of the record in a graph's metadata."""


@dataclass(frozen=True)
class TrainingRecord:
    """epochs: passes over the pairs that are trained on. points: points of responses that all steps saw, None if steps
    see whole responses. recipe_share: those points as a share of the paper's recipe on all of the training pairs, for a
    network of the paper. held_back_loss: loss on pairs that are not trained on, of the parameters that were kept.
    mean_loss: that of the training set's mean. slope_per_doubling: its change per doubling of steps, over the last
    doubling. patience: rounds without a smaller loss after which the run was to stop, and `stopped` whether it did."""

    field: str
    epochs: float
    steps: int
    points: int | None
    recipe_share: float | None
    held_back_loss: float | None
    mean_loss: float | None
    slope_per_doubling: float | None
    patience: int | None
    stopped: bool

    @classmethod
    def from_json(cls, text: str) -> Self:
        return cls(**json.loads(text))

    def to_json(self) -> str:
        return json.dumps(asdict(self))

    def sentence(self) -> str:
        """What a table says of the network, after its name."""
        parts = [f"{self.steps:,} steps, {self.epochs:.3g} epochs"]
        if self.points is not None and self.recipe_share is not None:
            parts.append(f"{self.points:,} points, {100 * self.recipe_share:.2g} % of the paper's recipe")
        if self.held_back_loss is not None:
            loss = f"held-back loss {self.held_back_loss:.4f}"
            if self.mean_loss is not None:
                loss += f" (the training set's mean: {self.mean_loss:.4f})"
            parts.append(loss)
        if self.slope_per_doubling is not None:
            parts.append(f"{self.slope_per_doubling:+.4f} per doubling of steps at the end")
        parts.append(self._end())
        return "; ".join(parts)

    def _end(self) -> str:
        if self.patience is None:
            return "ended by its length, not because the loss had stopped falling"
        rounds = "round" if self.patience == 1 else "rounds"
        if self.stopped:
            return f"ended after {self.patience} {rounds} without a smaller loss"
        return f"ended by its length, before {self.patience} {rounds} without a smaller loss"


def slope_per_doubling(curve: Sequence[MeasuredLoss]) -> float | None:
    """The change of the loss per doubling of steps at the end of a curve: the slope of the line through its last
    doubling, by least squares over the logarithm of the step. None if that has fewer than two points."""
    if not curve:
        return None
    last = [(math.log2(step), loss) for step, loss in curve if step >= curve[-1][0] / 2 and step > 0]
    if len(last) < 2:
        return None
    steps, losses = np.array(last).T
    off = steps - steps.mean()
    return float(off @ losses / (off @ off))
