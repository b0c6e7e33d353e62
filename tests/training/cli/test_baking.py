"""A level becomes a bundle in one command, which goes on where it stopped, and tells what has changed."""

import shutil

import pytest

from server.scene.bundle import Bundle
from tests.once_a_run import once
from tests.training.data.levels.conftest import box, empty
from training.bundling import export as exporting
from training.cli.main import main
from training.data.dataset import Dataset
from training.data.levels import level_import
from training.data.levels.gltf_writer import Piece, WrittenNode, write_glb
from training.learning import train as training

BRIEF = {"--rays": "100", "--probes": "6", "--sample-rate": "8000", "--workers": "1", "--epochs": "1"}


def write_level(path, *, material="curtain", length_m=3.0):
    """A small room with a door in its corner, so that the field has to know doors."""
    leaf = Piece(*box((0.0, 0.0, 0.3), (0.3, 2.0, 0.34), inward=False), "wooden door")
    nodes = [
        WrittenNode("room", (Piece(*box(high=(length_m, 2.6, 2.4)), material),)),
        WrittenNode("door_corner", (leaf,), {}, {"nafir_mass_kg_m2": 10.0}),
        empty("listener_start", (2.2, 1.6, 1.8)),
        empty("emitter_radio", (1.4, 1.2, 1.2)),
    ]
    write_glb(path, nodes)


def bake(folder, capfd, options=None, *, anew=False):
    """The command's exit code, standard output and standard error."""
    given = [text for option in {**BRIEF, **(options or {})}.items() for text in option]
    with pytest.MonkeyPatch.context() as patch:
        command = ["nafir-train", "bake", folder / "level.glb", "-o", folder / "baked", *given]
        patch.setattr("sys.argv", [*map(str, command), *(["--anew"] if anew else [])])
        with pytest.raises(SystemExit) as left:
            main()
    return left.value.code, *capfd.readouterr()


def interrupted(function, after=0):
    """The function, which is interrupted instead when it was called so many times."""
    calls = []

    def call(*arguments, **options):
        if len(calls) == after:
            raise KeyboardInterrupt
        calls.append(arguments)
        return function(*arguments, **options)

    return call


@pytest.fixture
def baked(tmp_path_factory, tmp_path, capfd):
    """A copy of a folder with `level.glb` and what was baked of it."""

    def build(folder):
        write_level(folder / "level.glb")
        assert bake(folder, capfd)[0] == 0

    return shutil.copytree(once("baked", build, tmp_path_factory), tmp_path / "copy")


def files_of(folder):
    return {path.relative_to(folder): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()}


def test_it_goes_on_where_it_was_interrupted_and_ends_with_a_bundle(tmp_path, capfd, monkeypatch):
    write_level(tmp_path / "level.glb")
    imports, emitters = [], []
    import_level, write = level_import.import_level, Dataset.write
    monkeypatch.setattr(level_import, "import_level", lambda *given: imports.append(given) or import_level(*given))
    monkeypatch.setattr(
        Dataset, "write", lambda self, number, takes: emitters.append(number) or write(self, number, takes)
    )
    for module, name, after, begun in (
        (Dataset, "write", 2, "step 2 of 4: simulate"),
        (training, "train", 0, "step 3 of 4: train"),
        (exporting, "export", 0, "step 4 of 4: export"),
    ):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(module, name, interrupted(getattr(module, name), after))
            code, _, err = bake(tmp_path, capfd)
        assert code != 0
        assert begun in err
    code, out, _ = bake(tmp_path, capfd)
    assert code == 0
    assert f"serve it: nafir serve --bundle {tmp_path / 'baked' / 'bundle'}" in out
    assert len(imports) == 1
    assert sorted(emitters) == list(range(len(emitters)))
    bundle = Bundle.load(tmp_path / "baked" / "bundle")
    (field,) = bundle.manifest.fields.values()
    assert field.doors == ("corner",)
    assert bundle.manifest.codec.sample_rate == 8000


def test_what_is_finished_is_not_made_again(baked, capfd):
    before = files_of(baked)
    code, out, err = bake(baked, capfd)
    assert code == 0
    assert out.count("is finished already") == 4
    assert "step" not in err
    assert files_of(baked) == before


@pytest.mark.parametrize(
    ("change", "stage", "told"),
    [
        (lambda folder: write_level(folder / "level.glb", length_m=3.4), "scene", "the level"),
        (lambda _: {"--rays": "120"}, "scene", "--rays"),
        (lambda _: {"--merge-within-m": "0"}, "scene", "--merge-within-m"),
        (lambda _: {"--seed": "4"}, "scene", "--seed"),
        (lambda folder: edit(folder, "rays = 100", "rays = 110"), "data", "scene.toml or its meshes"),
        (lambda _: {"--epochs": "2"}, "run", "--epochs"),
    ],
)
def test_a_change_is_told_and_nothing_is_touched(baked, capfd, change, stage, told):
    options = change(baked)
    before = files_of(baked)
    code, _, err = bake(baked, capfd, options)
    assert code == 2
    last = err.strip().splitlines()[-1]
    assert last.startswith(f"nafir-train: {baked / 'baked' / stage}: since it was begun, this has changed: ")
    assert told in last
    assert "--anew" in last
    assert files_of(baked) == before


def edit(folder, old, new):
    path = folder / "baked" / "scene" / "scene.toml"
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")


def test_what_follows_from_a_change_is_made_anew_if_asked_for(baked, capfd):
    simulated = baked / "baked" / "data" / "pairs.h5"
    before = simulated.stat().st_mtime_ns
    digest = Bundle.load(baked / "baked" / "bundle").digest
    code, out, err = bake(baked, capfd, {"--epochs": "2"}, anew=True)
    assert code == 0
    assert "is made anew, because this has changed: --epochs" in out
    assert "simulate" not in err
    assert simulated.stat().st_mtime_ns == before
    assert Bundle.load(baked / "baked" / "bundle").digest != digest


def test_another_level_is_imported_and_simulated_anew_but_never_over_a_scene_changed_by_hand(baked, capfd):
    write_level(baked / "level.glb", length_m=2.8)
    edit(baked, 'name = "level"', 'name = "My room"')
    code, _, err = bake(baked, capfd, anew=True)
    assert code == 2
    assert "scene.toml: was changed by hand" in err
    edit(baked, 'name = "My room"', 'name = "level"')
    code, out, _ = bake(baked, capfd, anew=True)
    assert code == 0
    assert "because this has changed: the level" in out
    assert Bundle.load(baked / "baked" / "bundle").mesh.bounds_m[1, 0] == pytest.approx(2.8)


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path, capfd):
    write_level(tmp_path / "level.glb")
    (tmp_path / "baked").mkdir()
    (tmp_path / "baked" / "notes.txt").touch()
    code, _, err = bake(tmp_path, capfd)
    assert code == 2
    assert "holds something else" in err
    assert len(list((tmp_path / "baked").iterdir())) == 1


def test_a_level_that_is_not_there_makes_no_folder(tmp_path, capfd):
    code, _, err = bake(tmp_path, capfd)
    assert code == 2
    assert "level.glb: file: there is no such file" in err
    assert not list(tmp_path.iterdir())


def test_a_level_that_is_refused_says_so_and_can_be_baked_when_mended(tmp_path, capfd):
    write_level(tmp_path / "level.glb", material="M_042")
    code, _, err = bake(tmp_path, capfd)
    assert code == 2
    assert "nobody knows 'M_042'" in err
    code, _, err = bake(tmp_path, capfd, {"--default-material": "brik"})
    assert code == 2
    assert "near: brick" in err
