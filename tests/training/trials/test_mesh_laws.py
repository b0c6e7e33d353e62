"""Laws of sound in meshes, with few rays: what is measured is what they say, and a tracer that breaks one is told."""

import dataclasses

import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from server.scene.mesh_geometry import MeshGeometry
from training.simulation.mesh_rays import MeshRayTracer
from training.trials import mesh_laws
from training.trials.mesh_and_others import beside_others
from training.trials.mesh_laws import LAWS, RECIPROCITIES, Sizes, decay, free_paths, screened, screened_places, slit
from training.trials.mesh_rooms import house, l_plan, material, places_in, pyramid, shoebox_plan, two_rooms

FEW = Sizes(rays=4_000, runs=2, receivers=8, pairs=2, free_paths=50_000, edges=40)
OFTEN = {0, 1, 3, 5, 6, 9}
"""Numbers of the laws that stand for their like in the ordinary run."""


def rng(seed=1):
    return np.random.default_rng(seed)


def test_rooms_have_their_volumes_and_face_inwards():
    assert house(0.1, 0.1).mesh.volume_m3 == pytest.approx(5 * (4 * 2.5 + 4 * 1.5 / 2) - 1.5 * 1.0 * 0.8)
    assert pyramid(0.1, 0.1).mesh.volume_m3 == pytest.approx(7 * 5 * 6 / 3)
    assert MeshGeometry.of_plan(l_plan(0.1, 0.1)).mesh.volume_m3 == pytest.approx((8 * 3 + 3.5 * 4) * 2.8)
    whole, slitted = (
        two_rooms(wall_m=0.0, absorption=0.1, panel=material(0.1, 1.0), slit_m=width).mesh for width in (0.0, 0.4)
    )
    assert whole.areas_m2.sum() - slitted.areas_m2.sum() == pytest.approx(0.4 * 2.5)
    with pytest.raises(ValueError, match="clear_m: only 0 of 3"):
        places_in(house(0.1, 0.1), 3, rng(), clear_m=2.5)


@pytest.mark.parametrize(
    "law",
    [law if number in OFTEN else pytest.param(law, marks=pytest.mark.long) for number, law in enumerate(LAWS)],
    ids=range(len(LAWS)),
)
def test_what_is_measured_is_what_the_law_says(law):
    found = law(FEW, rng())
    assert abs(found.off_db) < 0.3 + 4 * found.error_db
    assert found.error_db < 1.0


def test_a_tracer_that_loses_energy_is_told(monkeypatch):
    whole = MeshRayTracer.trace

    def leaking(self, emitter, *, rays, rng):
        return 0.8 * whole(self, emitter, rays=rays, rng=rng)

    monkeypatch.setattr(MeshRayTracer, "trace", leaking)
    for law in (mesh_laws.mirrored_by_a_slope, LAWS[4], LAWS[6]):
        found = law(FEW, rng())
        assert found.off_db == pytest.approx(power_to_db(0.8), abs=0.3)


@pytest.mark.parametrize("law", RECIPROCITIES)
def test_both_directions_differ_by_chance_only(law):
    found = law(FEW, rng())
    assert 0 < found.there_and_back_db < 2 * found.twice_db + 0.1


def test_a_tracer_with_a_preferred_direction_is_told(monkeypatch):
    whole = MeshRayTracer.trace

    def uphill(self, emitter, *, rays, rng):
        return (1.5 if emitter[0] > self._receivers.positions[0, 0] else 1.0) * whole(self, emitter, rays=rays, rng=rng)

    monkeypatch.setattr(MeshRayTracer, "trace", uphill)
    found = mesh_laws.there_and_back(FEW, rng())
    assert found.there_and_back_db > power_to_db(1.5) - 4 * found.twice_db


@pytest.mark.parametrize("room", [house, pyramid])
def test_the_mean_free_path_is_4_v_over_s(room):
    place = room(0.1, 0.1)
    mean_m, variance = free_paths(place, 100_000, rng())
    assert mean_m == pytest.approx(4 * place.mesh.volume_m3 / place.mesh.areas_m2.sum(), rel=0.01)
    assert 0.2 < variance < 0.6


def test_decays_of_irregular_rooms_are_eyrings_for_paths_of_their_spread():
    found = decay("pyramid", pyramid, 0.2, FEW, rng())
    assert found.volume_m3 == pytest.approx(70)
    assert found.found_s == pytest.approx(found.eyring_of_paths_s, rel=0.04)
    assert found.eyring_s < found.eyring_of_paths_s


def test_a_rectangle_is_seen_under_its_solid_angle():
    """A side of a cube, from its middle; half of all directions, for a wall without end."""
    cube = mesh_laws._seen_through(np.zeros(3), 1.0, (-1.0, 1.0), (-1.0, 1.0))
    assert cube == pytest.approx(4 * np.pi / 6)
    assert mesh_laws._seen_through(np.zeros(3), 1.0, (-1e9, 1e9), (-1e9, 1e9)) == pytest.approx(2 * np.pi)
    aside = mesh_laws._seen_through(np.array((0.3, 0.2, 0.1)), 2.0, (1.0, 1.1), (0.5, 0.6))
    offset = np.array((1.7, 0.85, 0.45))
    assert aside == pytest.approx(0.01 * 1.7 / np.linalg.norm(offset) ** 3, rel=0.01)


def test_through_a_slit_comes_what_the_balance_says():
    narrow, wide = (slit(FEW, rng(), width_m) for width_m in (0.1, 0.8))
    for found in (narrow, wide):
        assert found.found_db == pytest.approx(found.expected_db, abs=0.6)
    assert wide.found_db - narrow.found_db > 5


def test_at_an_edge_the_mesh_loses_what_was_measured():
    rows = screened()
    for row in rows:
        assert row.found_db == pytest.approx(row.chart_db, abs=1)
        assert (row.rigid_db is None) == (row.fresnel_number <= 0)
    rigid, absorbing = screened_places(FEW, rng())
    assert -3 < absorbing.mean_db < -1 < 0.5 < rigid.mean_db < 4


@pytest.mark.parametrize(
    ("room", "scattering"),
    [(shoebox_plan, 1.0), (house, 0.0), pytest.param(house, 1.0, marks=pytest.mark.long)],
)
def test_pyroomacoustics_hears_the_same_in_a_plan_and_in_a_mesh(room, scattering):
    found = beside_others("room", room(0.15, scattering), scattering, FEW, rng(), duration_s=0.8)
    assert abs(found.difference) < 0.03 + 2 * found.error
    if scattering:
        assert found.level_db is found.c50_db is found.decay_db is None
    else:
        assert found.level_db < 0.3
        assert found.c50_db < 0.5
    harder = room(0.1, scattering)
    other = beside_others("room", harder, scattering, dataclasses.replace(FEW, rays=1000), rng(), duration_s=0.8)
    assert np.mean(other.others_s) > 1.2 * np.mean(found.others_s)
