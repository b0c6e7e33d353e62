import numpy as np
import pytest

from server.acoustics.geometry import FloorPlan
from server.scene.manifest import Air
from training.simulation.images import images_in_height, images_in_plan
from training.simulation.rays import sphere_directions
from training.simulation.tracing import RoomTracer


def images(geometry, emitter, receivers, order):
    directions = sphere_directions(6)
    tracer = RoomTracer(geometry, Air(), receivers, duration_s=0.5, image_order=order, arrival_directions=directions)
    return tracer.images(emitter)


def in_order(positions, *others):
    order = np.lexsort(np.round(positions, 2).T)
    return positions[order], *(other[order] for other in others)


def test_first_order_in_a_shoebox_is_a_mirror_in_each_of_its_six_surfaces(shoebox):
    mirrored = []
    for axis in range(3):
        for wall in (0.0, shoebox.size_m[axis]):
            image = shoebox.emitter.copy()
            image[axis] = 2 * wall - image[axis]
            mirrored.append(image)
    expected = in_order(np.array(mirrored))[0]
    geometry = shoebox.geometry(absorption=0.36, scattering=0.0)
    found = images(geometry, shoebox.emitter, shoebox.receivers, 1)
    for receiver, (positions, amplitudes) in zip(shoebox.receivers, found, strict=True):
        np.testing.assert_allclose(in_order(positions)[0], expected)
        # One reflection leaves sqrt(1 - 0.36) of the pressure; the air next to nothing at 500 Hz.
        distance = np.linalg.norm(positions - receiver, axis=1)
        np.testing.assert_allclose(amplitudes[:, 2] * distance, 0.8, rtol=0.01)


def test_a_shoebox_has_as_many_images_as_lattice_points_of_its_order(shoebox):
    """Allen & Berkley: every receiver hears every image; those of order n are the points of |i| + |j| + |k| = n."""
    steps = np.abs(np.mgrid[-4:5, -4:5, -4:5]).sum(axis=0)
    for order in range(5):
        for positions, _ in images(shoebox.geometry(), shoebox.emitter, shoebox.receivers, order):
            assert len(positions) == np.sum((steps > 0) & (steps <= order))


@pytest.mark.parametrize("order", [1, 2, 3])
def test_images_are_those_of_pyroomacoustics(apartment, reference, order):
    """In two rooms with a doorway, through walls a thickness apart."""
    emitter, *receivers = apartment.probe_positions(1)[[3, 8, 20, 25, 33, 40]]
    oracle = reference(apartment.geometry, np.array(receivers), image_order=order, duration_s=0.1)
    positions, damping, heard = oracle.images(emitter)
    air = Air().absorption_db_per_m
    assert heard.any()
    assert not heard.all()
    for index, found in enumerate(images(apartment.geometry, emitter, np.array(receivers), order)):
        distance = np.linalg.norm(positions[heard[index]] - receivers[index], axis=1)[:, None]
        loss = 10 ** (-distance * air / 20) / distance
        expected = in_order(positions[heard[index]], damping[heard[index]] * loss)
        for mine, theirs in zip(in_order(*found), expected, strict=True):
            np.testing.assert_allclose(mine, theirs, atol=2e-4)


def test_images_in_height_are_counted_by_the_surfaces_that_mirror_them():
    heights, counts = images_in_height(1.0, 2.5, 3)
    np.testing.assert_allclose(heights, [1, -1, 4, 6, -4, -6, 9])
    np.testing.assert_array_equal(counts, [[0, 0], [1, 0], [0, 1], [1, 1], [1, 1], [2, 1], [1, 2]])


def test_a_receiver_round_the_corner_hears_what_two_walls_send_there():
    """An L: from one arm to the other, only by the outer walls."""
    plan = FloorPlan(((0, 0), (6, 0), (6, 2), (2, 2), (2, 6), (0, 6)), 2.5)
    ends = np.array([5.0, 1.5]), np.array([[1.5, 5.0]])
    assert not len(images_in_plan(plan, *ends, 1)[0])
    _, seen, walls = images_in_plan(plan, *ends, 2)
    # Left of x = 0 and below y = 0; in the other order the first wall is out of reach.
    np.testing.assert_allclose(seen, [[-5.0, -1.5]])
    np.testing.assert_array_equal(walls, [2])
