"""The input encodings of the paper's network: sinusoids, a grid of local geometric features, and embeddings of the head
orientation (Luo et al., Learning Neural Acoustic Fields, NeurIPS 2022, section 3.3 and supplement)."""

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

_FREQUENCIES = 10
ENCODED = 1 + 2 * _FREQUENCIES
"""The number of values that encode one coordinate."""
_LEAST_BANDWIDTH_M, _MOST_BANDWIDTH_M = 0.1, 0.5
_FLOAT_M = 0.1


def sinusoids(coordinates: Tensor, highest_octave: float) -> Tensor:
    """(..., n) coordinates to (..., ENCODED n): the coordinates, then their sines and cosines at ten factors from 1 to
    2**highest_octave, evenly spaced in octaves."""
    factors = 2.0 ** torch.linspace(0, highest_octave, _FREQUENCIES, dtype=coordinates.dtype, device=coordinates.device)
    angles = (coordinates[..., None] * factors).flatten(-2)
    return torch.cat([coordinates, torch.sin(angles), torch.cos(angles)], dim=-1)


class GaussianGrid(nn.Module):
    """Learned features on a grid in plan, interpolated by a Gaussian Nadaraya-Watson kernel. Each cell has its own
    bandwidth (0.1 to 0.5 m) and may move by 0.1 m.

    The weights are a softmax of the exponents. The published code divides sums of exponentials, which gives 0/0 farther
    than a few metres from every cell.
    """

    _cells: Tensor

    def __init__(
        self, low: npt.NDArray[np.float64], high: npt.NDArray[np.float64], spacing_m: float, features: int
    ) -> None:
        super().__init__()
        axes = [np.arange(a, b + spacing_m / 2, spacing_m) for a, b in zip(low[:2], high[:2], strict=True)]
        cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        self.register_buffer("_cells", torch.tensor(cells, dtype=torch.float32), persistent=False)
        share = (spacing_m - _LEAST_BANDWIDTH_M) / (_MOST_BANDWIDTH_M - _LEAST_BANDWIDTH_M)
        logit = float(np.log(np.clip(share, 0.05, 0.95) / (1 - np.clip(share, 0.05, 0.95))))
        self.bandwidth_logit = nn.Parameter(torch.full((len(cells),), logit))
        self.offset = nn.Parameter(torch.zeros(len(cells), 2))
        self.features = nn.Parameter(torch.randn(len(cells), features) / features**0.5)

    @property
    def bandwidths_m(self) -> Tensor:
        """(cell,)"""
        # guard: a bandwidth has a least
        return _LEAST_BANDWIDTH_M + (_MOST_BANDWIDTH_M - _LEAST_BANDWIDTH_M) * torch.sigmoid(self.bandwidth_logit)

    def forward(self, position: Tensor) -> Tensor:
        """(B, 2 or 3) metres to (B, features)."""
        cells = self._cells + _FLOAT_M * torch.tanh(self.offset)
        squared = torch.sum((position[:, None, :2] - cells) ** 2, dim=-1)
        # guard: kernel weights of the paper's grid are a softmax
        return torch.softmax(-squared / (2 * self.bandwidths_m**2), dim=-1) @ self.features

    def of_many(self, position: Tensor) -> Tensor:
        """The same for many points, by a product of matrices in place of a difference for each point and cell: memory
        is passed over less often. Exponents err by some 1e-4 within a flat."""
        # Squares of metres over those of decimetres: bfloat16 would not tell one cell from the next.
        with torch.autocast(position.device.type, enabled=False):
            middle = self._cells.mean(dim=0)
            cells = self._cells + _FLOAT_M * torch.tanh(self.offset) - middle
            at = position[:, :2].float() - middle
            sharpness = 1 / (2 * self.bandwidths_m**2)
            points = torch.cat([at, at.square().sum(dim=-1, keepdim=True), torch.ones_like(at[:, :1])], dim=-1)
            weights = torch.stack(
                [2 * cells[:, 0], 2 * cells[:, 1], -torch.ones_like(sharpness), -cells.square().sum(-1)]
            )
            shares = torch.softmax(points @ (sharpness * weights), dim=-1)
        return shares @ self.features


class OrientationEmbedding(nn.Module):
    """A learned vector per layer for each measured head orientation, interpolated between the two nearest. At measured
    orientations it is the paper's embedding."""

    _yaws: Tensor
    _after: Tensor
    _before: Tensor

    def __init__(self, yaws: npt.NDArray[np.float64], layers: int, width: int) -> None:
        super().__init__()
        following = np.roll(yaws, -1) - yaws
        following[-1] += 2 * np.pi
        for name, values in (("_yaws", yaws), ("_after", following), ("_before", np.roll(following, 1))):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float32), persistent=False)
        self.vectors = nn.Parameter(torch.randn(len(yaws), layers, width) / width**0.5)

    def forward(self, yaw: Tensor) -> Tensor:
        """(B,) radians to (B, layers, width)."""
        turn = yaw[:, None] - self._yaws
        # guard: a heading is one within a turn
        turn = turn - 2 * np.pi * torch.floor((turn + np.pi) / (2 * np.pi))
        gap = torch.where(turn >= 0, self._after, self._before)
        weights = torch.clamp(1 - turn.abs() / gap, min=0)
        weights = weights / weights.sum(dim=1, keepdim=True)
        return torch.einsum("bk,klw->blw", weights, self.vectors)
