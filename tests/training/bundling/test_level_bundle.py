"""Levels become bundles that a server takes."""

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from server.api.catalogue import describe_scene
from server.field.fields_by_level import FieldsByLevel
from server.responses.full_response import FullResponse
from server.scene.bundle import MOST_TRIANGLES, Bundle
from training.bundling.level_bundle import bundle_of_level
from training.cli.main import app
from training.data.levels.gltf_writer import Piece, WrittenNode, write_glb
from training.data.levels.level_import import Choices, import_level
from training.data.scene_file import SceneFileError

QUADS = ((0, 2, 6, 4), (1, 5, 7, 3), (0, 4, 5, 1), (2, 3, 7, 6), (0, 1, 3, 2), (4, 6, 7, 5))
CUBE = np.array([(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)], dtype=float)
INWARDS = np.array([(q[0], q[a], q[a + 1]) for q in QUADS for a in (1, 2)])


def gltf(corners):
    """glTF's x, y up and -z are x, z and y here."""
    return corners[:, (0, 2, 1)] * (1, 1, -1)


@pytest.fixture(scope="module")
def level(tmp_path_factory):
    """A room of 6 x 5 x 3 m with a block in it."""
    block = CUBE * (0.5, 3.0, 2.0) + (3.0, 0.5, 0.0)
    pieces = (Piece(gltf(CUBE * (6, 5, 3)), INWARDS, "brick"), Piece(gltf(block), INWARDS[:, ::-1], "wood"))
    path = tmp_path_factory.mktemp("level") / "hall.glb"
    nodes = [
        WrittenNode("hall", pieces, {}, {}),
        WrittenNode("listener_start", (), {"translation": [1.0, 1.5, -2.0]}, {}),
        WrittenNode("emitter_radio", (), {"translation": [5.0, 1.2, -2.0]}, {}),
    ]
    write_glb(path, nodes, "a test")
    imported = import_level(path, Choices())
    assert imported.scene is not None
    return imported.scene


def test_a_level_is_heard_from_a_bundle(level, tmp_path):
    bundle = bundle_of_level(level, tmp_path / "bundle")
    assert bundle.manifest.format_version == 4
    assert set(bundle.mesh.materials) == {"brick", "wood"}
    levels = FieldsByLevel.load(Bundle.load(tmp_path / "bundle"))
    assert describe_scene(levels).id == "hall"
    heard = FullResponse.through_kemar(levels.default)
    start = bundle.manifest.start
    (response,) = heard.impulse_responses([start.listener], [start.emitter], [0.0])
    rate = levels.default.sample_rate
    first_s = np.argmax(np.abs(response).max(axis=0) > 0.02 * np.abs(response).max()) / rate
    # Round the block, which ends at y = 3.5 and is 2 m high: the way over it is shorter.
    over_m = np.hypot(2.0, 0.5) + 0.5 + np.hypot(1.5, 0.8)
    assert first_s == pytest.approx(over_m / 343, abs=1e-3)


def test_the_command_line_says_what_it_wrote(level, tmp_path):
    level.write(tmp_path / "scene")
    result = CliRunner().invoke(app, ["bundle-level", str(tmp_path / "scene"), "-o", str(tmp_path / "b"), "--json"])
    assert result.exit_code == 0, result.output
    written = json.loads(result.output)
    assert written["scene"] == "hall"
    assert Bundle.load(tmp_path / "b").digest == written["digest"]


def test_a_start_inside_a_thing_is_named(level, tmp_path):
    start = level.file.start.model_copy(update={"emitter": (3.2, 1.0, 1.0)})
    moved = type(level)(level.file.model_copy(update={"start": start}), level.mesh, level.doors)
    with pytest.raises(SceneFileError, match=r"start\.emitter: \(3\.2, 1\.0, 1\.0\) is not in the air"):
        bundle_of_level(moved, tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()


def test_more_triangles_than_a_bundle_has_are_refused_before_anything_is_written(level, tmp_path):
    mesh = level.mesh
    times = MOST_TRIANGLES // len(mesh.triangles) + 1
    many = replace(mesh, triangles=np.tile(mesh.triangles, (times, 1)), surfaces=np.tile(mesh.surfaces, times))
    with pytest.raises(SceneFileError, match=r"geometry\.mesh: 200,\d+ triangles .* 200,000: .*--merge-within-m"):
        bundle_of_level(replace(level, mesh=many), tmp_path / "bundle")
    assert not (tmp_path / "bundle").exists()
