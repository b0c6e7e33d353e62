"""The interface between the training loop and a kind of field.

Rows count the responses that are not held out, from 0, in the order of the response set. Most calls take the `rows` to
use, because some rows are for validation.
"""

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from rich.progress import Progress
from torch import Tensor, nn

Rows = npt.NDArray[np.int64]
Losses = dict[str, Tensor]


class Learner(Protocol):
    """A field, its targets and its loss. A checkpoint stores the parameters and buffers of `field`."""

    @property
    def field(self) -> nn.Module: ...

    def prepare(self, progress: Progress) -> None:
        """Compute targets, or load them. Results that take long are stored beside the responses."""
        ...

    def to(self, device: torch.device) -> None:
        """Move the field to the device, and what batches are made of if it has room; after `prepare`."""
        ...

    @property
    def prepared_s(self) -> float:
        """Seconds that preparation took when it was first done."""
        ...

    def initialise(self, rows: Rows, seed: int) -> None:
        """Set the normalisation and initial parameters; called once before the first step."""
        ...

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return groups of parameters with their weight decay."""
        ...

    def momentum_and_rate(self, fraction: float) -> tuple[float, float]:
        """Return Adam's first beta, and the share of the learning rate, when a `fraction` of the training is done."""
        ...

    def epoch(self, rows: Rows, rng: np.random.Generator) -> Rows:
        """Return the rows that one epoch visits, in order."""
        ...

    def batch(self, rows: Rows, rng: np.random.Generator | None) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Return inputs of the field, and targets, for these rows. Without a generator the result is repeatable, for
        validation."""
        ...

    def validation(self, rows: Rows) -> Rows:
        """Return the validation rows that are used."""
        ...

    def losses(self, prediction: Tensor, targets: tuple[Tensor, ...]) -> Losses:
        """Return weighted terms of the loss: means over the batch, float32. While the field is trained, examples need
        not count alike in these means; in validation they do."""
        ...

    def finish(self, rows: Rows) -> None:
        """Complete the field; called once after the last step, with the parameters that are kept."""
        ...
