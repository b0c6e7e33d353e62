"""Bundles whose place is a mesh: that of a floor plan sounds as the plan, and faults are told by file and field."""

import json

import numpy as np
import pytest
from pydantic import ValidationError

from server.acoustics.mesh import TriangleMesh
from server.acoustics.surroundings import MeshSurroundings, PlanSurroundings
from server.api.catalogue import describe_scene
from server.core.errors import BundleError, RequestError
from server.field.fields_by_level import FieldsByLevel
from server.planning.places import place_of
from server.responses.full_response import FullResponse
from server.responses.loudness import loudness_map
from server.responses.room_sofa import _room
from server.scene.bundle import BUNDLED, Bundle, write_bundle
from server.scene.manifest import Manifest
from server.scene.mesh_geometry import MeshGeometry
from tests.conftest import MANIFEST
from tests.directional_flat import write_directional

APARTMENT = Bundle.load(BUNDLED / "apartment")
PLACE = MeshGeometry.of_plan(APARTMENT.manifest.geometry)
MESH = {"file": "geometry.npz", "materials": {name: each.model_dump() for name, each in PLACE.materials.items()}}
AS_MESH = {"format_version": 4, "geometry": None, "mesh": MESH}
BARE = {
    "fields": {},
    "levels": [{"name": "geometry", "field": "none"}],
    "frontier": [],
    "reference": None,
    "accepted": [],
    "transmission": True,
}


def written(folder, manifest, *, files=None, **changes):
    """A bundle with other values in its manifest, and the apartment's mesh among its files where it has one."""
    files = dict(files or {})
    if changes.get("mesh"):
        files["geometry.npz"] = PLACE.mesh.to_bytes()
    document = manifest.model_dump(mode="json") | changes
    document["files"] = dict.fromkeys(files, "0" * 64)
    return write_bundle(folder, Manifest.model_validate(document), files)


@pytest.fixture(scope="module")
def as_plan(tmp_path_factory):
    light = APARTMENT.manifest.geometry.materials.walls.model_copy(update={"surface_mass_kg_m2": 5.0})
    materials = APARTMENT.manifest.geometry.materials.model_copy(update={"walls": light})
    geometry = APARTMENT.manifest.geometry.model_copy(update={"materials": materials})
    return written(
        tmp_path_factory.mktemp("plan") / "bare",
        APARTMENT.manifest,
        **BARE | {"format_version": 2},
        geometry=geometry.model_dump(),
    )


@pytest.fixture(scope="module")
def as_mesh(tmp_path_factory):
    light = MESH["materials"]["walls"] | {"surface_mass_kg_m2": 5.0}
    mesh = MESH | {"materials": MESH["materials"] | {"walls": light}}
    return written(tmp_path_factory.mktemp("mesh") / "bare", APARTMENT.manifest, **AS_MESH | BARE | {"mesh": mesh})


def pairs(bundle, count, seed):
    """Places of listeners and emitters (count, 3), inside."""
    low, high = bundle.manifest.bounds.minimum, bundle.manifest.bounds.maximum
    places = np.random.default_rng(seed).uniform(low, high, (8 * count, 3))
    places = places[bundle.surroundings.contains(places)]
    return places[:count], places[count : 2 * count]


def test_what_is_written_is_read_back(as_mesh):
    assert as_mesh.manifest.format_version == 4
    assert as_mesh.mesh.to_bytes() == PLACE.mesh.to_bytes()
    assert isinstance(as_mesh.surroundings, MeshSurroundings)
    assert [surface.absorption for surface in as_mesh.surfaces] == [
        PLACE.materials[name].absorption for name in PLACE.mesh.materials
    ]
    again = json.loads((as_mesh.folder / "scene.json").read_text())
    assert again["mesh"]["file"] == "geometry.npz"


def test_manifests_of_plans_have_no_word_of_meshes(as_plan):
    assert "mesh" not in json.loads((as_plan.folder / "scene.json").read_text())
    assert isinstance(as_plan.surroundings, PlanSurroundings)
    assert as_plan.mesh is None


def test_a_plan_as_a_mesh_has_the_responses_of_the_plan(as_plan, as_mesh):
    """Direct sound, round corners and through walls, and first reflections."""
    responses = []
    listeners, emitters = pairs(as_plan, 40, 1)
    lengths = [each.surroundings.sound_paths(343.0) for each in (as_plan, as_mesh)]
    same = np.array(
        [
            abs(np.subtract(*(each.find(listener, emitter[None]).length_m[0] for each in lengths))) < 1e-4
            for listener, emitter in zip(listeners, emitters, strict=True)
        ]
    )
    assert same.mean() > 0.9
    hidden = ~as_plan.surroundings.is_visible(listeners, emitters)
    assert 5 < hidden.sum() < 35
    for bundle in (as_plan, as_mesh):
        whole = FullResponse.through_kemar(FieldsByLevel.load(bundle).default)
        responses.append(whole.impulse_responses(listeners, emitters, np.linspace(0, 6, len(listeners))))
    expected, found = responses
    error = np.sum((found - expected) ** 2, axis=(1, 2)) / np.sum(expected**2, axis=(1, 2))
    assert np.all(error[same] < 1e-4)


def test_a_field_of_directions_is_heard_in_a_mesh_as_in_the_plan(tmp_path):
    plan = write_directional(tmp_path / "plan")
    place = MeshGeometry.of_plan(plan.manifest.geometry)
    mesh = {"file": "geometry.npz", "materials": {name: each.model_dump() for name, each in place.materials.items()}}
    document = plan.manifest.model_dump(mode="json") | AS_MESH | {"mesh": mesh}
    files = {name: (plan.folder / name).read_bytes() for name in plan.manifest.files}
    files["geometry.npz"] = place.mesh.to_bytes()
    document["files"] = dict.fromkeys(files, "0" * 64)
    bundle = write_bundle(tmp_path / "mesh", Manifest.model_validate(document), files)
    listeners, emitters = pairs(plan, 6, 2)
    one, other = (
        FullResponse.through_kemar(FieldsByLevel.load(each).default).impulse_responses(listeners, emitters, np.zeros(6))
        for each in (plan, bundle)
    )
    assert np.sum((one - other) ** 2) < 1e-6 * np.sum(one**2)


def test_a_mesh_that_is_too_large_is_refused_by_file_and_field(as_mesh, tmp_path):
    low, high = PLACE.mesh.bounds_m
    far = np.append(PLACE.mesh.vertices_m, [low, low + np.array([1000.5, 0, 0]), high], axis=0)
    count = len(far)
    large = TriangleMesh(
        far,
        np.append(PLACE.mesh.triangles, [(count - 3, count - 2, count - 1)], axis=0),
        np.append(PLACE.mesh.surfaces, 0),
        PLACE.mesh.materials,
    )
    document = as_mesh.manifest.model_dump(mode="json") | {"files": {"geometry.npz": "0" * 64}}
    with pytest.raises(BundleError, match=r"geometry\.npz: vertices_m.* fills 100[01] x .* at most 1000 m"):
        write_bundle(tmp_path, Manifest.model_validate(document), {"geometry.npz": large.to_bytes()})


def test_places_inside_a_wall_are_refused(as_mesh):
    as_mesh.require_inside(as_mesh.manifest.start.listener, "listener")
    low, high = as_mesh.mesh.bounds_m
    places = np.random.default_rng(1).uniform(low, high, (4000, 3))
    (x, y, z), *_ = places[~as_mesh.surroundings.contains(places)]
    with pytest.raises(RequestError, match=r"is inside a wall|is outside"):
        as_mesh.require_inside((x, y, z), "listener")


def test_a_planner_a_page_and_a_map_take_it(as_mesh):
    place = place_of(as_mesh, ())
    assert place.paths is not None
    assert place.reflections is not None
    levels = FieldsByLevel.load(as_mesh)
    described = describe_scene(levels)
    assert not described.walls_known
    assert described.height_m == pytest.approx(np.ptp([each[2] for each in vars(as_mesh.manifest.bounds).values()]))
    heard = FullResponse.through_kemar(levels.default)
    drawn = loudness_map(heard, as_mesh.manifest.start.emitter, listener_height_m=1.5, spacing_m=0.5)
    assert np.isfinite(drawn.levels_db).mean() > 0.9
    kinds, _ = _room(as_mesh)
    assert kinds["RoomDescription"].endswith("triangles, made of walls, floor, ceiling")


def test_levels_that_reuse_responses_are_refused():
    level = {"name": "nodes", "field": "directional", "reuse": {"spacing_m": 0.5, "turn_deg": 30}}
    document = MANIFEST.model_dump(mode="json") | AS_MESH | {"levels": [level | {"field": "arithmetic"}]}
    with pytest.raises(ValidationError, match=r"levels\.nodes\.reuse: is for floor plans"):
        Manifest.model_validate(document | {"files": document["files"] | {"geometry.npz": "0" * 64}})


def edited(folder, as_mesh, place, value):
    """A copy of the bundle with another value at a place of its manifest."""
    folder.mkdir()
    document = json.loads((as_mesh.folder / "scene.json").read_text())
    inside = document
    for key in place[:-1]:
        inside = inside[key]
    inside[place[-1]] = value
    (folder / "scene.json").write_text(json.dumps(document))
    (folder / "geometry.npz").write_bytes((as_mesh.folder / "geometry.npz").read_bytes())
    return folder


@pytest.mark.parametrize(
    ("place", "value", "told"),
    [
        (("format_version",), 2, r"scene\.json: .*format_version: is 2, but a mesh makes it 4"),
        (("mesh",), None, "format_version: is 4, but fields like these make it 2"),
        (("geometry",), APARTMENT.manifest.geometry.model_dump(), "mesh: there is a floor plan in geometry too"),
        (("mesh", "file"), "other.npz", r"mesh\.file: other\.npz is not listed"),
        (("mesh", "file"), "arrays.npz", r"mesh\.file: arrays\.npz is for frozen_noise"),
        (("mesh", "file"), "../geometry.npz", r"mesh\.file"),
        (("mesh", "materials", "walls", "absorption"), [0.5] * 6, r"mesh\.materials\.walls\.absorption"),
        (("mesh", "materials"), {"walls": MESH["materials"]["walls"]}, r"mesh\.materials: 'floor' is missing"),
        (("mesh", "surprise"), 1, r"mesh\.surprise"),
        (("start", "listener"), [4.1, 0.5, 1.5], r"start\.listener: is not in the air"),
        (("bounds", "maximum"), [80, 50, 2], "bounds: must lie in the box around the mesh"),
    ],
)
def test_what_is_wrong_is_named(tmp_path, as_mesh, place, value, told):
    with pytest.raises(BundleError, match=told):
        Bundle.load(edited(tmp_path / "bundle", as_mesh, place, value))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"triangles": np.array([(0, 1, 10_000)], np.int32), "surfaces": np.zeros(1, np.int32)},
            "mesh: triangles: row 0",
        ),
        ({"vertices_m": np.full((40, 3), np.nan)}, "mesh: vertices_m: vertex 0"),
        ({"surfaces": np.zeros(3, np.int32)}, "mesh: surfaces"),
        ({"materials": np.array([1, 2, 3])}, "mesh: materials"),
        (None, r"mesh: is no readable \.npz file"),
    ],
)
def test_arrays_that_are_no_mesh_are_named(tmp_path, as_mesh, changes, told):
    mesh = PLACE.mesh
    arrays = {name: np.asarray(getattr(mesh, name)) for name in ("vertices_m", "triangles", "surfaces", "materials")}
    path = tmp_path / "geometry.npz"
    if changes is None:
        path.write_bytes(b"no archive")
    else:
        np.savez_compressed(path, **arrays | changes)
    with pytest.raises(BundleError, match=told):
        write_bundle(tmp_path / "bundle", as_mesh.manifest, {"geometry.npz": path.read_bytes()})
