"""Pictures of a furnished flat: rays end where the geometry is, light and pictures are repeatable."""

from pathlib import Path

import numpy as np
import pytest

from training.data.scene_file import SceneFile
from training.sight.cameras import Camera, Views, ViewsError
from training.sight.drawing import Drawing, cast
from training.sight.flat import Flat, Kind, Surfaces
from training.sight.views import choose_cameras, draw_views

SCENES = Path(__file__).parents[3] / "training" / "scenes"
SIZE = 24, 16


def untracked(steps, _):
    return steps


@pytest.fixture(scope="module")
def tiny(tiny_scene) -> SceneFile:
    return SceneFile.read(tiny_scene)


@pytest.fixture(scope="module")
def flat(tiny) -> Flat:
    return Flat.furnished(tiny.geometry, 0)


@pytest.fixture(scope="module")
def drawing(flat) -> Drawing:
    return Drawing(flat, 0)


@pytest.fixture
def cameras(flat) -> list[Camera]:
    return choose_cameras(flat, 4, SIZE, np.random.default_rng(3))


def only(surfaces: Surfaces, *kinds: Kind) -> Surfaces:
    keep = np.isin(surfaces.kind, kinds)
    return Surfaces(**{name: part[keep] for name, part in vars(surfaces).items()})


def test_a_point_that_a_ray_meets_projects_to_the_pixel_of_the_ray(flat, cameras) -> None:
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    for camera in cameras:
        origins, directions = camera.rays()
        points = origins + cast(flat.surfaces, origins, directions).depth_m[:, None] * directions
        np.testing.assert_allclose(camera.project(points), np.stack([x, y], -1).reshape(-1, 2), atol=1e-6)


def test_a_camera_sees_left_on_the_left_and_up_above() -> None:
    camera = Camera.looking(np.array([1.0, 2.0, 1.5]), np.pi / 2, 0.0, SIZE, 90.0)
    ahead, west, above, behind = camera.project(
        np.array([[1.0, 4.0, 1.5], [0.0, 4.0, 1.5], [1.0, 4.0, 2.0], [1.0, 1.0, 1.5]])
    )
    np.testing.assert_allclose(ahead, [(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2])
    assert west[0] < ahead[0]
    assert above[1] < ahead[1]
    assert np.isnan(behind).all()
    # At 90 degrees the edge of the picture is as far to the side as it is ahead.
    assert camera.project(np.array([[-1.0, 4.0, 1.5]]))[0, 0] == pytest.approx(ahead[0] - SIZE[0] / 2)


def test_the_depth_of_an_empty_room_is_the_distance_to_its_nearest_plane_ahead() -> None:
    """Of a convex room, plane by plane and without rectangles."""
    scene = SceneFile.read(SCENES / "small1.toml")
    plan = scene.geometry.floor_plan
    assert not len(plan.bend_corners)
    surfaces = only(Flat.furnished(scene.geometry, 0).surfaces, Kind.FLOOR, Kind.CEILING, Kind.WALL)
    rng = np.random.default_rng(0)
    low, high = np.min(plan.corners, axis=0), np.max(plan.corners, axis=0)
    origins = rng.uniform([*low, 0], [*high, plan.height_m], (400, 3))
    origins = origins[plan.contains(origins)]
    directions = rng.normal(size=origins.shape)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    expected = np.full(len(origins), np.inf)
    for height, sign in ((0.0, -1), (plan.height_m, 1)):
        towards = sign * directions[:, 2] > 0
        distance = (height - origins[:, 2]) / directions[:, 2]
        expected = np.where(towards, np.minimum(expected, distance), expected)
    for start, end in plan.walls:
        out = np.array([(end - start)[1], -(end - start)[0]])
        towards = directions[:, :2] @ out
        distance = ((start - origins[:, :2]) @ out) / towards
        expected = np.where(towards > 0, np.minimum(expected, distance), expected)
    np.testing.assert_allclose(cast(surfaces, origins, directions).depth_m, expected, rtol=1e-9, atol=1e-9)


def test_a_ray_stops_at_a_box_in_its_way(flat) -> None:
    box = max(flat.boxes, key=lambda each: np.prod(np.subtract(each.high, each.low)))
    middle = (np.array(box.low) + box.high) / 2
    origin = np.array([middle[0], middle[1], flat.geometry.height_m - 0.01])
    hits = cast(only(flat.surfaces, box.kind, Kind.FLOOR), origin[None], np.array([[0.0, 0.0, -1.0]]))
    highest = max(
        other.high[2]
        for other in flat.boxes
        if other.kind == box.kind
        and other.low[0] < middle[0] < other.high[0]
        and other.low[1] < middle[1] < other.high[1]
    )
    assert hits.depth_m[0] == pytest.approx(origin[2] - highest)


@pytest.mark.parametrize("name", ["large1", "large2"])
def test_furniture_stands_inside_the_walls_and_leaves_doors_free(name: str) -> None:
    geometry = SceneFile.read(SCENES / f"{name}.toml").geometry
    flat = Flat.furnished(geometry, 0)
    plan = geometry.floor_plan
    standing = [box for box in flat.boxes if box.low[2] < 1.0]
    assert len(standing) > 20
    for box in standing:
        corners = np.array([(x, y, 0.1) for x in (box.low[0], box.high[0]) for y in (box.low[1], box.high[1])])
        assert plan.contains(corners).all(), box
    doors = np.array([(*opening.centre, 1.0) for opening in geometry.openings])
    assert flat.is_free(doors, 0.3).all()
    assert len(flat.lamps) == len(geometry.openings) + 1


def test_the_same_seed_draws_the_same_and_another_one_does_not(drawing, tiny, cameras) -> None:
    picture = drawing.picture(cameras[0])
    np.testing.assert_array_equal(Drawing(Flat.furnished(tiny.geometry, 0), 0).picture(cameras[0]), picture)
    assert np.any(Drawing(Flat.furnished(tiny.geometry, 1), 1).picture(cameras[0]) != picture)


def test_a_surface_has_the_same_colour_from_wherever_it_is_seen(flat, drawing) -> None:
    """Which a network with one colour for each place could learn exactly."""
    target = np.array([*np.mean(flat.geometry.corners, axis=0), 2.0])
    target[2] -= cast(flat.surfaces, target[None], np.array([[0.0, 0.0, -1.0]])).depth_m[0]
    origins = target + np.array([[0.4, 0.0, 0.9], [0.0, 0.5, 1.2], [-0.3, 0.2, 0.6]])
    directions = (target - origins) / np.linalg.norm(target - origins, axis=-1, keepdims=True)
    colours = drawing.colours(origins, directions)
    np.testing.assert_allclose(colours, colours[:1].repeat(3, axis=0), atol=1e-6)


def test_it_is_darker_under_furniture_than_beside_it() -> None:
    flat = Flat.furnished(SceneFile.read(SCENES / "large1.toml").geometry, 0)
    table = next(box for box in flat.boxes if box.kind == Kind.WOOD and box.low[2] > 0.6 and box.high[2] < 0.8)
    middle = (np.array(table.low) + table.high) / 2
    points = np.array([[middle[0], middle[1], 0.02], [*flat.lamps[flat.room_of(middle[None])[0]][:2], 0.02]])
    drawing = Drawing(Flat(flat.geometry, flat.rooms, flat.boxes, flat.lamps, _near(flat.surfaces, table)), 0)
    light = drawing._falling(points, np.array([[0.0, 0.0, 1.0]] * 2), np.random.default_rng(0)).sum(axis=1)
    assert light[0] < 0.6 * light[1]


def _near(surfaces: Surfaces, box) -> Surfaces:
    """Floor and table only, so that light is computed in a moment."""
    inside = (surfaces.origin >= np.array(box.low) - 1e-9) & (surfaces.origin <= np.array(box.high) + 1e-9)
    keep = inside.all(axis=1) | (surfaces.kind == Kind.CEILING)
    return Surfaces(**{name: part[keep] for name, part in vars(surfaces).items()})


def test_views_are_read_as_they_were_drawn_and_test_views_are_from_elsewhere(tiny, tmp_path: Path) -> None:
    draw_views(tiny, tmp_path, views=5, test=3, size=SIZE, seed=4, track=untracked)
    views = Views.read(tmp_path)
    assert (views.scene, len(views.training), len(views.test)) == (tiny.id, 5, 3)
    again = Drawing(Flat.furnished(tiny.geometry, 4), 4)
    np.testing.assert_array_equal(views.test_pictures[1], again.picture(views.test[1]))
    places = np.array([camera.position for camera in views.training])
    for camera in views.test:
        assert np.linalg.norm(places - camera.position, axis=-1).min() >= 0.3
    with pytest.raises(ViewsError, match=r"cameras\.json: holds views of another .*choose an empty folder"):
        draw_views(tiny, tmp_path, views=5, test=3, size=SIZE, seed=5, track=untracked)
    (tmp_path / "test-001.png").unlink()
    with pytest.raises(ViewsError, match=r"test-001\.png: views\.6\.file: .*draw views again"):
        Views.read(tmp_path)


def test_a_folder_without_cameras_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ViewsError, match=r"cameras\.json: No such file .*nafir-train draw-views"):
        Views.read(tmp_path)
    (tmp_path / "cameras.json").write_text('{"format": 9}')
    with pytest.raises(ViewsError, match=r"format: is 9, and 1 is read"):
        Views.read(tmp_path)
    (tmp_path / "cameras.json").write_text('{"format": 1, "width": 8, "height": 8}')
    with pytest.raises(ViewsError, match=r"focal_px"):
        Views.read(tmp_path)
