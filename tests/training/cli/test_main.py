import json
import shutil

import pytest

from training.cli.main import main


@pytest.fixture
def nafir_train(monkeypatch, capfd):
    """Runs the command; gives its exit code, standard output and standard error."""

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["nafir-train", *map(str, arguments)])
        with pytest.raises(SystemExit) as left:
            main()
        return left.value.code, *capfd.readouterr()

    return run


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("simulate", "absent.toml", "-o", "{tmp}/data"), "absent.toml: cannot be read"),
        (("simulate", "{scene}", "-o", "{data}", "--seed", "9"), "another scene or seed"),
        (("train", "{tmp}", "-o", "{tmp}/run"), "{tmp}"),
        (("train", "{data}", "-o", "{run}"), "another configuration"),
        (("export", "{tmp}", "-o", "{tmp}/bundle"), "not a run folder"),
        (("export", "{run}", "--data", "{tmp}", "-o", "{tmp}/bundle"), "{tmp}"),
        (("export", "{tmp}", "-o", "{scene}"), "--output"),
        (("evaluate", "{tmp}", "{data}", "-o", "{tmp}/absent/x.json"), "--output: there is no folder"),
        (("evaluate", "{tmp}", "{data}", "--figure", "{tmp}/absent/x.png"), "--figure: there is no folder"),
        (("maps", "{tmp}", "{data}", "-o", "{tmp}/absent/x.png"), "--output: there is no folder"),
        (("probe", "{tmp}", "{data}", "--figure", "{tmp}/absent/x.png"), "--figure: there is no folder"),
        (("import", "sofa", "{scene}", "-o", "{scene}"), "--output"),
        (("evaluate", "{tmp}", "{data}"), "scene.json"),
        (("evaluate", "{bundle}", "{tmp}"), "{tmp}"),
    ],
)
def test_what_cannot_be_done_is_told_in_a_line(
    nafir_train, dataset, run, tiny_bundle, tiny_scene, tmp_path, arguments, told
):
    places = {
        "tmp": tmp_path,
        "scene": tiny_scene,
        "data": dataset.folder,
        "run": run,
        "bundle": tiny_bundle.folder,
    }
    code, _, err = nafir_train(*(argument.format(**places) for argument in arguments))
    assert code == 2
    last = err.strip().splitlines()[-1]
    assert last.startswith("nafir-train: ")
    assert told.format(**places) in last
    assert "Traceback" not in err


@pytest.mark.parametrize(
    "arguments",
    [
        ("simulate", "{scene}", "-o", "{file}/x"),
        ("train", "{data}", "-o", "{file}/x"),
        ("export", "{run}", "-o", "{file}/x"),
        ("evaluate", "{bundle}", "{data}", "--figure", "{file}/x.png"),
    ],
)
def test_an_output_that_cannot_be_written_is_told_in_a_line(
    nafir_train, dataset, run, tiny_bundle, tiny_scene, tmp_path, arguments
):
    file = tmp_path / "file"
    file.touch()
    places = {
        "file": file,
        "scene": tiny_scene,
        "data": dataset.folder,
        "run": run,
        "bundle": tiny_bundle.folder,
    }
    code, _, err = nafir_train(*(argument.format(**places) for argument in arguments))
    assert code == 2
    last = err.strip().splitlines()[-1]
    assert last.startswith(tuple(f"nafir-train: {option}{file}" for option in ("", "--output: ", "--figure: ")))
    assert last.endswith(("Not a directory", "is a file, and a folder is needed", "is no folder"))
    assert "Traceback" not in err


@pytest.mark.parametrize("option", [("--workers", "-1"), ("--seed", "-1")])
def test_numbers_out_of_range_are_refused(nafir_train, tiny_scene, tmp_path, option):
    code, _, err = nafir_train("simulate", tiny_scene, "-o", tmp_path, *option)
    assert code == 2
    assert option[0] in err


def test_simulating_again_finds_nothing_left_to_do(nafir_train, dataset, tiny_scene):
    code, out, _ = nafir_train("simulate", tiny_scene, "-o", dataset.folder, "--seed", dataset.seed)
    assert code == 0
    assert "26 pairs to train on and 4 held out, 4 orientations each" in out


def test_evaluating_prints_json_and_records(nafir_train, dataset, tiny_bundle, tmp_path):
    bundle = tmp_path / "bundle"
    shutil.copytree(tiny_bundle.folder, bundle)
    code, out, _ = nafir_train("evaluate", bundle, dataset.folder, "--json", "--record")
    assert code == 0
    printed = json.loads(out)
    recorded = json.loads((bundle / "scene.json").read_text())["levels"][0]["accuracy"]
    assert printed["pairs"] == recorded["pairs"] == len(dataset.pairs(held_out=True))
    errors = {name: entry["mean"] for name, entry in printed["columns"]["standard"]["metrics"].items()}
    assert {name: error for name, error in errors.items() if error is not None} == recorded["errors"]


def test_evaluating_needs_one_bundle_to_record_into(nafir_train, dataset):
    code, _, err = nafir_train("evaluate", dataset.folder, "--record")
    assert code == 2
    assert "--record" in err


def test_a_bundle_records_errors_from_one_simulation(nafir_train, dataset, tiny_bundle):
    code, _, err = nafir_train("evaluate", tiny_bundle.folder, dataset.folder, "--record", "--draws", "3")
    assert code == 2
    assert "errors from one simulation" in " ".join(err.replace("│", " ").split())


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("train", "{data}", "-o", "{tmp}/run", "--field", "nerf"), "there is no 'nerf'"),
        (("train", "{data}", "-o", "{tmp}/run", "--field", "naf", "--rank", "64"), "leave it out for naf"),
        (("train", "{data}", "-o", "{tmp}/run", "--field", "naf", "--width", "64"), "leave it out for naf"),
        (
            ("train", "{data}", "-o", "{tmp}/run", "--teacher", "{run}", "--epochs", "1"),
            "only a naf that predicts spectrograms",
        ),
        (("export", "{run}", "{tmp}", "-o", "{tmp}/bundle"), "not a run folder"),
    ],
)
def test_fields_and_options_that_do_not_fit_are_told_in_a_line(nafir_train, dataset, run, tmp_path, arguments, told):
    places = {"tmp": tmp_path, "data": dataset.folder, "run": run}
    code, _, err = nafir_train(*(argument.format(**places) for argument in arguments))
    assert code == 2
    assert told in err.strip().splitlines()[-1]


def test_an_unknown_precision_is_refused(nafir_train, run, tmp_path):
    code, _, err = nafir_train("export", run, "-o", tmp_path / "bundle", "--precision", "float32,float8")
    assert code == 2
    assert "--precision" in err


def test_a_part_of_the_pairs_is_trained_for_a_part_of_a_minute(nafir_train, dataset, tmp_path):
    options = ("--share", "0.5", "--minutes", "0.01", "--rank", "16", "--width", "32", "--learning-rate", "0.001")
    code, out, _ = nafir_train("train", dataset.folder, "-o", tmp_path / "run", *options)
    assert code == 0
    assert "factorised is trained" in out
    written = json.loads((tmp_path / "run" / "run.json").read_text())
    assert (written["share"], written["minutes"]) == (0.5, 0.01)
    assert (written["shape"]["rank"], written["shape"]["width"]) == (16, 32)
    assert written["learning_rate"] == 0.001


def test_results_of_scenes_come_into_one_table(nafir_train, dataset, tiny_bundle, tmp_path):
    """With what every step took, where that was written down beside them."""
    results = tmp_path / "table.json"
    code, table, _ = nafir_train(
        "evaluate", tiny_bundle.folder, dataset.folder, "--methods", "nearest", "--output", results, "--markdown"
    )
    assert code == 0
    (tmp_path / "times.jsonl").write_text('{"step": "train", "wall_s": 90, "cpu_s": 60, "rc": 0}\n')
    code, out, _ = nafir_train("tabulate", results)
    assert code == 0
    (ours,) = (line for line in out.splitlines() if line.startswith(f"| {dataset.scene.id} | standard |"))
    (alone,) = (line for line in table.splitlines() if line.startswith("| standard |"))
    spectral_loss = [line.replace("*", "").split("|") for line in (ours, alone)]
    assert spectral_loss[0][3].strip() == spectral_loss[1][2].strip()
    assert "| all | 1.5 (1.0) | 1.5 (1.0) |" in out
    (record,) = json.loads(nafir_train("tabulate", results, "--json")[1])
    assert record["times"] == [{"step": "train", "wall_s": 90.0, "cpu_s": 60.0}]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("evaluate", "bundle", "data", "--json", "--markdown"), ("--json", "--markdown")),
        (("export", "run", "-o", "{tmp}/b", "--accept", "rise=a", "--accept", "rise=b"), ("--accept", "rise")),
        (
            ("simulate", "x.toml", "-o", "{tmp}/d", "--effects", "scattering=on,scattering=off"),
            ("--effects", "scattering"),
        ),
        (("export", "run", "-o", "{tmp}/b", "--ranks", "64,1_6"), ("--ranks", "1_6")),
        (("export", "run", "-o", "{tmp}/b", "--ranks", "\u0663"), ("--ranks", "\u0663")),
        (("export", "run", "-o", "{tmp}/b", "--ranks", "0"), ("--ranks", "0")),
        (("export", "{run}", "-o", "{tmp}/b", "--exact-tables"), ("exact-tables", "naf")),
    ],
)
def test_what_contradicts_itself_is_refused_in_one_line_that_names_it(nafir_train, run, tmp_path, arguments, named):
    given = [argument.format(tmp=tmp_path, run=run) for argument in arguments]
    code, _, err = nafir_train(*given)
    assert code == 2
    assert "\n" not in err.strip()
    for name in named:
        assert name in err
    assert list(tmp_path.iterdir()) == []


def test_the_length_of_a_run_is_said_once(nafir_train, dataset, run, tmp_path):
    code, _, err = nafir_train("train", dataset.folder, "-o", tmp_path / "r", "--minutes", "1", "--as-long-as", run)
    assert code == 2
    assert "leave one out" in err
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize("lengths", [("--epochs", "2", "--minutes", "1"), ("--epochs", "2", "--as-long-as", "other")])
def test_two_lengths_of_a_training_are_refused_by_name(nafir_train, tmp_path, lengths):
    code, _, err = nafir_train("train", tmp_path, "-o", tmp_path / "run", *lengths)
    assert code != 0
    assert lengths[0] in err
    assert lengths[2] in err
    assert "leave one out" in err
