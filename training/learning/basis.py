"""What the learners of fields with a learned basis have in common: initial normalisation and basis, optimiser, and the
correction of levels after training."""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from training.data.responses import ResponseSet
from training.learning.learner import Rows
from training.learning.schedule import one_cycle
from training.models.basis_field import BasisField
from training.models.cells import Cells
from training.models.level_correction import band_correction, band_levels, level_correction
from training.models.stored_targets import Targets

TARGETS = "targets"
"""The folder of targets, inside that of the dataset."""
_WEIGHT_DECAY = 1e-2
_SAMPLE_ROWS = 3000


class BasisLearner(ABC):
    """Learns from targets that are computed once and stored beside the responses.

    `spreads` and `weights` are those of each head: the unit in which its errors are measured, and the weight of their
    squares. `decode` gives levels after decoding from predicted ones; without it levels are not corrected.
    """

    responses: ResponseSet
    cells: Cells

    def __init__(
        self,
        field: BasisField,
        spreads: Mapping[str, float],
        weights: Mapping[str, float],
        decode: nn.Module | None,
    ) -> None:
        self.field = field
        self._spreads, self._weights, self._decode = spreads, weights, decode
        self._targets: Targets | None = None

    def to(self, device: torch.device) -> None:
        self.field.to(device)

    @property
    def prepared_s(self) -> float:
        return self.targets.seconds

    @property
    def targets(self) -> Targets:
        if self._targets is None:
            raise RuntimeError("prepare comes first")
        return self._targets

    @torch.no_grad()
    def initialise(self, rows: Rows, seed: int) -> None:
        """Set the normalisation, and a basis that begins with the principal components of the training
        targets."""
        field = self.field
        sample = np.sort(np.random.default_rng([seed, 4]).choice(rows, min(_SAMPLE_ROWS, len(rows)), replace=False))
        flat = self._flat(sample) - self._losses_between(sample) @ field.bands
        field.mean.copy_(flat.mean(dim=0))
        for name, part in field.heads.slices.items():
            field.spread[part] = self._spreads[name]
        normalised = (flat.to(field.mean.device) - field.mean) / field.spread
        rank = field.basis.shape[0]
        _, singular, basis = torch.svd_lowrank(normalised, q=min(rank, *normalised.shape), niter=2)
        field.basis[: basis.shape[1]] = basis.T * (singular / len(sample) ** 0.5)[:, None]

    def _losses_between(self, rows: Rows) -> Tensor:
        """(row, band) what levels lose by the doors between both ends, before training."""
        return torch.zeros(len(rows), len(self.field.bands))

    def parameter_groups(self) -> list[dict[str, Any]]:
        return [{"params": list(self.field.parameters()), "weight_decay": _WEIGHT_DECAY}]

    def momentum_and_rate(self, fraction: float) -> tuple[float, float]:
        return one_cycle(fraction)

    def validation(self, rows: Rows) -> Rows:
        return rows

    @abstractmethod
    def batch(self, rows: Rows, rng: np.random.Generator | None) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        """Inputs of the field, and targets of which the first are flat, for these rows."""

    @torch.no_grad()
    def finish(self, rows: Rows) -> None:
        """Correct predicted levels by their mean deficit over the training set, and those of bands by what is lacking
        then."""
        if self._decode is None:
            return
        field, areas = self.field, self.field.heads.areas
        decode, levels = self._decode.to(field.mean.device), field.heads.levels
        sample = rows[:: max(1, len(rows) // _SAMPLE_ROWS)]

        def examples() -> Iterator[tuple[Tensor, Tensor, Tensor]]:
            for true, predicted, features in self._predicted(sample):
                yield true, predicted, field.encoder.sight(features)

        correction = level_correction(examples, decode, areas)
        field.level_correction[:, levels] = correction
        if not len(field.bands):
            return
        hidden, lacking = [], []
        bands = field.bands[:, levels]
        for true, predicted, features in self._predicted(self.validation(rows)):
            corrected = predicted + torch.lerp(correction[0], correction[1], field.encoder.sight(features))
            hidden.append(field.hidden(features))
            lacking.append(band_levels(true, areas, bands) - band_levels(decode(corrected), areas, bands))
        field.band_correction.copy_(band_correction(torch.cat(hidden), torch.cat(lacking)))

    def _predicted(self, rows: Rows) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        """Batches of true levels, predicted levels without corrections, and the encoder's features."""
        field, levels = self.field, self.field.heads.levels
        device = field.mean.device
        for start in range(0, len(rows), 256):
            poses, (flat, *_) = self.batch(rows[start : start + 256], None)
            features = field.encoder(*(pose.to(device) for pose in poses))
            predicted = field.in_physical_units(field.from_features(features))
            yield flat[:, levels].to(device).float(), predicted[:, levels], features

    def _flat(self, rows: Rows) -> Tensor:
        """(row, heads.size) flat targets."""
        return torch.from_numpy(self.targets.flat[rows]).float()

    def _head_errors(self, prediction: Tensor, flat: Tensor, counted: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The weighted mean squared errors (B,) of each head, for normalised predictions of targets in physical units.
        Heads in `counted` count only the rows (B,) that it marks."""
        field = self.field
        off = prediction - (flat - field.mean) / field.spread
        squared = off * off  # its gradient is faster than that of a power
        errors = {}
        # Split in place of slicing, because the gradient of each slice would be as wide as the whole.
        for name, part in zip(field.heads.shapes, squared.split(field.heads.sizes, dim=1), strict=True):
            of_rows = part.mean(dim=1)
            errors[name] = self._weights[name] * (of_rows * counted[name] if name in counted else of_rows)
        return errors

    def _levels_of(self, prediction: Tensor) -> Tensor:
        """Predicted levels in physical units."""
        field, levels = self.field, self.field.heads.levels
        return prediction[:, levels] * field.spread[levels] + field.mean[levels]
