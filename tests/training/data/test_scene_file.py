import re

import numpy as np
import pytest

from training.data.scene_file import SceneFile, SceneFileError


def changed(tiny_scene, tmp_path, old: str, new: str):
    text = tiny_scene.read_text()
    assert old in text
    path = tmp_path / "scene.toml"
    path.write_text(text.replace(old, new, 1))
    return path


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("height_m = 2.5", "height_m = -2.5", "geometry.height_m"),
        ("spacing_m = 1.4", 'spacing_m = "wide"', "probes.spacing_m"),
        ("jitter_m = 0.2", "jitter = 0.2", "probes.jitter"),
        ("rays = 500", "rays = 5", "simulation.rays"),
        ("duration_s = 0.25", "duration_s = inf", "simulation.duration_s"),
        ("absorption = [0.3,", "absorption = [1.3,", "geometry.materials.walls.absorption.0"),
        ("[4.0, 0.0], [4.0, 3.0], [0.0, 3.0]", "[0.0, 3.0], [4.0, 3.0], [4.0, 0.0]", "geometry.corners"),
        ("heights_m = [1.2, 1.8]", "heights_m = [1.8, 1.2]", "probes.heights_m"),
        ("heights_m = [1.2, 1.8]", "heights_m = [1.2, 2.8]", "probes.heights_m"),
        ("listener = [1.0,", "listener = [-1.0,", "start.listener"),
        ("emitter = [3.0, 2.0, 1.5]", "emitter = [3.0, 2.0, 2.0]", "start.emitter"),
        (
            "[geometry.materials.walls]",
            '[[geometry.openings]]\nname = "none"\nstart = [4.0, 1.0]\nend = [6.0, 1.0]\n[geometry.materials.walls]',
            "geometry.openings.0",
        ),
        ("[geometry.materials.floor]", "[geometry.materials.lawn]", "geometry.materials.floor"),
        ("height_m = 2.5", "height_m = 250.0", "geometry.height_m: 250 m, and at most 200 m: is it in centimetres"),
        ("[4.0, 0.0], [4.0, 3.0]", "[2000.0, 0.0], [2000.0, 3.0]", "geometry.corners: 2,000 m, and at most 1,000 m"),
        ("[4.0, 0.0], [4.0, 3.0], [0.0, 3.0]", "[0.004, 0.0], [0.004, 0.003], [0.0, 0.003]", "is it in kilometres"),
        ("[4.0, 3.0]", "[4.0, nan]", "geometry.corners.2.1"),
        ("[4.0, 0.0], [4.0, 3.0]", "[4.0, 3.0], [4.0, 0.0]", "geometry.corners: edges 0 and 2 cross at (2, 1.5)"),
        ("listener = [1.0, 1.0,", "listener = [1.0, 5.0,", "start.listener: (1, 5) is outside of the walls"),
        ("emitter = [3.0, 2.0, 1.5]", "emitter = [3.0, 2.0, 15.0]", "start.emitter: its height, 15 m"),
        ("emitter = [3.0, 2.0, 1.5]", "emitter = [3.0, 2.0, 1.5]\nlistener_yaw_deg = 1e9", "start.listener_yaw_deg"),
        ("jitter_m = 0.2", "jitter_m = inf", "probes.jitter_m"),
        ("jitter_m = 0.2", "jitter_m = 0.8", "jitter_m: must be at most half of spacing_m, 0.7"),
        ("spacing_m = 1.4", "spacing_m = 1e-300", "probes.spacing_m"),
        ("wall_clearance_m = 0.4", "wall_clearance_m = 1e-9", "probes.wall_clearance_m"),
        ("heights_m = [1.2, 1.8]", "heights_m = [1.2, 2.49]", "probes.heights_m"),
        ("duration_s = 0.25", "duration_s = 600.0", "simulation.duration_s: at most 120 s"),
        ("duration_s = 0.25", "duration_s = 61.0", "duration_s: 61 s at 16000 Hz are 976,000 samples"),
        ("sample_rate = 16000", "sample_rate = 48", "simulation.sample_rate"),
        ("yaws = 4", "yaws = 1000000", "simulation.yaws"),
        ("rays = 500", "rays = 1000000000000", "simulation.rays"),
        ("arrival_directions = 6", "arrival_directions = 1000000", "simulation.arrival_directions"),
        ("image_order = 2", "image_order = 60", "simulation.image_order"),
    ],
)
def test_errors_name_file_and_field(tiny_scene, tmp_path, old, new, field):
    path = changed(tiny_scene, tmp_path, old, new)
    with pytest.raises(SceneFileError, match=re.escape(f"{path}: ") + f".*{re.escape(field)}"):
        SceneFile.read(path)


@pytest.mark.parametrize("content", [b"id = ", b"\xff\xfe\x00", b"a = " + b"[" * 100_000, b"a = " + b"9" * 10_000])
def test_what_is_not_toml_is_said_to_be_no_toml(tmp_path, content):
    path = tmp_path / "scene.toml"
    path.write_bytes(content)
    with pytest.raises(SceneFileError, match="not TOML"):
        SceneFile.read(path)


def test_missing_file(tmp_path):
    with pytest.raises(SceneFileError, match="cannot be read"):
        SceneFile.read(tmp_path / "absent.toml")


@pytest.mark.parametrize("seed", range(5))
def test_probes_keep_clear_of_the_walls(apartment, seed):
    probes = apartment.probe_positions(seed)
    plan, grid = apartment.geometry.floor_plan, apartment.probes
    assert plan.contains(probes).all()
    assert (plan.wall_distance_m(probes) >= grid.wall_clearance_m).all()
    assert (probes[:, 2] > grid.heights_m[0]).all()
    assert (probes[:, 2] < grid.heights_m[1]).all()


def test_there_is_a_probe_per_cell_and_in_the_doorway(apartment):
    probes = apartment.probe_positions(0)
    assert len(probes) == 8 * 5 + 1
    assert np.isclose(probes[:, :2], (4.1, 2.5)).all(axis=1).sum() == 1


def test_the_seed_decides_the_probes(apartment):
    np.testing.assert_array_equal(apartment.probe_positions(3), apartment.probe_positions(3))
    assert not np.array_equal(apartment.probe_positions(3), apartment.probe_positions(4))


def test_a_room_too_small_for_its_probes(tiny_scene, tmp_path):
    scene = SceneFile.read(changed(tiny_scene, tmp_path, "wall_clearance_m = 0.4", "wall_clearance_m = 1.6"))
    with pytest.raises(SceneFileError, match="probes"):
        scene.probe_positions(0)
