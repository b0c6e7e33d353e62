"""A field whose flat output is a product: a network gives K coefficients of a pose, of a learned basis with one row for
each (a branch-trunk network). What the output means is up to the field's heads."""

import copy
from typing import Protocol, Self

import numpy as np
import torch
from torch import Tensor, nn

from training.models.encoders import FieldShape, PathEncoder, PoseEncoder
from training.models.level_correction import PowerBalance


class Layout(Protocol):
    """The layout of a flat output. `shapes`, `sizes` and `slices` are those of each head, in order; `levels` is the
    part that holds natural logarithms of magnitude, each of which stands for as many time-frequency bins as `areas`
    says."""

    shapes: dict[str, tuple[int, ...]]
    sizes: list[int]
    slices: dict[str, slice]
    levels: slice
    areas: Tensor
    size: int


def tile(shapes: dict[str, tuple[int, ...]]) -> tuple[list[int], dict[str, slice]]:
    """Sizes and slices of heads that follow each other in a flat output."""
    sizes = [int(np.prod(shape)) for shape in shapes.values()]
    bounds = np.concatenate([[0], np.cumsum(sizes)])
    return sizes, {name: slice(int(a), int(b)) for name, a, b in zip(shapes, bounds[:-1], bounds[1:], strict=True)}


class BasisField(nn.Module):
    """Flat predictions (B, heads.size), normalised by the mean and spread of each output over the training set. The
    inputs are those of the encoder: listener, emitter, for ears the yaw, and path.

    While it is trained, a share `dropout` of each hidden layer's features is left out at random.

    `bands` (band, heads.size) has a 1 for the levels of each octave band, else 0; it has no rows where levels are not
    those of bands. Where doors move, levels are relative to what the bands lose by the doors between both ends.

    Two corrections are added after training (`training.models.level_correction`). `level_correction` (2, heads.size)
    is that of each level, of pairs out of sight and in sight. `band_correction` (band, 1 + width) is that of whole
    bands: an offset, and the weights of the features of the last hidden layer.
    """

    mean: Tensor
    spread: Tensor
    level_correction: Tensor
    bands: Tensor
    band_correction: Tensor

    def __init__(
        self,
        heads: Layout,
        encoder: PathEncoder | PoseEncoder,
        shape: FieldShape,
        *,
        dropout: float = 0.0,
        bands: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.heads = heads
        self.encoder = encoder
        self._inputs = nn.Linear(self.encoder.size, shape.width)
        self._hidden = nn.ModuleList(nn.Linear(shape.width, shape.width) for _ in range(shape.depth - 1))
        self._dropout = nn.Dropout(dropout)
        self._coefficients = nn.Linear(shape.width, shape.rank)
        self.basis = nn.Parameter(torch.randn(shape.rank, self.heads.size) / np.sqrt(shape.rank))
        self.register_buffer("mean", torch.zeros(self.heads.size))
        self.register_buffer("spread", torch.ones(self.heads.size))
        self.register_buffer("level_correction", torch.zeros(2, self.heads.size))
        bands = torch.zeros(0, self.heads.size) if bands is None else bands
        self.register_buffer("bands", bands, persistent=False)
        self.register_buffer("band_correction", torch.zeros(len(bands), 1 + shape.width))

    @property
    def width(self) -> int:
        """Width of the network's layers."""
        return self._inputs.out_features

    def forward(self, *pose: Tensor) -> Tensor:
        return self.from_features(self._features(*pose))

    def coefficients(self, *pose: Tensor) -> Tensor:
        """(B, rank) coefficients of the basis."""
        return self.coefficients_of(self._features(*pose))

    def _features(self, *pose: Tensor) -> Tensor:
        # In low precision, places would be rounded to centimetres.
        with torch.autocast(pose[0].device.type, enabled=False):
            features: Tensor = self.encoder(*pose)
        return features

    def from_features(self, features: Tensor) -> Tensor:
        """Flat predictions, without corrections, from the encoder's features."""
        return self._less_losses(self.coefficients_of(features) @ self.basis, features)

    def _less_losses(self, flat: Tensor, features: Tensor) -> Tensor:
        if not self.encoder.doors:
            return flat
        return flat + self.encoder.loss_between(features) @ (self.bands / self.spread)

    def coefficients_of(self, features: Tensor) -> Tensor:
        """(B, rank) coefficients from the encoder's features."""
        coefficients: Tensor = self._coefficients(self.hidden(features))
        return coefficients

    def hidden(self, features: Tensor) -> Tensor:
        """(B, width) features of the last hidden layer from the encoder's."""
        hidden = nn.functional.gelu(self._inputs(features))
        for layer in self._hidden:
            hidden = hidden + self._dropout(nn.functional.gelu(layer(hidden)))
        return hidden

    def readout(self) -> tuple[Tensor, Tensor]:
        """Weights (rank + band, width) and offsets (rank + band,) of what follows the last hidden layer: the
        coefficients, and the corrections of bands in nepers."""
        layer, corrections = self._coefficients, self.band_correction
        return torch.cat([layer.weight, corrections[:, 1:]]), torch.cat([layer.bias, corrections[:, 0]])

    @torch.no_grad()
    def truncated(self, rank: int, *poses: Tensor) -> Self:
        """A field of lower rank. Of all linear maps of this field's coefficients, it has the least mean squared
        difference over these poses (Eckart and Young, 1936). The level correction makes up for the lost power.

        Raises ValueError unless the rank is lower.
        """
        if not 0 < rank < len(self.basis):
            raise ValueError(f"rank: {rank} is not between 1 and {len(self.basis) - 1}")
        features = self.encoder(*poses)
        coefficients = self.coefficients_of(features)
        root = torch.linalg.qr(coefficients / len(coefficients) ** 0.5).R
        directions = torch.linalg.svd(root @ self.basis, full_matrices=False).Vh[:rank]
        # Coefficients of equal size, so that all of them can share one eight-bit scale.
        size = (coefficients @ self.basis @ directions.T).square().mean(dim=0).sqrt().clamp(min=1e-9)
        turn = self.basis @ directions.T / size
        field = copy.deepcopy(self)
        layer = field._coefficients = nn.Linear(self._coefficients.in_features, rank)
        layer.weight.copy_(turn.T @ self._coefficients.weight)
        layer.bias.copy_(turn.T @ self._coefficients.bias)
        field.basis = nn.Parameter(directions * size[:, None])
        balance = PowerBalance(self.heads.areas)
        levels = self.heads.levels
        ours, theirs = (
            self.in_physical_units(self._less_losses(flat, features))[:, levels]
            for flat in (coefficients @ self.basis, coefficients @ turn @ field.basis)
        )
        balance.add(ours, theirs, self.encoder.sight(features))
        field.level_correction[:, levels] += balance.deficit()
        return field

    def in_physical_units(self, flat: Tensor) -> Tensor:
        return flat * self.spread + self.mean


class ExportedBasis(nn.Module):
    """The flat output in physical units, with corrected levels, as the exported graph computes it.

    Units and level correction are part of the basis and of one offset, where they cost nothing. Sight adds a row, and
    so does each band: one for its correction, and one for what doors take.
    """

    _basis: Tensor
    _offset: Tensor
    _readout: Tensor
    _readout_offset: Tensor

    def __init__(self, field: BasisField, order: Tensor) -> None:
        """`order` (heads.size,) numbers the flat output's elements in the order in which the graph wants them."""
        super().__init__()
        self._field = field
        out_of_sight, in_sight = field.level_correction
        basis, offset = torch.cat([field.basis.detach() * field.spread, field.bands]), field.mean + in_sight
        if not field.encoder.sees_all:
            basis, offset = torch.cat([basis, (in_sight - out_of_sight)[None]]), field.mean + out_of_sight
        if field.encoder.doors:
            basis = torch.cat([basis, field.bands])
        readout, readout_offset = field.readout()
        self.register_buffer("_readout", readout.detach(), persistent=False)
        self.register_buffer("_readout_offset", readout_offset.detach(), persistent=False)
        self.register_buffer("_basis", basis[:, order], persistent=False)
        self.register_buffer("_offset", offset[order], persistent=False)

    def _flat(self, *pose: Tensor) -> Tensor:
        """(B, heads.size) in the graph's order."""
        features = self._field.encoder(*pose)
        coefficients = nn.functional.linear(self._field.hidden(features), self._readout, self._readout_offset)
        if not self._field.encoder.sees_all:
            coefficients = torch.cat([coefficients, self._field.encoder.sight(features)], dim=1)
        if self._field.encoder.doors:
            coefficients = torch.cat([coefficients, self._field.encoder.loss_between(features)], dim=1)
        return torch.addmm(self._offset, coefficients, self._basis)
