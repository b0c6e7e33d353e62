"""Which doors are between two places."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from server.acoustics.doors import DoorLeaf, LeafMotion
from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_tree import MeshTree
from server.acoustics.sound_path import DESCRIPTION
from tests.training.learning.test_moving_doors import level
from tests.two_rooms import EAST, SLIDE, SWING, WEST, box, door, leaf, moving, rooms
from training.data.levels.level_scene import LevelScene, SceneDoor
from training.learning.directional import fit_losses
from training.models.doorways import Doorways, _ways, aperture
from training.models.encoders import FieldShape, PathEncoder
from training.models.site import Extent, Reach


def encoder(scene: LevelScene) -> PathEncoder:
    extent = Extent.of_level(scene, doors=len(scene.doors))
    torch.manual_seed(0)
    return PathEncoder(extent, FieldShape(grid_spacing_m=2.0, grid_features=2), Reach.throughout(extent))


def between(scene: LevelScene, one, other) -> list[float]:
    ends = torch.tensor([[one, other]], dtype=torch.float32)
    doorways = encoder(scene)._doorways
    return doorways(doorways.rooms(ends))[0].tolist()


def with_wardrobe() -> LevelScene:
    """Behind a second, sliding door in the east room stands nothing: it parts no room."""
    second = box((6.0, 1.0, 0.0), (6.05, 1.9, 2.0), "wood")
    whole = level()
    geometry = whole.file.geometry
    doors = (*geometry.doors, SceneDoor(**door(SLIDE, name="screen", mesh="door1.npz"), surface_mass_kg_m2=10.0))
    file = whole.file.model_copy(update={"geometry": geometry.model_copy(update={"doors": doors})})
    return replace(whole, file=file, doors=(leaf(), second))


def test_the_door_is_between_places_of_two_rooms_and_not_within_one():
    scene = level()
    assert between(scene, WEST, EAST) == between(scene, EAST, WEST) == [1.0]
    assert between(scene, WEST, (3.5, 4.5, 1.0)) == between(scene, EAST, (4.6, 0.4, 2.0)) == [0.0]


def test_a_place_beyond_the_walls_counts_to_the_nearest_room():
    scene = level()
    assert between(scene, (-50.0, 2.0, 1.0), WEST) == [0.0]
    assert between(scene, (50.0, 2.0, 90.0), WEST) == [1.0]


def test_a_leaf_that_parts_no_rooms_is_between_none():
    scene = with_wardrobe()
    assert Doorways.of_level(scene).on_the_way.shape == (2, 2, 2)
    assert between(scene, WEST, EAST) == [1.0, 0.0]
    assert between(scene, (5.0, 1.4, 1.0), (7.0, 1.4, 1.0)) == [0.0, 0.0]


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_network_is_told_of_doors_on_the_way_until_they_are_open(share):
    scene = level()
    encode = encoder(scene)
    curve = Doorways.of_level(scene).apertures[0]
    passed = np.interp(share, np.linspace(0, 1, len(curve)), curve)
    path, openness = torch.zeros(2, DESCRIPTION), torch.full((2, 1), share)
    ends = [torch.tensor([WEST, WEST]), torch.tensor([EAST, (1.5, 3.0, 1.5)])]
    lost, all_doors, levels, shut, losses, loss = encode._of_doors(torch.stack(ends, dim=1), openness)
    assert (all_doors == share).all()
    assert levels[0] == levels[1]
    assert shut.flatten().tolist() == pytest.approx([1 - passed, 0.0], abs=1e-6)
    torch.testing.assert_close(losses, loss)
    assert (abs(losses[0]) < 1e-6) == (share == 1)
    assert losses[1] == 0
    assert (lost[0] <= 0).all()
    assert (lost[0].abs() < 1e-6).all() == (share == 1)
    assert (lost[1].abs() < 1e-6).all()
    assert encode(*ends, path, openness).shape == (2, encode.size)


def test_the_features_are_the_same_in_the_middle_of_a_wide_open_doorway():
    """So that a field does not jump there."""
    encode = encoder(level())
    openness = torch.ones(2, 1)
    ends = torch.tensor([[(3.95, 2.45, 1.5), WEST], [(4.2, 2.45, 1.5), WEST]])
    for feature in encode._of_doors(ends, openness):
        torch.testing.assert_close(feature[0], feature[1], rtol=0, atol=1e-6)


def test_places_are_in_the_rooms_that_the_grid_says():
    rng = np.random.default_rng(0)
    scene = level()
    doorways = Doorways.of_level(scene)
    ends = rng.uniform((-0.3, -0.3, -0.3), (8.3, 5.3, 3.1), (2_000, 2, 3))
    steps = np.rint((ends - doorways.origin_m) / doorways.step_m).astype(int)
    steps = np.clip(steps, 0, np.array(doorways.rooms.shape) - 1)
    rooms = doorways.rooms[tuple(np.moveaxis(steps, -1, 0))]
    expected = doorways.on_the_way[rooms[:, 0], rooms[:, 1]]
    looked_up = encoder(scene)._doorways
    found = looked_up(looked_up.rooms(torch.tensor(ends, dtype=torch.float32)))
    assert 0.3 < expected.mean() < 0.7
    # Single precision may round a place halfway between two points the other way.
    assert (found.numpy() == expected).all(axis=1).mean() > 0.998


def test_of_several_ways_the_one_with_fewest_doors_counts():
    """Four rooms in a row, along a corridor of three doors, with a door from end to end."""
    ways = _ways([(0, 1), (1, 2), (2, 3), (0, 3)], 4)
    np.testing.assert_array_equal(ways, ways.transpose(1, 0, 2))
    np.testing.assert_array_equal(ways[0, 3], [0, 0, 0, 1])
    np.testing.assert_array_equal(ways[0, 1], [1, 0, 0, 0])
    assert ways[0, 2].sum() == ways[1, 3].sum() == 2
    assert not ways[range(4), range(4)].any()


def test_rooms_that_no_door_joins_have_none_between_them():
    assert not _ways([(0, 1)], 3)[:, 2].any()


def test_an_imported_level_without_rooms_has_doors_between_nothing():
    """A sheet in the open, and a leaf in it."""
    open_air = level()
    geometry = open_air.file.geometry.model_copy(update={"open_sky": True})
    sheet = TriangleMesh(
        np.array([(0.0, 0.0, 0.0), (8.0, 0.0, 0.0), (8.0, 5.0, 0.0), (0.0, 5.0, 0.0)]),
        np.array([(0, 1, 2), (0, 2, 3)], np.int32),
        np.zeros(2, np.int32),
        (open_air.mesh.materials[0],),
    )
    scene = replace(open_air, file=open_air.file.model_copy(update={"geometry": geometry}), mesh=sheet)
    assert not Doorways.of_level(scene).on_the_way.any()


def curve(motion: LeafMotion, still: TriangleMesh | None = None):
    """What passes the door between the two rooms, and how far it is open."""
    passed = aperture(DoorLeaf(leaf(), motion), rooms().mesh if still is None else still)
    return passed, np.linspace(0, 1, len(passed))


def test_a_sliding_door_lets_by_nearly_as_much_as_it_is_open():
    passed, share = curve(SLIDE)
    assert abs(passed - share).max() < 0.08


def test_a_swinging_door_lets_nothing_by_until_it_leaves_its_frame():
    passed, _ = curve(SWING)
    assert (passed[0], passed[-1]) == (0, 1)
    assert (np.diff(passed) > -0.01).all()
    assert passed[2] < 0.01
    without_frame, _ = curve(SWING, box((-9.0,) * 3, (-8.0,) * 3, "wood"))
    assert without_frame[2] > 0.04


@pytest.mark.parametrize("share", [0.1, 0.25, 0.5])
def test_an_aperture_is_the_share_of_a_diffuse_field_that_comes_through(share):
    """Against the flux between two planes, one on each side of the door."""
    rng = np.random.default_rng(7)
    west, east = (rng.uniform((x, 0.05, 0.05), (x, 4.95, 2.75), (200_000, 3)) for x in (3.1, 5.05))
    flux = (east - west)[:, 0] ** 2 / np.linalg.norm(east - west, axis=1) ** 4
    passed = {
        openness: (flux * MeshTree(moving().mesh_at((openness,))).is_visible(west, east)).sum()
        for openness in (share, 1.0)
    }
    told, shares = curve(SWING)
    assert np.interp(share, shares, told) == pytest.approx(passed[share] / passed[1.0], abs=0.06)


def test_a_leaf_in_nobodys_way_lets_by_as_much_as_it_is_open():
    standing = LeafMotion("slide", (0.0, 0.0, 0.0), 0.0, (0.0, 0.0, 0.0))
    passed, share = curve(standing)
    np.testing.assert_allclose(passed, share, atol=1e-6)


def test_powers_through_doors_and_walls_add():
    """A leaf that lets by a hundredth, and two of them, beside walls that let by a thousandth."""
    encode = encoder(with_wardrobe())
    lost = encode._loss_between
    with torch.no_grad():
        lost.log_through_shut[:] = float(np.log(0.01))
        lost.log_through_walls[:] = float(np.log(0.001))
    rooms = torch.tensor([[0, 1]])
    both = lost(rooms, torch.tensor([[1.0, 1.0]]), torch.zeros(1, 2))
    one = lost(rooms, torch.tensor([[1.0, 0.0]]), torch.zeros(1, 2))
    ajar = lost(rooms, torch.tensor([[1.0, 0.0]]), torch.tensor([[0.25, 0.0]]))
    for found, power in ((one, 0.01 / 1.01), (both, (0.01 / 1.01) ** 2), (ajar, 0.26 / 1.01)):
        expected = 0.5 * np.log((power + 0.001) / 1.001)
        np.testing.assert_allclose(found.detach().numpy(), np.full((1, 7), expected), rtol=1e-5)


def test_what_doors_and_walls_let_by_is_found_from_levels():
    """Whichever rooms are louder, and although some levels are far off."""
    encode, truth = encoder(level()), encoder(level())
    rng = np.random.default_rng(5)
    with torch.no_grad():
        for parameter in truth.losses_learned:
            parameter += torch.tensor(rng.uniform(-1.0, 1.5, parameter.shape), dtype=torch.float32)
    rooms = torch.tensor(rng.integers(0, 2, (3_000, 2)))
    couple = rooms.sum(dim=1)
    shares = torch.tensor(rng.choice([0.0, 0.05, 0.1, 0.3, 1.0], (3_000, 1)), dtype=torch.float32)
    with torch.no_grad():
        wanted = truth.losses(rooms, shares)
        levels = wanted + torch.tensor([0.3, -1.0, 0.8])[couple][:, None] + 0.1 * torch.randn(3_000, 7)
        levels[::50] -= 4.0
    fit_losses(lambda: encode.losses(rooms, shares), list(encode.losses_learned), levels, couple)
    torch.testing.assert_close(encode.losses(rooms, shares), wanted, rtol=0, atol=0.1)


def test_the_network_looks_up_what_passes():
    scene = level()
    doorways, encode = Doorways.of_level(scene), encoder(scene)
    rng = np.random.default_rng(3)
    shares = np.concatenate([rng.random(500), [0.0, -0.0, 1.0, 1 + 1e-7, 0.5]]).astype(np.float32)
    found = encode._apertures(torch.tensor(shares[:, None]))[:, 0].numpy()
    steps = np.linspace(0, 1, doorways.apertures.shape[1])
    np.testing.assert_allclose(found, np.interp(shares, steps, doorways.apertures[0]), atol=1e-5)
