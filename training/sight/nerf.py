"""A neural radiance field (Mildenhall et al., NeRF, ECCV 2020): a coarse and a fine network, which may also be given
the features of a grid in plan at each sample's place.

One thing differs: densities are a softplus of the network's output in place of a ReLU, so that none can die at the
start of a short training. Axes: R rays, S samples of a ray; metres.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from training.learning.precision import compiled
from training.models.local_geometry import GaussianGrid

_Network = Callable[[Tensor, Tensor, Tensor | None], tuple[Tensor, Tensor]]
_Features = Callable[[Tensor], Tensor]

_POSITION_OCTAVES, _DIRECTION_OCTAVES = 10, 4
NEAREST_M = 0.05
_PAST_M = 0.01


def sines(values: Tensor, octaves: int) -> Tensor:
    """(..., n) values to (..., n + 2 n octaves): the values, then sines and cosines of pi times their multiples by
    1, 2, 4 and so on."""
    factors = torch.pi * 2.0 ** torch.arange(octaves, dtype=values.dtype, device=values.device)
    angles = (values[..., None] * factors).flatten(-2)
    return torch.cat([values, torch.sin(angles), torch.cos(angles)], dim=-1)


class Radiance(nn.Module):
    """Density (per metre) and colour at points, seen from directions. `layers` of `width` carry the position, which
    enters anew in the middle; a last one of half the width sees the direction."""

    def __init__(self, width: int, layers: int, features: int) -> None:
        super().__init__()
        inputs = 3 + 6 * _POSITION_OCTAVES + features
        self._again = layers // 2
        sizes = [inputs, *[width + inputs * (number == self._again) for number in range(1, layers)]]
        self.layers = nn.ModuleList(nn.Linear(size, width) for size in sizes)
        self.density = nn.Linear(width, 1)
        self.between = nn.Linear(width, width)
        self.seen = nn.Linear(width + 3 + 6 * _DIRECTION_OCTAVES, max(1, width // 2))
        self.colour = nn.Linear(max(1, width // 2), 3)

    def forward(self, positions: Tensor, directions: Tensor, features: Tensor | None) -> tuple[Tensor, Tensor]:
        """Positions within -1 and 1, directions of length one, and features, all (N, ...), to densities (N,) and
        colours (N, 3) from 0 to 1."""
        inputs = sines(positions, _POSITION_OCTAVES)
        if features is not None:
            inputs = torch.cat([inputs, features], dim=-1)
        hidden = inputs
        for number, layer in enumerate(self.layers):
            if number and number == self._again:
                hidden = torch.cat([hidden, inputs], dim=-1)
            hidden = torch.relu(layer(hidden))
        density = nn.functional.softplus(self.density(hidden)[:, 0].float())
        seen = torch.cat([self.between(hidden), sines(directions, _DIRECTION_OCTAVES)], dim=-1)
        return density, torch.sigmoid(self.colour(torch.relu(self.seen(seen))).float())


def weights_of(density: Tensor, spacing_m: Tensor) -> Tensor:
    """(R, S) share of a ray's colour that each sample gives; their sum is one less what passes through all of them."""
    opacity = 1 - torch.exp(-density * spacing_m)
    passing = torch.cumprod(torch.cat([torch.ones_like(opacity[:, :1]), 1 - opacity[:, :-1]], dim=1), dim=1)
    return opacity * passing


def draw_depths(edges_m: Tensor, weights: Tensor, where: Tensor) -> Tensor:
    """(R, n) depths that are distributed as the weights (R, S) of the segments between edges (R, S + 1): the inverse of
    their cumulative distribution at `where` (R, n), 0 to 1."""
    shares = weights + 1e-5
    cumulative = torch.cumsum(shares / shares.sum(dim=-1, keepdim=True), dim=-1)
    cumulative = torch.cat([torch.zeros_like(cumulative[:, :1]), cumulative], dim=-1)
    number = torch.searchsorted(cumulative, where.contiguous(), right=True).clamp(1, weights.shape[1])
    low, high = torch.gather(cumulative, 1, number - 1), torch.gather(cumulative, 1, number)
    share = ((where - low) / (high - low).clamp(min=1e-9)).clamp(0, 1)
    start, end = torch.gather(edges_m, 1, number - 1), torch.gather(edges_m, 1, number)
    return start + share * (end - start)


@dataclass(frozen=True)
class Rays:
    """Origins and directions (R, 3) and the `far_m` (R,) at which each leaves the scene's box."""

    origins: Tensor
    directions: Tensor
    far_m: Tensor

    def __getitem__(self, some: Tensor | slice) -> "Rays":
        return Rays(self.origins[some], self.directions[some], self.far_m[some])

    def to(self, device: torch.device) -> "Rays":
        return Rays(*(part.to(device) for part in vars(self).values()))

    @classmethod
    def within(
        cls,
        origins: npt.NDArray[np.float64],
        directions: npt.NDArray[np.float64],
        low: npt.NDArray[np.float64],
        high: npt.NDArray[np.float64],
    ) -> "Rays":
        """Rays from inside a box; a little past it, so that its walls have room."""
        with np.errstate(divide="ignore", invalid="ignore"):
            exits = np.where(directions > 0, (high - origins) / directions, (low - origins) / directions)
        far_m = np.where(directions == 0, np.inf, exits).min(axis=-1)
        far_m = np.maximum(far_m, 2 * NEAREST_M) + _PAST_M
        return cls(*(torch.tensor(part, dtype=torch.float32) for part in (origins, directions, far_m)))


class Nerf(nn.Module):
    """Colours of rays by a coarse network and by a fine one. `grid` is not a part of this module, because another
    network may own it."""

    _middle: Tensor
    _half: Tensor

    def __init__(
        self,
        low: npt.NDArray[np.float64],
        high: npt.NDArray[np.float64],
        *,
        width: int,
        layers: int,
        coarse: int,
        fine: int,
        features: int,
    ) -> None:
        super().__init__()
        self.register_buffer("_middle", torch.tensor((low + high) / 2, dtype=torch.float32), persistent=False)
        self.register_buffer("_half", torch.tensor(float(np.max(high - low) / 2)), persistent=False)
        self._samples, self._more = coarse, fine
        self.coarse, self.fine = (Radiance(width, layers, features) for _ in range(2))
        self._quick: tuple[_Network, _Network, _Features | None] | None = None

    def quicken(self, device: torch.device, grid: GaussianGrid | None) -> None:
        """Compile what training steps do at each sample, if the device is a GPU."""
        features = None if grid is None else compiled(grid.of_many, device)
        self._quick = compiled(self.coarse, device), compiled(self.fine, device), features

    def forward(
        self, rays: Rays, grid: GaussianGrid | None, generator: torch.Generator | None
    ) -> tuple[Tensor, Tensor]:
        """(R, 3) colours by both networks. Samples are drawn by a generator of the rays' device; without one they are
        in the middle of their segments."""
        count, device = len(rays.origins), rays.origins.device
        # Other numbers of rays than those of a step would be compiled anew.
        slow = self.coarse, self.fine, None if grid is None else grid.of_many
        coarse_network, fine_network, features = slow if generator is None else self._quick or slow

        def spread(samples: int) -> Tensor:
            places = torch.full((count, samples), 0.5, device=device)
            if generator is not None:
                places = torch.rand(count, samples, generator=generator, device=device)
            return (torch.arange(samples, device=device) + places) / samples

        depths = NEAREST_M + spread(self._samples) * (rays.far_m[:, None] - NEAREST_M)
        coarse, weights = self._march(coarse_network, rays, depths, features)
        edges = torch.linspace(0, 1, self._samples + 1, device=device) * (rays.far_m[:, None] - NEAREST_M) + NEAREST_M
        more = draw_depths(edges, weights.detach(), spread(self._more))
        both, _ = torch.sort(torch.cat([depths, more], dim=1), dim=1)
        fine, _ = self._march(fine_network, rays, both, features)
        return coarse, fine

    def _march(
        self, network: _Network, rays: Rays, depths: Tensor, features_of: _Features | None
    ) -> tuple[Tensor, Tensor]:
        points = (rays.origins[:, None] + depths[..., None] * rays.directions[:, None]).flatten(0, 1)
        directions = rays.directions[:, None].expand(*depths.shape, 3).flatten(0, 1)
        features = None if features_of is None else features_of(points)
        density, colour = network((points - self._middle) / self._half, directions, features)
        # The last segment has no end: what reaches it ends there, at the walls of the scene's box.
        spacing = torch.cat([depths[:, 1:] - depths[:, :-1], torch.full_like(depths[:, :1], 1e3)], dim=1)
        weights = weights_of(density.view_as(depths), spacing)
        return (weights[..., None] * colour.view(*depths.shape, 3)).sum(dim=1), weights
