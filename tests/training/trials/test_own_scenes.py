import json
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import pytest

from server.scene.bundle import Bundle
from training.data.scene_file import SceneFile
from training.trials import own_scenes
from training.trials.field_decay import FieldDecay
from training.trials.own_scenes import OWN, Report, main, make, table
from training.trials.reverberation import Comparison

GOOD = Comparison(
    ours_s=(0.5,) * 7,
    from_others=(0.01,) * 7,
    from_mirrors=(0.01,) * 7,
    from_rough=(0.01,) * 7,
    from_eyring=(0.02,) * 7,
    judges_others=True,
    is_diffuse=True,
)
FIELD = FieldDecay((0.49,) * 7, (0.5,) * 7, window_s=0.01)


@pytest.fixture
def steps(monkeypatch):
    """Commands that were run, none of which does anything; `failing` is the one that fails."""
    asked = SimpleNamespace(commands=[], failing=None)

    def run(command, **_):
        asked.commands.append(command[3])
        return SimpleNamespace(returncode=int(command[3] == asked.failing))

    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(own_scenes, "compare", lambda _: GOOD)
    monkeypatch.setattr(own_scenes, "field_decay", lambda *_: FIELD)
    return asked


def test_the_scenes_are_at_least_eleven_and_each_can_be_read():
    scenes = [SceneFile.read(path) for path in sorted(OWN.glob("*.toml"))]
    assert len(scenes) >= 11
    assert {scene.id for scene in scenes} == {path.stem for path in OWN.glob("*.toml")}


def test_a_scene_goes_through_all_steps_once_and_is_kept(steps, tmp_path, tiny_scene):
    report = make(tiny_scene, tmp_path)
    assert report.passed
    assert steps.commands == ["simulate", "train", "export", "check"]
    assert make(tiny_scene, tmp_path) == report
    assert len(steps.commands) == 4


def test_a_scene_file_that_changed_is_made_anew(steps, tmp_path, tiny_scene):
    scene = tmp_path / "tiny.toml"
    scene.write_bytes(tiny_scene.read_bytes())
    make(scene, tmp_path / "made")
    scene.write_text(scene.read_text() + "\n# changed\n")
    make(scene, tmp_path / "made")
    assert len(steps.commands) == 8


def test_a_step_that_fails_ends_its_scene_is_told_and_tried_again(steps, tmp_path, tiny_scene):
    steps.failing = "train"
    report = make(tiny_scene, tmp_path)
    assert not report.passed
    assert "train failed with exit code 1" in table([report])
    assert steps.commands == ["simulate", "train"]
    steps.failing = None
    assert make(tiny_scene, tmp_path).passed


@pytest.mark.usefixtures("steps")
def test_the_table_is_written_and_a_scene_beyond_a_limit_fails(tmp_path, tiny_scene, capsys, monkeypatch):
    assert main([str(tmp_path / "own"), str(tiny_scene)]) == 0
    written = (tmp_path / "own.md").read_text()
    assert written in capsys.readouterr().out
    assert "| tiny |" in written
    off = replace(GOOD, from_others=(0.2,) * 7)
    monkeypatch.setattr(own_scenes, "compare", lambda _: off)
    assert main([str(tmp_path / "other"), str(tiny_scene)]) == 1
    assert "pyroomacoustics: 20.0 %" in (tmp_path / "other.md").read_text()
    assert json.loads((tmp_path / "other" / "tiny" / "report.json").read_text())["problem"] is None


def test_what_is_not_judged_is_in_brackets():
    told = replace(GOOD, from_others=(0.2,) * 7, from_eyring=(0.4,) * 7, judges_others=False, is_diffuse=False)
    line = table([Report("some", {"train": 1.0}, None, told, FIELD)]).splitlines()[-1]
    assert "(20.0 %) | 1.0 % | 1.0 % | (40.0 %) | 2.0 % | ok" in line


def test_a_field_is_judged_in_bands_that_its_windows_tell_apart():
    data_s = (0.5, 0.05, *(0.5,) * 5)
    short = FieldDecay((0.51, 0.06, *(0.5,) * 5), data_s, window_s=0.01)
    report = Report("some", {}, None, GOOD, short)
    assert report.passed
    assert "| 2.0 % (20.0 %) | ok |" in table([report])
    off = FieldDecay((0.6, 0.05, *(0.5,) * 5), data_s, window_s=0.01)
    assert Report("some", {}, None, GOOD, off).faults() == ["the field beside its data: 20.0 %"]


def test_a_bundle_of_the_real_steps_is_checked(tiny_bundle):
    """The last of the commands, on a bundle that is there."""
    done = subprocess.run(
        [own_scenes.sys.executable, "-c", own_scenes._CHECK, "check", str(tiny_bundle.folder)],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert Bundle.load(tiny_bundle.folder).id in done.stdout
