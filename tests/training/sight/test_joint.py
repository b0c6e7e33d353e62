"""Sight and sound together: one grid, both losses; a training goes on as if it had not been interrupted."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from server.core.errors import NafirError
from training.cli.main import app
from training.data.dataset import Dataset
from training.data.scene_file import SceneFile
from training.learning.runs import RunError
from training.sight.cameras import Views
from training.sight.comparison import compare, table
from training.sight.joint import Recipe, Training, open_pair
from training.sight.views import draw_views

RECIPE = Recipe(
    steps=100,
    rays=32,
    coarse=6,
    fine=6,
    width=16,
    layers=3,
    learning_rate=5e-3,
    grid_spacing_m=1.0,
    grid_features=4,
    naf_width=16,
    responses=2,
    points=16,
    share=0.5,
)


def untracked(steps, _):
    return steps


@pytest.fixture(scope="module")
def images(tiny_scene, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("views")
    draw_views(SceneFile.read(tiny_scene), folder, views=4, test=2, size=(20, 14), seed=0, track=untracked)
    return folder


@pytest.fixture(scope="module")
def views(images) -> Views:
    return Views.read(images)


def training(run: Path, dataset: Dataset, views: Views, method: str, recipe: Recipe = RECIPE) -> Training:
    return Training(run, dataset, views, method, 3, 0, recipe)


@pytest.fixture(scope="module")
def uninterrupted(dataset, views, tmp_path_factory) -> tuple[Training, Path]:
    """A joint training that went to its end, and its folder."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    joint = training(folder, dataset, views, "nerf-naf")
    joint.go_on(untracked)
    return joint, folder


def test_both_losses_move_the_grid_that_both_share(dataset, views, tmp_path: Path) -> None:
    joint = training(tmp_path, dataset, views, "nerf-naf")
    assert joint.learner is not None
    assert joint.grid is joint.learner.field.grids[0]
    joint.learner.initialise(joint._rows, 0)
    losses = joint.losses(0)
    assert set(losses) == {"colour", "coarse", "naf"}
    for name, loss in losses.items():
        joint._optimiser.zero_grad(set_to_none=True)
        loss.backward(retain_graph=True)
        gradient = joint.grid.features.grad
        assert gradient is not None, name
        assert gradient.abs().max() > 0, name


def test_a_nerf_alone_has_no_grid_and_hears_nothing(dataset, views, tmp_path: Path) -> None:
    alone = training(tmp_path, dataset, views, "nerf")
    assert (alone.grid, alone.learner, alone.validation_loss()) == (None, None, None)
    assert set(alone.losses(0)) == {"colour", "coarse"}


def test_the_penalty_is_a_hundred_thousandth_of_the_sum_of_squares(dataset, views, tmp_path: Path) -> None:
    without, penalised = (training(tmp_path / name, dataset, views, name) for name in ("nerf-grid", "nerf-grid-l2"))
    losses = penalised.losses(3)
    assert "l2" not in without.losses(3)
    torch.testing.assert_close(losses["colour"], without.losses(3)["colour"])
    squares = np.sum(penalised.grid.features.detach().numpy() ** 2)
    assert float(losses["l2"].detach()) == pytest.approx(1e-5 * squares, rel=1e-5)


def test_training_brings_the_loss_down_and_the_picture_near(uninterrupted, views) -> None:
    joint, folder = uninterrupted
    lines = [line.split(",") for line in (folder / "log.csv").read_text().splitlines()]
    assert lines[0] == ["step", "cpu_s", "colour", "coarse", "naf"]
    first, last = ([float(cell) for cell in line] for line in (lines[1], lines[-1]))
    assert (first[0], last[0]) == (50, 100)
    assert last[2] < first[2]
    drawn = joint.test_pictures()
    assert drawn.shape == views.test_pictures.shape
    errors = np.mean((drawn.astype(float) - views.test_pictures) ** 2)
    assert errors < np.mean((128.0 - views.test_pictures) ** 2)


def test_an_interrupted_training_ends_as_one_without_interruption(
    uninterrupted, dataset, views, tmp_path: Path, monkeypatch
) -> None:
    monkeypatch.setattr("training.sight.joint._CHECKPOINT_S", -1.0)

    def broken(steps, _):
        for number in steps:
            if number == 70:
                raise InterruptedError
            yield number

    joint, whole = uninterrupted
    parted = tmp_path / "parted"
    with pytest.raises(InterruptedError):
        training(parted, dataset, views, "nerf-naf").go_on(broken)
    resumed = training(parted, dataset, views, "nerf-naf")
    resumed.go_on(untracked)
    logs = [[line.split(",")[2:] for line in (run / "log.csv").read_text().splitlines()] for run in (whole, parted)]
    assert logs[0] == logs[1]
    assert len(logs[0]) == 3
    for one, other in zip(joint._parts.parameters(), resumed._parts.parameters(), strict=True):
        assert torch.equal(one, other)


def test_a_loss_that_is_no_number_stops_training(dataset, views, tmp_path: Path) -> None:
    broken = training(tmp_path, dataset, views, "nerf")
    with torch.no_grad():
        broken.nerf.fine.colour.bias.fill_(float("nan"))
    with pytest.raises(NafirError, match=r"the loss is nan in step 1; lower --learning-rate"):
        broken.go_on(untracked)


def test_a_folder_of_another_training_is_refused(dataset, views, tmp_path: Path) -> None:
    training(tmp_path, dataset, views, "nerf")
    with pytest.raises(RunError, match=r"run\.json: is of another configuration; choose an empty folder"):
        training(tmp_path, dataset, views, "nerf-grid")
    with pytest.raises(RunError, match=r"views: 4 to train on, 5 wanted"):
        Training(tmp_path / "other", dataset, views, "nerf", 5, 0, RECIPE)


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("scene", "elsewhere", "scene: is 'elsewhere', and .* has 'tiny'"),
        ("corners", [[0, 0], [9, 0], [9, 9], [0, 9]], "corners: differ from those of"),
        ("height_m", 9.0, "height_m: is 9.0, and .* has"),
    ],
)
def test_data_of_another_scene_than_the_pictures_is_refused(dataset, images, tmp_path, field, value, told) -> None:
    for file in images.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    stored = json.loads((tmp_path / "cameras.json").read_text())
    (tmp_path / "cameras.json").write_text(json.dumps(stored | {field: value}))
    with pytest.raises(RunError, match=rf"cameras\.json: {told}.*draw views of the same scene file"):
        open_pair(dataset.folder, tmp_path)


def test_a_comparison_has_a_row_for_each_training_and_is_not_trained_twice(dataset, images, tmp_path: Path) -> None:
    recipe = Recipe(**{**vars(RECIPE), "steps": 3})

    def run(track):
        return compare(dataset.folder, images, tmp_path, ["nerf-naf", "nerf"], [2, 4], range(2), recipe, track)

    result = run(untracked)
    assert [(row["views"], row["seed"], row["method"]) for row in result["rows"]] == [
        (views, seed, method) for views in (2, 4) for seed in (0, 1) for method in ("nerf", "nerf-naf")
    ]
    means = {(row["views"], row["method"]): row for row in result["means"]}
    rows = {(row["views"], row["seed"], row["method"]): row["psnr_db"] for row in result["rows"]}
    gains = [rows[4, seed, "nerf-naf"] - rows[4, seed, "nerf"] for seed in (0, 1)]
    assert means[4, "nerf-naf"]["gain_db"] == pytest.approx(np.mean(gains))
    assert means[4, "nerf-naf"]["gain_spread_db"] == pytest.approx(np.std(gains, ddof=1))
    assert means[4, "nerf"]["gain_db"] is None
    assert len(table(result)) == 5
    assert json.loads((tmp_path / "results.json").read_text()) == result

    def never(_, doing):
        raise AssertionError(doing)

    assert run(never)["rows"] == result["rows"]


def test_the_commands_draw_and_compare(tiny_scene, dataset, tmp_path: Path) -> None:
    views, out = tmp_path / "views", tmp_path / "run"
    sizes = ["--views", "2", "--test", "1", "--size", "16x12"]
    drawn = CliRunner().invoke(app, ["draw-views", str(tiny_scene), "-o", str(views), *sizes])
    assert drawn.exit_code == 0, drawn.output
    options = ["--small", "--steps", "2", "--rays", "8", "--views", "2", "--seeds", "1", "--responses", "1"]
    done = CliRunner().invoke(app, ["cross-modal", str(dataset.folder), str(views), "-o", str(out), *options])
    assert done.exit_code == 0, done.output
    assert "nerf-naf" in done.output
    assert (out / "views.png").is_file()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--methods", "nerf,gan"], "--methods: there is no 'gan'"),
        (["--methods", ","], "--methods: names none"),
        (["--views", "5"], "--views: 5, and .* has 4 views to train on; draw more"),
        (["--views", "two"], "--views: 'two'"),
    ],
)
def test_options_that_do_not_fit_are_refused(dataset, images, tmp_path: Path, options, told) -> None:
    asked = ["cross-modal", str(dataset.folder), str(images), "-o", str(tmp_path / "run"), *options]
    result = CliRunner().invoke(app, asked)
    assert isinstance(result.exception, NafirError)
    with pytest.raises(NafirError, match=told):
        raise result.exception


@pytest.mark.parametrize(("size", "told"), [("20", "WIDTHxHEIGHT"), ("4x400", "from 8 to 4096")])
def test_a_size_that_is_none_is_refused(tiny_scene, tmp_path: Path, size: str, told: str) -> None:
    result = CliRunner().invoke(app, ["draw-views", str(tiny_scene), "-o", str(tmp_path / "v"), "--size", size])
    with pytest.raises(NafirError, match=told):
        raise result.exception
