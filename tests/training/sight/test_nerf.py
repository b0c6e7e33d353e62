"""Radiance fields: laws of volume rendering, of sampling and of the encoding."""

import numpy as np
import pytest
import torch

from training.sight.nerf import Nerf, Radiance, Rays, draw_depths, sines, weights_of


def test_weights_are_what_is_absorbed_and_add_up_to_at_most_one() -> None:
    density, spacing = torch.rand(64, 20) * 5, torch.rand(64, 20)
    weights = weights_of(density, spacing)
    assert (weights >= 0).all()
    passed = torch.exp(-(density * spacing).sum(dim=1))
    torch.testing.assert_close(weights.sum(dim=1), 1 - passed)


def test_the_first_opaque_sample_gives_all_of_the_colour() -> None:
    density = torch.tensor([[0.0, 0.0, 1e4, 3.0, 1e4]])
    weights = weights_of(density, torch.full((1, 5), 0.5))
    torch.testing.assert_close(weights, torch.tensor([[0.0, 0.0, 1.0, 0.0, 0.0]]))


def test_sines_are_those_of_multiples_of_pi() -> None:
    values = torch.rand(7, 3, dtype=torch.float64)
    encoded = sines(values, 4)
    assert encoded.shape == (7, 3 + 24)
    torch.testing.assert_close(encoded[:, :3], values)
    factors = np.pi * np.array([1, 2, 4, 8])
    for axis in range(3):
        angles = values[:, axis : axis + 1].numpy() * factors
        columns = slice(3 + 4 * axis, 7 + 4 * axis), slice(15 + 4 * axis, 19 + 4 * axis)
        np.testing.assert_allclose(encoded[:, columns[0]], np.sin(angles))
        np.testing.assert_allclose(encoded[:, columns[1]], np.cos(angles))


def test_fine_depths_are_distributed_as_the_weights() -> None:
    edges = torch.tensor([[0.0, 1.0, 2.0, 4.0]]).repeat(1, 1)
    depths = draw_depths(edges, torch.tensor([[1.0, 0.0, 3.0]]), (torch.arange(4000)[None] + 0.5) / 4000)[0]
    counts = [int(((depths >= a) & (depths < b)).sum()) for a, b in ((0, 1), (1, 2), (2, 4))]
    assert counts[0] == pytest.approx(1000, abs=5)
    assert counts[1] <= 2
    assert counts[2] == pytest.approx(3000, abs=5)
    assert depths[depths >= 2].mean() == pytest.approx(3.0, abs=0.01)


def test_fine_depths_of_an_empty_ray_are_spread_evenly() -> None:
    depths = draw_depths(torch.linspace(1, 3, 9)[None], torch.zeros(1, 8), torch.tensor([[0.0, 0.25, 0.5, 1.0]]))
    torch.testing.assert_close(depths, torch.tensor([[1.0, 1.5, 2.0, 3.0]]))


def test_a_ray_ends_where_it_leaves_the_box() -> None:
    low, high = np.zeros(3), np.array([4.0, 2.0, 3.0])
    rays = Rays.within(
        np.array([[1.0, 1.0, 1.0]] * 3),
        np.array([[1.0, 0.0, 0.0], [-0.6, 0.8, 0.0], [0.0, 0.0, -1.0]]),
        low,
        high,
    )
    np.testing.assert_allclose(rays.far_m, np.array([3.0, 1.25, 1.0]) + 0.01, rtol=1e-6)


class _Slab(torch.nn.Module):
    """Red and opaque beyond x = 2 m; empty and blue before."""

    def forward(self, positions, *_):
        inside = positions[:, 0] > 0.5  # of a box from 0 to 8/3 m, in scaled coordinates
        colour = torch.where(inside[:, None], torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 0.0, 1.0]))
        return 1e4 * inside.float(), colour


def test_an_opaque_slab_gives_its_colour_and_its_depth() -> None:
    low, high = np.zeros(3), np.full(3, 8 / 3)
    nerf = Nerf(low, high, width=4, layers=2, coarse=16, fine=16, features=0)
    nerf.coarse = nerf.fine = _Slab()
    rays = Rays.within(np.array([[0.5, 1.0, 1.0]]), np.array([[1.0, 0.0, 0.0]]), low, high)
    for generator in (None, torch.Generator().manual_seed(0)):
        for colours in nerf(rays, None, generator):
            torch.testing.assert_close(colours, torch.tensor([[1.0, 0.0, 0.0]]))


def test_samples_are_in_order_and_within_their_ray() -> None:
    low, high = np.zeros(3), np.ones(3)
    nerf = Nerf(low, high, width=8, layers=2, coarse=8, fine=16, features=2)
    places = []

    class Grid:
        def of_many(self, points):
            places.append(points)
            return torch.zeros(len(points), 2)

    rays = Rays.within(np.full((5, 3), 0.5), np.eye(3)[[0, 1, 2, 0, 1]], low, high)
    nerf(rays, Grid(), torch.Generator().manual_seed(1))
    coarse, fine = places
    assert (len(coarse), len(fine)) == (5 * 8, 5 * 24)
    depths = torch.linalg.vector_norm(fine.view(5, 24, 3) - 0.5, dim=-1)
    assert (depths.diff(dim=1) >= 0).all()
    assert depths.min() >= 0.05
    assert depths.max() <= 0.51 + 1e-5


def test_only_the_colour_depends_on_the_direction() -> None:
    torch.manual_seed(0)
    network = Radiance(16, 4, 0)
    positions = torch.rand(6, 3)
    (first, red), (second, other) = (network(positions, torch.eye(3)[axis].expand(6, 3), None) for axis in (0, 1))
    torch.testing.assert_close(first, second)
    assert (red - other).abs().max() > 1e-3
