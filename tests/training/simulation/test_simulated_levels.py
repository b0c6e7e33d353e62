"""Levels are simulated as floor plans are: the apartment as a level gives the data of the apartment."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress
from typer.testing import CliRunner

from server.acoustics.decibels import power_to_db
from server.acoustics.mesh import TriangleMesh
from server.acoustics.mesh_plan import floors_of
from server.acoustics.surroundings import MeshSurroundings
from server.scene.bundle import Bundle
from server.scene.geometry import Material
from server.scene.mesh_geometry import MeshGeometry
from training.cli.main import app
from training.data.dataset import GEOMETRIC_ORDER, Dataset, DatasetError
from training.data.levels.level_scene import LevelScene, SceneDoor, read_scene
from training.data.levels.probe_places import probe_places
from training.data.levels.walkable import reached_ground
from training.data.scene_file import SceneFile, SceneFileError
from training.data.simulation_plan import SimulationPlan
from training.parallel.jobs import open_jobs
from training.simulation.direct_paths import DirectPaths
from training.simulation.rays import sphere_directions
from training.simulation.references import References
from training.simulation.run import prepared, simulate
from training.simulation.tracing import RoomTracer

APARTMENT = SceneFile.read(Path(__file__).resolve().parents[3] / "training/scenes/apartment.toml")
BRIEF = APARTMENT.simulation.model_copy(
    update={"rays": 300, "duration_s": 0.3, "arrival_directions": 6, "yaws": 1, "sample_rate": 16_000}
)
PROBES = APARTMENT.probes.model_copy(update={"spacing_m": 2.0, "wall_clearance_m": 0.3})


def level_of(doors=(), leaves=()):
    base = LevelScene.of_plan(APARTMENT.model_copy(update={"id": "level", "probes": PROBES, "simulation": BRIEF}))
    geometry = base.file.geometry.model_copy(update={"doors": doors})
    return LevelScene(base.file.model_copy(update={"geometry": geometry}), base.mesh, leaves)


def everything_in(level):
    return SimulationPlan.everything(GEOMETRIC_ORDER, level.simulation.rays, transmission=level.has_mass)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("level") / "scene"
    level_of().write(path)
    return path


@pytest.fixture(scope="module")
def dataset(folder, tmp_path_factory):
    with open_jobs(None, threads=1) as jobs, Progress(disable=True) as progress:
        return simulate(folder, tmp_path_factory.mktemp("data") / "level", seed=3, jobs=jobs, progress=progress)


def test_a_scene_is_read_by_its_folder_its_file_and_as_a_plan(folder):
    assert isinstance(read_scene(folder), LevelScene)
    assert isinstance(read_scene(folder / "scene.toml"), LevelScene)
    with pytest.raises(SceneFileError, match=r"geometry\.mesh: is an imported level, and this takes a floor plan"):
        SceneFile.read(folder / "scene.toml")
    with pytest.raises(SceneFileError, match="cannot be read"):
        read_scene(folder.parent / "none.toml")


def test_a_scene_file_of_another_name_is_what_is_simulated_and_bundled(folder, tmp_path):
    level_of().write(tmp_path)
    text = (folder / "scene.toml").read_text(encoding="utf-8")
    variant = tmp_path / "variant.toml"
    variant.write_text(text.replace('id = "level"', 'id = "variant"'), encoding="utf-8")
    assert read_scene(variant).id == "variant"
    assert read_scene(tmp_path).id == "level"
    created = Dataset.create(tmp_path / "data", variant, 3, everything_in(read_scene(variant)))
    assert created.place.id == Dataset.open(created.folder, finished=False).place.id == "variant"
    result = CliRunner().invoke(app, ["bundle-level", str(variant), "-o", str(tmp_path / "bundle")])
    assert result.exit_code == 0, result.output
    assert Bundle.load(tmp_path / "bundle").id == "variant"


def test_probes_stand_above_the_floors_and_clear_of_surfaces():
    level = level_of()
    probes = level.probe_positions(3)
    np.testing.assert_array_equal(probes, level.probe_positions(3))
    assert not np.array_equal(probes, level.probe_positions(4))
    low, high = PROBES.heights_m
    assert np.all((probes[:, 2] >= low) & (probes[:, 2] <= high))
    assert APARTMENT.geometry.floor_plan.contains(probes).all()
    assert np.all(level.surroundings.tree.distance_m(probes) >= 0.3)
    assert len(probes) > 6
    assert floors_of(level.mesh) == [0.0]


def sheets(*corners_m):
    """A mesh of rectangles, each given by its corners (4, 3), in as many strips along its first side as metres."""
    vertices, triangles = [], []
    for corners in np.asarray(corners_m, dtype=float):
        count = max(1, round(np.linalg.norm(corners[1] - corners[0])))
        share = np.linspace(0, 1, count + 1)[:, None]
        right, left = (a + share * (b - a) for a, b in (corners[:2], corners[:1:-1]))
        first = sum(map(len, vertices)) + np.arange(count)
        vertices += [right, left]
        above = first + count + 1
        triangles += [np.stack(each, -1) for each in ((first, first + 1, above + 1), (first, above + 1, above))]
    faces = np.concatenate(triangles)
    return TriangleMesh(np.concatenate(vertices), faces, np.zeros(len(faces), int), ("stone",))


def rectangle(x, y, z, *, high_z=None):
    (west, east), (south, north) = x, y
    top = z if high_z is None else high_z
    return [(west, south, z), (east, south, top), (east, north, top), (west, north, z)]


def test_a_ramp_that_joins_two_floors_is_none_and_hides_none():
    ramp = rectangle((10, 20), (0, 2), 0.0, high_z=3.0)
    joined = sheets(rectangle((0, 10), (0, 10), 0.0), ramp, rectangle((20, 30), (0, 10), 3.0))
    assert joined.normals[:, 2].min() > 0.9
    np.testing.assert_allclose(floors_of(joined), [0.0, 3.0], atol=0.01)
    # In steps of 5 cm, by which everything hangs together.
    stairs = [rectangle((10 + at / 20, 10 + at / 20 + 0.05), (0, 2), at * 3 / 200) for at in range(200)]
    stepped = sheets(rectangle((0, 10), (0, 10), 0.0), *stairs, rectangle((20, 30), (0, 10), 3.0))
    np.testing.assert_allclose(floors_of(stepped), [0.0, 3.0], atol=0.01)
    assert floors_of(sheets(rectangle((0, 0.5), (0, 0.5), 0.0))) == []


def test_places_above_a_slope_have_one_probe_each():
    """A slope is many floors, and one ground."""
    slope = MeshSurroundings(sheets(rectangle((0, 10), (0, 10), 0.0, high_z=1.5)), open_sky=True)
    probes = PROBES.model_copy(update={"spacing_m": 1.0, "jitter_m": 0.1, "heights_m": (1.2, 1.3)})
    ground = reached_ground(slope, [(5.0, 5.0, 2.0)], ear_m=1.2, head_room_m=1.6)
    found = probe_places(slope, ground, probes, np.random.default_rng(1))
    assert len(floors_of(slope.mesh)) > 5
    assert 90 <= len(found) <= 110
    above_m = found[:, 2] - 0.15 * found[:, 0]
    assert np.all((above_m > 1.2 - 1e-9) & (above_m < 1.3 + 1e-9))


def test_too_many_cells_are_refused_before_any_is_drawn():
    base = level_of()
    wide = replace(base.mesh, vertices_m=base.mesh.vertices_m * (100, 100, 1))
    fine = PROBES.model_copy(update={"spacing_m": 1.0})
    scene = LevelScene(base.file.model_copy(update={"probes": fine}), wide, ())
    with pytest.raises(SceneFileError, match=r"level: probes\.spacing_m: at most 100,000 cells .* \d+ x \d+ cells"):
        scene.probe_positions(1)


def test_its_dataset_is_that_of_any_scene(dataset):
    assert dataset.place.id == "level"
    again = Dataset.open(dataset.folder)
    pairs = again.pairs(held_out=False)
    energies = again.read_energy(pairs[:4])
    assert energies.shape == (4, 6, 7, 75)
    assert np.all(energies.sum(axis=(1, 3)) > 0)
    assert np.all(np.isfinite(References(again).complete(*pairs[0])))
    np.testing.assert_allclose(
        again.onset_s, APARTMENT.geometry.floor_plan.path_length_m(again.probes[:, None], again.probes[None]) / 343,
        atol=0.05 / 343,
    )  # fmt: skip
    with pytest.raises(DatasetError, match="holds a level, and this takes a floor plan"):
        _ = again.scene


def test_an_interrupted_simulation_goes_on_and_another_level_is_refused(dataset, folder, tmp_path):
    with open_jobs(None, threads=1) as jobs, Progress(disable=True) as progress:
        again = simulate(folder, dataset.folder, seed=3, jobs=jobs, progress=progress)
        assert not again.remaining()
        other = level_of()
        turned = replace(other, mesh=other.mesh.only(np.arange(len(other.mesh.triangles) - 1)))
        turned.write(tmp_path / "other")
        with pytest.raises(DatasetError, match="holds another scene"):
            simulate(tmp_path / "other", dataset.folder, seed=3, jobs=jobs, progress=progress)


def test_a_simulation_that_was_begun_keeps_its_probes(folder, tmp_path, monkeypatch):
    """Another version of the program may place them elsewhere."""
    begun = Dataset.create(tmp_path, folder, 3, everything_in(level_of()))
    elsewhere = level_of().probe_positions(4)[: len(begun.probes)]
    monkeypatch.setattr(LevelScene, "probe_positions", lambda *_: elsewhere)
    other = prepared(level_of(), seed=3, plan=begun.effects)
    with open_jobs(None, threads=1) as jobs, Progress(disable=True) as progress:
        with pytest.raises(DatasetError, match="begun with probes at other places"):
            simulate(folder, tmp_path, seed=3, jobs=jobs, progress=progress, simulation=other)
        assert not simulate(folder, tmp_path, seed=3, jobs=jobs, progress=progress).remaining()
    pair = begun.pairs(held_out=False)[0]
    kept = prepared(level_of(), seed=3, plan=begun.effects, begun=begun)
    np.testing.assert_allclose(
        begun.read_energy(pair[None])[0], kept.energies(pair[0], pair[1:], 0)[0], rtol=0.02, atol=1e-12
    )


def test_a_level_sounds_as_its_plan():
    """Images and direct paths are the plan's; rays bring its energy, and that of images by more surfaces than one."""
    level, probes = level_of(), level_of().probe_positions(1)
    plan = everything_in(level)
    of_plan = APARTMENT.model_copy(update={"simulation": BRIEF})
    here, there = (RoomTracer.of(scene, plan, probes[1:]) for scene in (of_plan, level))
    for one, other in zip(here.images(probes[0]), there.images(probes[0]), strict=True):
        order, other_order = (np.lexsort(each[0].T.round(6)) for each in (one, other))
        np.testing.assert_allclose(one[0][order], other[0][other_order], atol=1e-6)
        np.testing.assert_allclose(one[1][order], other[1][other_order], rtol=1e-6)
    energies = [
        each.energy(probes[0], rays=3000, rng=np.random.default_rng(1)).sum(axis=(1, 3)).mean(axis=0)
        for each in (here, there)
    ]
    np.testing.assert_allclose(power_to_db(energies[0] / energies[1]), 0, atol=0.5)
    one, other = (DirectPaths.of(scene, plan) for scene in (of_plan, level))
    for listener in probes[1:]:
        for found, expected in zip(other.images(probes[0], listener), one.images(probes[0], listener), strict=True):
            np.testing.assert_allclose(found, expected, rtol=0.02, atol=0.02)


def leaf():
    """The doorway of the apartment, shut by a sheet."""
    vertices = np.array([(4.1, 2.0, 0), (4.1, 3.0, 0), (4.1, 3.0, 2.8), (4.1, 2.0, 2.8)], dtype=float)
    mesh = level_of().mesh
    return type(mesh)(vertices, [(0, 1, 2), (0, 2, 3)], [0, 0], ("walls",))


def door(openness, **changes):
    return SceneDoor(
        **{
            "name": "middle", "mesh": "door0.npz", "kind": "swing", "pivot": (4.1, 2.0, 0.0), "angle_deg": 90.0,
            "slide_m": (0.0, 1.0, 0.0), "openness": openness, "surface_mass_kg_m2": 12.0, **changes,
        }
    )  # fmt: skip


def test_doors_stand_as_open_as_they_are():
    hall, room = np.array((2.0, 2.5, 1.5)), np.array((6.0, 2.5, 1.5))
    shut, ajar, wide = (level_of((door(openness),), (leaf(),)) for openness in (0.0, 0.75, 1.0))
    sees = [bool(level.surroundings.is_visible(hall, room)) for level in (shut, ajar, wide)]
    assert sees == [False, True, True]
    heard_db = [
        level.surroundings.sound_paths(343.0).find(hall, room[None]).screen_db[0, 0] for level in (shut, ajar, wide)
    ]
    assert heard_db[0] == -100
    assert heard_db[2] > -6
    corner = wide.place.mesh.vertices_m[-2]
    np.testing.assert_allclose(corner, (3.1, 2.0, 2.8), atol=1e-12)
    slid = level_of((door(0.5, kind="slide"),), (leaf(),)).place.mesh.vertices_m[-4:]
    np.testing.assert_allclose(slid, np.add(leaf().vertices_m, (0, 0.5, 0)))
    own = shut.place.materials["walls of door middle"]
    assert isinstance(own, Material)
    assert own.surface_mass_kg_m2 == 12.0
    assert shut.place.materials["walls"].surface_mass_kg_m2 == APARTMENT.geometry.materials.walls.surface_mass_kg_m2
    # What goes through the shut leaf is heard, by its mass.
    positions, _ = DirectPaths.of(shut, everything_in(shut)).images(hall, room)
    assert any(np.allclose(position, hall) for position in positions)


def test_a_doors_mass_is_its_own_whatever_its_materials_are_called():
    wall = APARTMENT.geometry.materials.walls.model_copy(update={"surface_mass_kg_m2": 300.0})
    others = ["x" * 127 + "1", "x" * 127 + "2", "walls of door middle"]
    names = ("walls", "floor", "ceiling", *others)
    base, sheet = level_of(), leaf()
    mesh = replace(base.mesh, surfaces=np.arange(len(base.mesh.triangles)) % 6, materials=names)
    doors = (door(0.0), door(0.0, name="second"))
    leaves = tuple(replace(sheet, surfaces=[0, 1], materials=each) for each in (("walls", others[0]), others[:2]))
    geometry = base.file.geometry.model_copy(update={"materials": dict.fromkeys(names, wall), "doors": doors})
    place = LevelScene(base.file.model_copy(update={"geometry": geometry}), mesh, leaves).place
    masses = [place.materials[name].surface_mass_kg_m2 for name in place.mesh.materials]
    assert masses[:6] == [300.0] * 6
    assert masses[6:] == [12.0] * 4
    np.testing.assert_array_equal(place.mesh.surfaces[-4:], [6, 7, 8, 9])
    np.testing.assert_array_equal(place.mesh.surfaces[:-4], mesh.surfaces)


def test_doors_with_which_there_is_more_than_a_mesh_has_are_refused_by_name(tmp_path):
    base, names = level_of(), [f"m{number}" for number in range(1023)]
    mesh = replace(base.mesh, surfaces=np.zeros(len(base.mesh.triangles), int), materials=("walls", *names))
    wall = APARTMENT.geometry.materials.walls
    geometry = base.file.geometry.model_copy(
        update={"materials": dict.fromkeys(mesh.materials, wall), "doors": (door(0.0),)}
    )
    LevelScene(base.file.model_copy(update={"geometry": geometry}), mesh, (leaf(),)).write(tmp_path)
    with pytest.raises(SceneFileError, match=r"scene\.toml: geometry\.doors: .* not 1,025"):
        read_scene(tmp_path)


def test_what_rays_bring_behind_a_shut_door_goes_through_its_leaf():
    level = level_of((door(0.0),), (leaf(),))
    plan, inside = everything_in(level), np.array([2.0, 2.5, 1.5])
    receivers = np.array([inside + 0.5, (6.0, 2.5, 1.5)])

    def energy(**effects):
        tracer = RoomTracer.of(level, replace(plan, **effects), receivers)
        return tracer.energy(inside, rays=1000, rng=np.random.default_rng(1)).sum(axis=(1, 3))

    muffled = energy()
    assert plan.transmission
    assert np.all(muffled > 0)
    # A leaf of 12 kg/m2 takes 16 dB at 125 Hz, and 6 dB more in every octave.
    behind_db = power_to_db(muffled[0] / muffled[1])
    assert 10 < behind_db[0] < 30
    assert behind_db[3] - behind_db[0] > 10
    closed = energy(transmission=False)
    assert np.all(closed[0] > 0)
    assert np.all(closed[1] == 0)


def test_a_mesh_has_images_by_one_surface_only():
    with pytest.raises(ValueError, match="image_order"):
        RoomTracer(
            MeshGeometry.of_plan(APARTMENT.geometry),
            None,
            np.ones((1, 3)),
            duration_s=0.1,
            image_order=2,
            arrival_directions=sphere_directions(6),
        )


def test_the_command_line_takes_a_folder(folder, tmp_path):
    runner = CliRunner()
    planned = runner.invoke(app, ["plan", str(folder)])
    assert planned.exit_code == 0
    assert "probes" in planned.output
    assert "by a trial" in " ".join(planned.output.split())
    result = runner.invoke(app, ["simulate", str(folder), "-o", str(tmp_path / "data"), "--workers", "1"])
    assert result.exit_code == 0, result.output
    assert "pairs to train on" in result.output
    assert (tmp_path / "data" / "geometry.npz").exists()
    refused = runner.invoke(app, ["plan", str(folder), "--effects", "early_reflections=on"])
    assert refused.exit_code != 0
    assert "effects.early_reflections: cannot be on in a level" in str(refused.exception)
