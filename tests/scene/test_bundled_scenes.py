"""Every GET route of every bundled scene answers, with no parameter but those it needs."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
from starlette.testclient import TestClient

from server.api.app import create_app
from server.api.catalogue import load_scenes
from server.api.settings import Settings
from server.responses.loudness import MAX_POINTS, usual_spacing_m
from server.scene.bundle import Bundle, bundled_scenes
from tests.api.test_routes import wait_until_ready

SCENES = [folder.name for folder in bundled_scenes()]
WITH_FIELDS = [folder.name for folder in bundled_scenes() if Bundle.load(folder).manifest.fields]


@pytest.fixture(scope="module")
def client():
    with TestClient(create_app(Settings()), raise_server_exceptions=False) as client:
        wait_until_ready(client)
        yield client


def needed(operation: dict, scene: dict) -> dict[str, str]:
    """Values for the parameters without which `operation` refuses, from where a visitor of the scene starts."""
    known = {
        "scene": scene["id"],
        **{name: ",".join(map(str, scene[name]["position"])) for name in ("listener", "emitter")},
    }
    return {each["name"]: known[each["name"]] for each in operation.get("parameters", ()) if each["required"]}


@pytest.mark.parametrize(
    ("scene", "chosen"),
    [
        # Maps of scenes with a field are of a thousand places, which take seconds.
        *(
            pytest.param(scene, {"loudness": {"spacing_m": "1"}} if scene in WITH_FIELDS else {}, id=scene)
            for scene in SCENES
        ),
        *(pytest.param(scene, {}, id=f"{scene}, all of its map", marks=pytest.mark.long) for scene in WITH_FIELDS),
    ],
)
def test_every_route_of_the_scene_answers_at_its_defaults(client, scene, chosen):
    described = client.get(f"/v1/scenes/{scene}").json()
    paths = client.get("/openapi.json").json()["paths"]
    # Files of bundles have tests of their own.
    routes = [path for path in paths if "{scene}" in path and "{file}" not in path and "get" in paths[path]]
    assert {path.rsplit("/", 1)[-1] for path in routes} >= {
        "{scene}",
        "frontier",
        "plan",
        "loudness",
        "impulse-response",
    }
    failed = {}
    for path in routes:
        values = needed(paths[path]["get"], described) | chosen.get(path.rsplit("/", 1)[-1], {})
        answer = client.get(path.format(scene=values.pop("scene")), params=values)
        if answer.status_code != 200:
            failed[path] = answer.text
    assert failed == {}


@pytest.mark.parametrize("scene", SCENES)
def test_every_scene_has_the_levels_it_says_on_its_frontier(client, scene):
    frontier = client.get(f"/v1/scenes/{scene}/frontier").json()
    described = client.get(f"/v1/scenes/{scene}").json()
    offered = {level["name"] for level in frontier["levels"] if level["is_offered"]}
    assert offered == {level["name"] for level in described["levels"]}
    assert frontier["default"] in offered


def test_a_scene_without_a_field_has_a_frontier_without_an_architecture(client):
    (level,) = client.get("/v1/scenes/open-field/frontier").json()["levels"]
    assert (level["name"], level["architecture"], level["rank"]) == ("geometry", None, None)
    assert level["ms_here"] > 0


def test_in_the_open_a_map_falls_with_distance_as_a_sphere_grows_and_air_absorbs(client):
    """Beyond spreading, a metre of air takes something, and less than the 0.6 dB that it takes at 24 kHz."""
    drawn = client.get("/v1/scenes/open-field/loudness", params={"emitter": "0,0,1.5", "format": "json"}).json()
    rows, (west, south), spacing_m = drawn["levels_db"], drawn["origin"], drawn["spacing_m"]
    assert MAX_POINTS / 2 < sum(len(row) for row in rows) <= MAX_POINTS
    row = len(rows) // 2
    eastwards = range(len(rows[row]) // 2, len(rows[row]))
    distances_m = [math.hypot(west + column * spacing_m, south + row * spacing_m) for column in eastwards]
    after_spreading = [rows[row][column] + 20 * math.log10(m) for column, m in zip(eastwards, distances_m, strict=True)]
    for (nearer, further), (before, after) in zip(pairwise(distances_m), pairwise(after_spreading), strict=True):
        assert 0 < before - after < 0.6 * (further - nearer)


@pytest.mark.parametrize(
    ("width_m", "depth_m", "spacing_m"), [(8, 5, 0.25), (1.6, 3, 0.2), (0.4, 0.5, 0.1), (100, 100, 2.24)]
)
def test_a_map_is_as_fine_as_the_size_of_its_scene_asks(width_m, depth_m, spacing_m):
    bundle = load_scenes(())["open-field"].bundle
    bounds = bundle.manifest.bounds.model_copy(update={"minimum": (0, 0, 0), "maximum": (width_m, depth_m, 3)})
    resized = replace(bundle, manifest=bundle.manifest.model_copy(update={"bounds": bounds}))
    assert usual_spacing_m(resized) == pytest.approx(spacing_m)
