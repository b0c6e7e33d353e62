"""What the training loop asks of a kind of field.

Rows count the responses that may be trained on, from 0, in the order of the response set; `rows` of them are given to
most calls because some are held back to watch for overfitting.
"""

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from rich.progress import Progress
from torch import Tensor, nn

Rows = npt.NDArray[np.int64]
Losses = dict[str, Tensor]


class Learner(Protocol):
    """A field, its targets and its loss. The `field` is what a checkpoint keeps: parameters and buffers."""

    @property
    def field(self) -> nn.Module: ...

    def prepare(self, progress: Progress) -> None:
        """Brings targets within reach; whatever is costly to compute is kept beside the responses."""
        ...

    @property
    def prepared_s(self) -> float:
        """Seconds that preparing took, whenever that was."""
        ...

    def initialise(self, rows: Rows, seed: int) -> None:
        """Once, before the first step: normalisation, and whatever training should start from."""
        ...

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Parameters with their weight decay."""
        ...

    def momentum_and_rate(self, fraction: float) -> tuple[float, float]:
        """Adam's first beta, and the share of the learning rate, when that fraction of the training is done."""
        ...

    def epoch(self, rows: Rows, rng: np.random.Generator) -> Rows:
        """What one pass over the rows visits, in order."""
        ...

    def batch(self, rows: Rows, rng: np.random.Generator | None) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Inputs of the field and targets of these rows; without a generator repeatable, for validation."""
        ...

    def validation(self, rows: Rows) -> Rows:
        """Which of the rows held back to look at."""
        ...

    def losses(self, prediction: Tensor, targets: tuple[Tensor, ...]) -> Losses:
        """Weighted parts, to be summed up: means over the batch, float32."""
        ...

    def finish(self, rows: Rows) -> None:
        """Once, after the last step, with the best parameters found."""
        ...
