"""Rays in meshes against the same rooms as floor plans, against formulas, and against what must not be heard."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from server.acoustics.decibels import power_to_db
from server.acoustics.mesh_tree import MeshTree
from server.scene.geometry import Material
from server.scene.mesh_geometry import MeshGeometry
from training.data.scene_file import HISTOGRAM_BIN_S, SceneFile
from training.simulation.mesh_rays import MeshRayTracer
from training.simulation.rays import RayTracer, sphere_directions
from training.trials.mesh_rooms import CUBE, INWARDS, PANEL, ROUGH, house, material, place_of, two_rooms

SCENES = Path(__file__).resolve().parents[3] / "training" / "scenes"
MUTE, MIRROR = "mute", "mirror"
EMITTER, RECEIVERS = np.array([1.0, 1.0, 1.2]), np.array([(4.4, 3.2, 1.4), (1.2, 3.0, 2.9), (4.0, 2.6, 2.4)])


def traced(
    geometry, emitter, receivers, *, rays=3000, seed=0, image_order=0, duration_s=0.4, directions=12, losses_db=None
):
    """(receiver, direction, band, bin)"""
    tracer = MeshRayTracer(
        geometry,
        np.asarray(receivers, dtype=float),
        duration_s=duration_s,
        image_order=image_order,
        arrival_directions=sphere_directions(directions),
        losses_db=losses_db,
    )
    return tracer.trace(emitter, rays=rays, rng=np.random.default_rng(seed))


def decay_db(energy):
    """Schroeder's backward integral over the last axis, from 0 dB."""
    remaining = np.cumsum(energy[..., ::-1], axis=-1)[..., ::-1]
    return power_to_db(np.maximum(remaining / remaining[..., :1], 1e-12))


def decay_time_s(decay, upper_db, lower_db):
    """(...,) time in which a decay falls by 60 dB, from its first bins below two levels."""
    first, last = (np.argmax(decay < level, axis=-1) for level in (upper_db, lower_db))
    fall = np.take_along_axis(decay, first[..., None], -1) - np.take_along_axis(decay, last[..., None], -1)
    return 60 * (last - first) * HISTOGRAM_BIN_S / fall[..., 0]


def parameters(energy):
    """(parameter, receiver, band): level, C50, EDT and T60, in just-noticeable differences."""
    energy = energy.sum(axis=1).astype(float)
    decay, early = decay_db(energy), 13
    clarity = power_to_db(energy[..., :early].sum(-1) / energy[..., early:].sum(-1))
    times = (decay_time_s(decay, -0.5, -10), decay_time_s(decay, -5, -25))
    return np.stack([power_to_db(energy.sum(-1)), clarity, *(20 * np.log(each) for each in times)])


@pytest.mark.parametrize(
    "name",
    [
        "apartment",
        *(
            pytest.param(name, marks=pytest.mark.long)
            for name in ("small1", "small2", "medium1", "medium2", "large1", "large2")
        ),
    ],
)
def test_a_plan_as_a_mesh_sounds_as_the_plan_within_the_repeatability_floor(name):
    scene = SceneFile.read(SCENES / f"{name}.toml")
    probes = scene.probe_positions(0)[::3]
    settings = {
        "duration_s": scene.simulation.duration_s,
        "image_order": 1,
        "arrival_directions": sphere_directions(12),
    }
    plan = RayTracer(scene.geometry, probes[1:], **settings)
    mesh = MeshRayTracer(MeshGeometry.of_plan(scene.geometry), probes[1:], **settings)
    as_plan, as_mesh = (
        np.array([parameters(tracer.trace(probes[0], rays=3000, rng=np.random.default_rng(seed))) for seed in seeds])
        for tracer, seeds in ((plan, range(6)), (mesh, range(6, 12)))
    )
    floor = np.abs(as_plan[1:] - as_plan[:-1]).mean(axis=(0, 2, 3))
    difference = np.abs(as_mesh - as_plan).mean(axis=(0, 2, 3))
    assert np.all(difference < 1.3 * floor)
    # Over the whole place, the takes of each differ by chance, and their means by no more.
    means, spread = (
        [each.mean(axis=(2, 3)) for each in (as_plan, as_mesh)],
        as_plan.mean(axis=(2, 3)).std(axis=0, ddof=1),
    )
    assert np.all(np.abs(means[1].mean(axis=0) - means[0].mean(axis=0)) < 4 * spread * np.sqrt(2 / 6) + 0.02)


@pytest.mark.parametrize("scattering", [0.0, 0.5])
def test_walls_that_absorb_nothing_keep_all_energy(scattering):
    """What is radiated within a bin stays, and fills the room evenly: 4 pi c dt / V."""
    place = house(0.0, scattering)
    energy = traced(place, EMITTER, RECEIVERS, rays=20_000).sum(axis=1).mean(axis=0)
    expected = 4 * np.pi * 343 * HISTOGRAM_BIN_S / place.mesh.volume_m3
    assert place.mesh.volume_m3 == pytest.approx(5 * (4 * 2.5 + 4 * 1.5 / 2) - 1.5 * 1.0 * 0.8)
    for half in (energy[:, 10:55], energy[:, 55:]):
        np.testing.assert_allclose(power_to_db(half.mean(axis=-1) / expected), 0, atol=0.2)


@pytest.mark.parametrize("absorption", [0.1, 0.2])
def test_decay_is_eyrings_in_an_irregular_room(absorption):
    place = house(absorption, 1.0)
    surface_m2 = place.mesh.areas_m2.sum()
    eyring_s = 24 * np.log(10) / 343 * place.mesh.volume_m3 / (-surface_m2 * np.log(1 - absorption))
    energy = traced(place, EMITTER, RECEIVERS, duration_s=1.2)
    found_s = decay_time_s(decay_db(energy.sum(axis=(0, 1, 2))), -5, -35)
    # Paths differ in length (Kuttruff, Room Acoustics, sec. 5.3: gamma**2 of about 0.4).
    path_spread = 1 + 0.4 / 2 * np.log(1 - absorption)
    assert found_s == pytest.approx(eyring_s / path_spread, rel=0.05)


def test_energy_is_the_same_the_other_way_round():
    place = house(0.2, 0.5)
    there = traced(place, EMITTER, RECEIVERS, rays=10_000)
    for number, receiver in enumerate(RECEIVERS):
        back = traced(place, receiver, EMITTER[None], rays=10_000)[0].sum(axis=(0, 2))
        np.testing.assert_allclose(power_to_db(back / there[number].sum(axis=(0, 2))), 0, atol=0.3)


def test_the_first_mirrored_reflection_of_a_slope_has_the_level_of_a_free_wave():
    """All else is air: (1 - a) / d**2 with the distance from the image, which arrives from where the image is."""
    slope = np.array([(-20, -20, 10), (20, -20, -10), (20, 20, -10), (-20, 20, 10)], dtype=float)
    place = place_of((slope, [(0, 1, 2), (0, 2, 3)], MIRROR), **{MIRROR: material(0.36, 0.0)})
    normal = place.mesh.normals[0]
    emitter, receiver = np.array([0.3, 0.1, 2.0]), np.array([[2.0, 1.5, 1.0]])
    image = emitter - 2 * (emitter @ normal) * normal
    energy = traced(place, emitter, receiver, rays=100_000, directions=24)[0, :, 0]
    distance = np.linalg.norm(image - receiver[0])
    assert power_to_db(energy.sum() * distance**2 / 0.64) == pytest.approx(0, abs=0.2)
    assert np.flatnonzero(energy.sum(axis=0)).tolist() == [int(distance / 343 / HISTOGRAM_BIN_S)]
    heard = sphere_directions(24)[np.argmax(energy.sum(axis=1))]
    assert heard @ (image - receiver[0]) / distance > 0.85


def test_nothing_is_heard_through_closed_walls_however_the_room_is_turned():
    """A booth around a receiver. Rays meet its edges and vertices at all angles, for seconds."""
    rng = np.random.default_rng(3)
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    room, booth = (CUBE * (5, 4, 3)) @ turn, (CUBE + np.array((2, 1.5, 1))) @ turn
    place = place_of((room, INWARDS, ROUGH), (booth, INWARDS[:, ::-1], ROUGH), **{ROUGH: material(0.01, 0.4)})
    receivers = np.array([(2.5, 2.0, 1.5), (1.0, 1.0, 1.0)]) @ turn
    energy = traced(place, np.array([1.0, 3.0, 2.0]) @ turn, receivers, rays=5000, duration_s=1.0)
    assert energy[0].sum() == 0
    assert energy[1].sum() > 0


def test_both_sides_of_a_sheet_reflect():
    """A box in two halves, divided by two triangles: each half keeps its energy for itself."""
    sheet = [(2.0, 0, 0), (2.0, 3, 0), (2.0, 3, 2.5), (2.0, 0, 2.5)]
    place = place_of(
        (CUBE * (4, 3, 2.5), INWARDS, ROUGH), (sheet, [(0, 1, 2), (0, 2, 3)], ROUGH), **{ROUGH: material(0.0, 0.3)}
    )
    receivers = np.array([(0.8, 1.0, 1.2), (3.2, 1.0, 1.2)])
    expected = 4 * np.pi * 343 * HISTOGRAM_BIN_S / (2 * 3 * 2.5)
    for emitter, here, there in (((1.2, 2.0, 1.5), 0, 1), ((2.9, 2.2, 1.5), 1, 0)):
        energy = traced(place, np.array(emitter), receivers, rays=20_000).sum(axis=1)
        assert energy[there].sum() == 0
        np.testing.assert_allclose(power_to_db(energy[here][:, 20:].mean(axis=-1) / expected), 0, atol=0.25)


def test_bands_follow_the_materials_of_the_triangles_that_are_met():
    loud, deaf = material(0.0, 0.0), Material(absorption=(0.0,) * 3 + (1.0,) * 4, scattering=(0.0,) * 7)
    place = place_of(
        (CUBE * (4, 3, 2.5), INWARDS[:10], MIRROR),
        (CUBE * (4, 3, 2.5), INWARDS[10:], MUTE),
        **{MIRROR: loud, MUTE: deaf},
    )
    energy = traced(place, np.array([1.0, 1, 1]), np.array([[3.0, 2, 1]]), duration_s=0.6).sum(axis=(0, 1))
    late = energy[:, -40:].sum(axis=-1)
    np.testing.assert_allclose(late[:3], late[0])
    assert late[3:].max() < 0.1 * late[0]


def test_triangles_that_are_known_to_be_in_sight_are_in_sight():
    geometry = MeshGeometry.of_plan(SceneFile.read(SCENES / "large2.toml").geometry)
    for place, receivers in (
        (house(0.1, 0.1), RECEIVERS),
        (geometry, SceneFile.read(SCENES / "large2.toml").probe_positions(0)),
    ):
        tracer = MeshRayTracer(
            place, receivers, duration_s=0.1, image_order=0, arrival_directions=sphere_directions(12)
        )
        is_open, tree = tracer._receivers.is_open, MeshTree(place.mesh)
        receiver, row = np.nonzero(is_open)
        corners = tree.tree.corners[row]
        shares = np.random.default_rng(0).dirichlet((1, 1, 1), (20, len(row)))
        points = np.einsum("srk,rkx->srx", shares, corners)
        assert tree.is_visible(receivers[receiver], points).all()
        assert 0.02 < is_open.mean() < 0.98


def test_a_material_may_be_changed_for_all_triangles_of_its_name():
    place = house(0.5, 0.5)
    quieter = replace(place, materials={ROUGH: material(0.9, 0.5)})
    loud, quiet = (traced(each, EMITTER, RECEIVERS).sum() for each in (place, quieter))
    assert power_to_db(quiet / loud) < -8


def losses_db(*of_materials):
    """(material, band) of ROUGH, PANEL and LINING; nothing goes through the first."""
    return np.repeat([[np.inf], *([each] for each in of_materials)], 7, axis=1)


IN_BOTH = np.array([(0.8, 1.0, 1.2), (2.0, 2.2, 1.5), (4.6, 2.0, 1.0), (6.0, 1.0, 1.4)])
SOURCE = np.array([1.4, 0.8, 1.7])


@pytest.mark.parametrize("wall_m", [0.0, 0.01])
def test_energy_that_goes_through_a_wall_is_not_lost(wall_m):
    """All that the wall absorbs goes through, and the other walls absorb nothing: in the end both rooms are as full."""
    place = two_rooms(wall_m=wall_m, absorption=0.0, panel=material(0.3, 0.4))
    loss = losses_db(*[-power_to_db(0.3)] * 2)
    energy = traced(place, SOURCE, IN_BOTH, rays=6000, losses_db=loss).sum(axis=1).mean(axis=1)
    expected = 4 * np.pi * 343 * HISTOGRAM_BIN_S / (7 * 3 * 2.5)
    in_rooms = power_to_db(energy.reshape(2, 2, -1)[..., 50:].mean(axis=(1, 2)) / expected)
    np.testing.assert_allclose(in_rooms, 0, atol=0.3)


@pytest.mark.parametrize(("wall_m", "loss_db"), [(0.0, 12.0), (0.02, 25.0), (0.02, 45.0)])
def test_the_level_behind_a_wall_follows_its_transmission_loss(wall_m, loss_db):
    """TL + 10 log10(A / S) between two reverberant rooms."""
    place = two_rooms(wall_m=wall_m, absorption=0.06, panel=material(0.08, 1.0))
    energy = traced(place, SOURCE, IN_BOTH, rays=4000, duration_s=1.0, losses_db=losses_db(loss_db, loss_db))
    levels_db = power_to_db(energy.sum(axis=(1, 3)).mean(axis=1).reshape(2, 2).mean(axis=1))
    wall_m2 = 3 * 2.5
    # In the receiving room, the energy is what the walls reflect: of what comes through, none is heard directly.
    absorbed_m2 = 0.06 * (2 * (4 * 3 + 4 * 2.5) + wall_m2) + 0.08 * wall_m2
    assert levels_db[0] - levels_db[1] == pytest.approx(loss_db + power_to_db(absorbed_m2 / wall_m2), abs=1.0)


def test_no_more_goes_through_a_wall_than_either_side_absorbs_and_lets_through():
    panel, lining = material(0.2, 0.5), material(0.05, 0.5)
    bare = two_rooms(wall_m=0.1, absorption=0.05, panel=lining)
    lined = two_rooms(wall_m=0.1, absorption=0.05, panel=panel, lining=lining)
    there = IN_BOTH[2:]

    def level_db(place, loss, emitter=SOURCE, receivers=there):
        energy = traced(place, emitter, receivers, rays=6000, losses_db=loss)
        return power_to_db(np.maximum(energy.sum(axis=(1, 2, 3)), 1e-12)).mean()

    # Of a wall that would let nearly all through, as much goes through as its lining absorbs.
    assert level_db(bare, losses_db(0.1, 0.1)) == pytest.approx(level_db(bare, losses_db(13.01, 13.01)), abs=1e-3)
    heard = [level_db(lined, losses_db(*each)) for each in ((25.0, 14.0), (14.0, 25.0), (25.0, 25.0))]
    np.testing.assert_allclose(heard, heard[2], atol=1e-9)
    assert level_db(lined, losses_db(20.0, np.inf)) == level_db(lined, losses_db(np.inf, 20.0)) < -119
    assert level_db(lined, None) < -119


def test_energy_through_walls_is_the_same_the_other_way_round():
    place = two_rooms(wall_m=0.1, absorption=0.1, panel=material(0.2, 0.3), lining=material(0.1, 0.6))
    there, back = (
        traced(place, a, b[None], rays=20_000, losses_db=losses_db(20.0, 20.0)).sum(axis=(1, 3)).mean()
        for a, b in ((SOURCE, IN_BOTH[3]), (IN_BOTH[3], SOURCE))
    )
    assert power_to_db(there / back) == pytest.approx(0, abs=0.3)


def test_what_a_mirror_sends_through_a_sheet_has_the_level_of_a_free_wave_and_the_direct_sound_is_left_out():
    """The images of one surface are those in sight, so this one is the rays'."""
    plane = np.array([(-20, -20, 0), (20, -20, 0), (20, 20, 0), (-20, 20, 0)], dtype=float)
    above, faces = plane + np.array((0, 0, 1.5)), [(0, 1, 2), (0, 2, 3)]
    place = place_of(
        (plane, faces, MIRROR), (above, faces, PANEL),
        **{MIRROR: material(0.36, 0.0), PANEL: material(1.0, 0.0)},
    )  # fmt: skip
    emitter, receiver = np.array([0.0, 0.0, 1.0]), np.array([[1.0, 0.0, 2.0]])
    loss = np.repeat([[np.inf], [-power_to_db(0.25)]], 7, axis=1)
    energy = traced(place, emitter, receiver, rays=200_000, image_order=1, losses_db=loss)[0, :, 0].sum(axis=0)
    assert np.flatnonzero(energy).tolist() == [int(np.sqrt(10) / 343 / HISTOGRAM_BIN_S)]
    assert power_to_db(energy.sum() * 10 / (0.64 * 0.25)) == pytest.approx(0, abs=0.5)
