import json

import pytest

from tests.training.data.levels.conftest import box, room
from training.cli.main import main
from training.data.levels.gltf_writer import Piece, WrittenNode, write_glb
from training.data.levels.level_scene import LevelScene


@pytest.fixture
def nafir_train(monkeypatch, capfd):
    """Runs the command; gives its exit code, standard output and standard error."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["nafir-train", "import-level", *map(str, arguments)])
        try:
            main()
        except SystemExit as left:
            return left.code, *capfd.readouterr()
        return 0, *capfd.readouterr()

    return run


def test_a_level_is_imported_reported_and_drawn(nafir_train, tmp_path):
    write_glb(tmp_path / "level.glb", [room()])
    code, out, _ = nafir_train(tmp_path / "level.glb", "-o", tmp_path / "scene")
    assert code == 0
    assert "watertight" in out
    assert "table: plaster" in out
    assert "12 triangles, 1 materials, 0 doors" in out
    assert (tmp_path / "scene" / "report.png").stat().st_size > 10_000
    names = sorted(path.name for path in (tmp_path / "scene").iterdir())
    assert names == ["geometry.npz", "report.json", "report.png", "scene.toml"]


@pytest.mark.parametrize("rate", [24_000, 44_100, 48_000])
def test_the_scene_is_simulated_at_the_rate_and_with_the_rays_that_are_asked_for(nafir_train, tmp_path, rate):
    write_glb(tmp_path / "level.glb", [room()])
    code, _, _ = nafir_train(tmp_path / "level.glb", "-o", tmp_path, "--sample-rate", rate, "--rays", "5000")
    assert code == 0
    simulation = LevelScene.read(tmp_path).simulation
    assert (simulation.sample_rate, simulation.rays) == (rate, 5000)


@pytest.mark.parametrize(("side_m", "wanted"), [(30.0, 60), (30.0, 240), (90.0, 120)])
def test_about_as_many_probes_stand_in_a_level_of_any_size_as_are_asked_for(nafir_train, tmp_path, side_m, wanted):
    write_glb(tmp_path / "level.glb", [WrittenNode("room", (Piece(*box(high=(side_m, 3.0, side_m)), "plaster"),))])
    code, _, _ = nafir_train(tmp_path / "level.glb", "-o", tmp_path, "--probes", str(wanted))
    assert code == 0
    assert 0.75 * wanted < len(LevelScene.read(tmp_path).probe_positions(0)) < 1.4 * wanted


def test_in_a_small_room_probes_stand_no_nearer_than_is_of_use(nafir_train, tmp_path):
    write_glb(tmp_path / "level.glb", [room()])
    code, _, _ = nafir_train(tmp_path / "level.glb", "-o", tmp_path, "--probes", "2000")
    assert code == 0
    assert LevelScene.read(tmp_path).file.probes.spacing_m == 0.5


def test_a_refused_level_is_one_line_and_the_json_says_why(nafir_train, tmp_path):
    write_glb(tmp_path / "level.glb", [room("M_042", without=(4, 10))])
    code, out, err = nafir_train(tmp_path / "level.glb", "-o", tmp_path / "scene", "--json")
    assert code == 2
    assert len(json.loads(out)["problems"]) == 2
    assert "nobody knows 'M_042'" in err
    assert "report.png" in err
    assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["missing.glb"], "there is no such file"),
        (["level.fbx"], "levels are read from .glb, .gltf, .obj"),
        (["level.glb", "--merge-within-m", "1"], "--merge-within-m"),
        (["level.glb", "--sample-rate", "4000"], "--sample-rate"),
        (["level.glb", "--rays", "10"], "--rays"),
        (["level.glb", "--probes", "2"], "--probes"),
        (["level.glb", "--default-material", "brik"], "near: brick"),
        (["level.glb", "--materials", "missing.toml"], "cannot be read"),
        (["level.glb", "--scene", "9"], "--scene: '9' is no scene"),
    ],
)
def test_options_at_fault_are_told(nafir_train, tmp_path, monkeypatch, arguments, complaint):
    monkeypatch.chdir(tmp_path)
    write_glb(tmp_path / "level.glb", [room()])
    code, _, err = nafir_train(*arguments, "-o", "scene")
    assert code == 2
    assert complaint in err
