import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from server.acoustics.geometry import FloorPlan
from server.scene.geometry import Geometry, Material, Materials
from training.simulation.neighbourhoods import EXCESS_STEP_M, Neighbourhoods
from training.simulation.rays import RayTracer, sphere_directions, surface_m2

CORRIDOR = ((0, 0), (9, 0), (9, 7.6), (7.4, 7.6), (7.4, 1.6), (0, 1.6))
MIDDLE = np.array([5.0, 4.0, 5.0])


def of(plan, receiver):
    return Neighbourhoods.around(plan, np.asarray(receiver)[None], surface_m2(plan))


def test_in_the_middle_of_a_large_room_they_are_whole_spheres():
    around = of(FloorPlan(((0, 0), (10, 0), (10, 8), (0, 8)), 10.0), MIDDLE)
    np.testing.assert_allclose(around.volumes_m3, 4 / 3 * np.pi * around.radii_m**3, rtol=1e-9)


def test_beside_a_wall_half_of_them_counts_and_in_a_corner_an_eighth():
    plan = FloorPlan(((0, 0), (10, 0), (10, 8), (0, 8)), 10.0)
    for receiver, share in (((1e-6, 4, 5), 1 / 2), ((1e-6, 1e-6, 1e-6), 1 / 8)):
        around = of(plan, receiver)
        whole = 4 / 3 * np.pi * around.radii_m[:, 1:] ** 3
        np.testing.assert_allclose(around.volumes_m3[:, 1:] / whole, share, rtol=0.02)


def test_what_a_corner_hides_does_not_count():
    """Against a wall, a metre before it ends: the room goes on behind its end, out of sight."""
    plan = FloorPlan(((0, 0), (20, 0), (20, 20), (10, 20), (10, 10), (0, 10)), 40.0)
    around = of(plan, (9, 10 - 1e-6, 20))
    assert around.volumes_m3[0, -1] / (4 / 3 * np.pi * 2.0**3) == pytest.approx(0.5, rel=0.02)


def test_sizes_grow_with_the_way_in_excess_and_never_beyond_a_fiftieth_of_it():
    around = of(FloorPlan(((0, 0), (10, 0), (10, 8), (0, 8)), 10.0), MIDDLE)
    excess_m = np.arange(len(around.size_at)) * EXCESS_STEP_M
    radii = around.radii_m[0, around.size_at]
    assert (np.diff(radii) >= 0).all()
    grown = around.size_at > 0
    assert (radii[grown] <= 0.02 * excess_m[grown] + 1e-9).all()
    assert radii[-1] == around.radii_m.max()


def energies(geometry, rays, seed):
    """(receiver, band, bin)"""
    receivers = np.array([[2.0, 0.8, 1.4], [5.0, 0.7, 1.5], [8.2, 3.0, 1.3], [8.3, 6.0, 1.6]])
    tracer = RayTracer(geometry, receivers, duration_s=0.6, image_order=1, arrival_directions=sphere_directions(12))
    return tracer.trace(np.array([1.0, 0.8, 1.5]), rays=rays, rng=np.random.default_rng(seed)).sum(axis=1)


def corridor(*, scattering):
    plain, soft = (Material(absorption=(a,) * 7, scattering=(scattering,) * 7) for a in (0.05, 0.45))
    return Geometry(height_m=2.6, corners=CORRIDOR, materials=Materials(walls=plain, floor=plain, ceiling=soft))


@pytest.mark.parametrize(("scattering", "share"), [(0.1, 0.6), (0.6, 0.8)])
def test_the_mean_is_that_of_small_spheres_and_varies_less(scattering, share, monkeypatch):
    """In a corridor with a corner, from when on spheres grow."""
    geometry = corridor(scattering=scattering)
    grown = np.stack([energies(geometry, 3000, seed) for seed in range(12)])
    monkeypatch.setattr(Neighbourhoods, "around", _small)
    small = np.stack([energies(geometry, 3000, seed) for seed in range(100, 148)])
    late = np.s_[..., 25:75]  # 100 to 300 ms
    ours, theirs = grown[late].sum(axis=(-1, -2)), small[late].sum(axis=(-1, -2))
    np.testing.assert_allclose(power_to_db(ours.mean(axis=0) / theirs.mean(axis=0)), 0, atol=0.6)
    spread = [np.std(each, axis=0).mean() / each.mean() for each in (grown[late][:, :, 3], small[late][:, :, 3])]
    assert spread[0] < share * spread[1]


def _small(plan, receivers, _):
    """All sizes alike: small spheres, as ever."""
    from training.simulation.neighbourhoods import receiver_radii

    radii = receiver_radii(plan, receivers)[:, None]
    return Neighbourhoods(radii, 4 / 3 * np.pi * radii**3, np.zeros_like(radii, bool), np.zeros(1, np.int64))
