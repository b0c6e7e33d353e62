"""Networks that are trained in pieces, each of which goes on where the one before stopped."""

import json

import pytest
from rich.progress import Progress

from training.learning import runs as runs_module
from training.learning.runs import NafRecipe
from training.models.naf import NafShape
from training.trials import networks_to_the_end
from training.trials.networks_to_the_end import RESULT, Job, is_finished, jobs, main, train_some


def test_one_scene_has_the_variants_and_all_the_network_itself():
    chosen = jobs(["small1", "large1"])
    assert len(set(chosen)) == len(chosen) == 9
    assert {job.field for job in chosen if job.scene == "small1"} == {
        "naf",
        "naf-expected",
        "naf-whole",
        "naf-dual",
        "naf-no-grid",
        "naf-time-domain",
    }
    assert [job.field for job in chosen if job.scene == "large1"] == ["naf", "naf-expected", "naf-whole"]
    assert chosen[0] == Job("small1", "naf")


@pytest.fixture
def tiny(tiny_scene, monkeypatch):
    """One scene of few probes, with networks of a few weights."""
    monkeypatch.setattr(networks_to_the_end, "SCENES", tiny_scene.parent)
    monkeypatch.setattr(networks_to_the_end, "VARIANTS", ("naf", "naf-dual"))
    monkeypatch.setattr(networks_to_the_end, "EVERYWHERE", ("naf",))
    shape = {"width": 8, "grid_features": 4, "grid_spacing_m": 1.0}
    small = {"naf": (NafShape(**shape), NafRecipe()), "naf-dual": (NafShape(grid="dual", **shape), NafRecipe())}
    monkeypatch.setattr(runs_module, "_NAFS", small)
    return ["--scenes", "tiny", "--points", "20"]


def test_a_call_goes_on_where_the_one_before_stopped_until_all_are_finished(tiny, tmp_path, capsys):
    arguments = [str(tmp_path), *tiny, "--epochs", "3"]
    first = ["--minutes", "0.0001"]
    assert main([*arguments, *first]) == 1
    assert not is_finished(tmp_path / "tiny" / "naf-dual")
    assert main([*arguments, "--minutes", "5"]) == 0
    assert is_finished(tmp_path / "tiny" / "naf")
    said = json.loads((tmp_path / RESULT).read_text())["tiny"]
    assert set(said) == {"naf", "naf-dual"}
    for record in said.values():
        assert record["epochs"] == 3
        assert [step for step, _ in record["curve"]] == [record["steps"] * number // 3 for number in (1, 2, 3)]
        assert record["curve"][-1][1] >= record["held_back_loss"]
    assert "tiny naf: " in capsys.readouterr().out


def test_networks_that_are_finished_get_none_of_the_time(tiny, tmp_path):
    main([str(tmp_path), *tiny, "--epochs", "1", "--minutes", "5"])
    trained = train_some(
        jobs(["tiny"]), tmp_path, seconds=60, epochs=1, patience=10, points=20, progress=Progress(disable=True)
    )
    assert list(trained) == []
