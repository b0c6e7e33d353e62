import json
from dataclasses import asdict, replace

import numpy as np
import pytest

from tests.training import written_layouts
from tests.training.measured_room import Room
from tests.training.written_layouts import CHANNELS, RATE, SAMPLES, WRITTEN, response, wav
from training.baselines.held_out import EvaluationError, open_held_out
from training.data.importers.conditioning import SourceError
from training.data.splits import UNKNOWN_SOURCE, SplitError
from training.evaluation.benchmark import score
from training.evaluation.benchmark_data import open_benchmark
from training.evaluation.benchmark_report import markdown
from training.evaluation.evaluate import METRICS, evaluate
from training.evaluation.fields import field_columns
from training.evaluation.literature import METRICS as DEFINED
from training.evaluation.methods import method_columns
from training.evaluation.paper_metrics import PAPER_METRICS
from training.evaluation.predicted import listed, of_bundle, of_method, write_predictions
from training.evaluation.predictions import PredictionError, Predictions
from training.evaluation.stored_errors import StoredErrors

OURS = [metric for metric in METRICS if metric not in PAPER_METRICS]
TESTED = {
    "soundspaces": ["0/0_1", "0/0_3", "0/0_4", "0/1_0"],
    "raf": ["000007", "000008", "000009"],
    "acousticrooms": [f"Cafe/Cafe_idx_1/S00{source}_R00{receiver}" for source in range(2) for receiver in range(3)],
}


def unchanged(_, samples):
    return samples


def identity(data, folder, *, change=unchanged):
    """The references themselves as predictions."""
    for case in data.cases:
        for name, truth in zip(case.names, case.truth(), strict=True):
            wav(folder / f"{name}.wav", change(name, truth), data.sample_rate)
    return folder


def scored(data, folder, **options):
    found = Predictions.find(folder, data.scored, data.known, data.normal, npy_rate=data.scored_rate)
    return score(data, found, threads=1, **options)


@pytest.mark.parametrize("layout", WRITTEN)
def test_every_layout_is_recognised_read_and_scored(tmp_path, layout):
    data = open_benchmark(WRITTEN[layout](tmp_path / "data"))
    assert (data.layout, data.channels, data.sample_rate) == (
        layout,
        CHANNELS[layout],
        48_000 if layout == "meshrir" else RATE,
    )
    if layout in TESTED:
        assert sorted(data.scored) == TESTED[layout]
    assert data.split.train.isdisjoint(data.split.test)
    for case in data.cases:
        np.testing.assert_array_equal(case.truth()[0], response(case.names[0], CHANNELS[layout]))
    result = scored(data, identity(data, tmp_path / "predictions"))
    assert result.comparable
    assert result.scored == len(data.scored)
    for metric in DEFINED:
        summary = result.summaries[metric.name]
        if metric.channels > CHANNELS[layout]:
            assert summary is None
        elif summary.mean is not None and metric.counted_as is None:
            assert summary.mean == pytest.approx(0.0, abs=1e-9), metric.name


@pytest.mark.parametrize("layout", WRITTEN)
@pytest.mark.parametrize("method", ["nearest", pytest.param("linear", marks=pytest.mark.long)])
def test_methods_of_ours_predict_from_the_training_part_of_every_layout(tmp_path, layout, method):
    folder = WRITTEN[layout](tmp_path / "data")
    if layout == "acousticrooms":
        with pytest.raises(EvaluationError, match="Cafe/Cafe_idx_1: the split leaves no response to learn from"):
            write_predictions(open_benchmark(folder), of_method(method), tmp_path / "predictions")
        return
    data = open_benchmark(folder)
    assert write_predictions(data, of_method(method), tmp_path / "predictions") == len(data.scored)
    result = scored(data, tmp_path / "predictions")
    assert result.comparable
    assert result.summaries["spectral_loss"].mean > 0.05


def test_a_baseline_learns_from_the_same_heading(tmp_path):
    data = open_benchmark(written_layouts.soundspaces(tmp_path / "data"))
    write_predictions(data, of_method("nearest"), tmp_path / "predictions", suffix=".npy")
    known = {response(name, 2).tobytes(): name for name in data.split.train}
    for name in data.scored:
        assert known[np.load(tmp_path / "predictions" / f"{name}.npy").tobytes()].split("/")[0] == name.split("/")[0]


def test_names_of_files_may_be_those_of_the_dataset(tmp_path):
    data = open_benchmark(written_layouts.raf(tmp_path / "raf"))
    for name in data.scored:
        wav(tmp_path / "predictions" / name / "rir.wav", response(name, 1))
    assert scored(data, tmp_path / "predictions").comparable
    data = open_benchmark(written_layouts.acousticrooms(tmp_path / "rooms"))
    for name in data.scored:
        wav(tmp_path / "others" / "single_channel_ir" / f"{name}_hybrid_IR.wav", response(name, 1))
    assert scored(data, tmp_path / "others").comparable


def test_the_split_of_a_layout_can_be_chosen(tmp_path):
    folder = written_layouts.soundspaces(tmp_path / "data")
    shipped, hashed = (open_benchmark(folder, split=split).split for split in ("", "hashed"))
    assert (shipped.name, shipped.source) == ("split.json", UNKNOWN_SOURCE)  # not one that anybody has published
    assert hashed.digest != shipped.digest
    assert {name.split("/")[1] for name in hashed.test}.isdisjoint({name.split("/")[1] for name in hashed.train})
    own = tmp_path / "own.json"
    own.write_text(json.dumps(["90/0_1.wav"]))
    assert open_benchmark(folder, split=str(own)).split.test == {"90/0_1"}
    with pytest.raises(SplitError, match="cannot be read"):
        open_benchmark(folder, split="published")


def test_files_sorted_into_folders_are_a_split(tmp_path):
    folder = written_layouts.meshrir(tmp_path / "data")
    for part, indices in (("train", range(9)), ("test", range(9, 12))):
        (folder / part).mkdir()
        for index in indices:
            (folder / f"ir_{index}.npy").rename(folder / part / f"ir_{index}.npy")
    data = open_benchmark(folder)
    assert data.split.test == {f"{index}_{source}" for index in range(9, 12) for source in range(2)}
    assert "train and test" in data.split.source


def test_a_folder_of_no_layout_is_refused(tmp_path):
    with pytest.raises(SourceError, match=r"is none of soundspaces, .*name --layout"):
        open_benchmark(tmp_path)
    with pytest.raises(SourceError, match="there is no such folder"):
        open_benchmark(tmp_path / "none")
    with pytest.raises(SourceError, match="there is no 'mp3'"):
        open_benchmark(tmp_path, layout="mp3")


def test_a_reference_that_cannot_be_read_is_named(tmp_path):
    folder = written_layouts.raf(tmp_path / "data")
    data = open_benchmark(folder)
    predictions = identity(data, tmp_path / "predictions")
    (folder / "data/000008/rir.wav").write_bytes(b"")
    with pytest.raises(SourceError, match=r"000008/rir\.wav: response: empty file: download it again"):
        scored(data, predictions)


@pytest.mark.parametrize("samples", [0, SAMPLES])
def test_a_silent_reference_is_scored_for_nobody(tmp_path, samples):
    folder = written_layouts.raf(tmp_path / "data")
    wav(folder / "data/000008/rir.wav", np.zeros((1, samples), np.float32))
    data = open_benchmark(folder)
    predictions = identity(data, tmp_path / "predictions")
    result = scored(data, predictions)
    assert (result.silent, result.scored, result.comparable) == (("000008",), 2, True)
    assert "1 references are silent and scored for nobody: 000008." in result.notes()


def test_missing_predictions_are_an_error_or_a_score_that_says_so(tmp_path):
    data = open_benchmark(written_layouts.raf(tmp_path / "data"))
    predictions = identity(data, tmp_path / "predictions")
    (predictions / "000008.wav").unlink()
    with pytest.raises(PredictionError, match=r"lacks 1 of 3 predictions: 000008: add them, or give --allow-missing"):
        scored(data, predictions)
    result = scored(data, predictions, allow_missing=True)
    assert (result.comparable, result.benchmark, result.scored) == (False, None, 2)
    assert markdown(result).startswith("**NOT COMPARABLE: 1 of 3 predictions are missing (000008)")
    told = result.to_json()
    assert (told["comparable"], told["benchmark"]) == (False, None)
    assert told["scored"]["missing_predictions"] == ["000008"]
    for path in predictions.iterdir():
        path.unlink()
    with pytest.raises(PredictionError, match="has none of the 3 test responses"):
        scored(data, predictions, allow_missing=True)


def test_failures_count_as_each_definition_says(tmp_path):
    data = open_benchmark(written_layouts.raf(tmp_path / "data"))

    def broken(name, samples):
        if name != "000008":
            return samples
        pulse = np.zeros_like(samples)
        pulse[:, 30] = 1.0  # has no decay
        return pulse

    result = scored(data, identity(data, tmp_path / "predictions", change=broken))
    theirs, ours = result.summaries["t60_naf"], result.summaries["t60"]
    assert (theirs.missing, theirs.count) == (1, 3)
    assert theirs.mean == pytest.approx(100 / 3)
    assert (ours.missing, ours.count) == (1, 2)
    assert ours.mean == pytest.approx(0.0)


def test_scores_can_be_compared_if_nothing_but_predictions_differs(tmp_path):
    folder = written_layouts.raf(tmp_path / "data")
    data = open_benchmark(folder)
    predictions = identity(data, tmp_path / "predictions")
    louder = identity(data, tmp_path / "louder", change=lambda _, samples: 2 * samples)
    first = scored(data, predictions)
    assert scored(data, louder).benchmark == first.benchmark
    assert scored(data, louder).summaries["level"].mean == pytest.approx(20 * np.log10(2), rel=1e-6)
    others = (replace(data, duration_s=0.1), replace(data, scored_rate=8_000), open_benchmark(folder, split="hashed"))
    for other in others:
        assert scored(other, identity(other, tmp_path / "other")).benchmark != first.benchmark
    wav(folder / "data/000008/rir.wav", response("another", 1))
    data = open_benchmark(folder)
    assert scored(data, predictions).benchmark != first.benchmark


def test_rates_and_lengths_are_told(tmp_path):
    data = open_benchmark(written_layouts.raf(tmp_path / "data"))
    for case in data.cases:
        (name,) = case.names
        wav(tmp_path / "predictions" / f"{name}.wav", np.repeat(response(name, 1), 2, axis=1)[:, :-100], 2 * RATE)
    result = scored(replace(data, scored_rate=8_000, duration_s=0.2), tmp_path / "predictions")
    assert result.notes() == [
        "References were resampled from 16000 to 8000 Hz.",
        "3 predictions were resampled from 32000 to 8000 Hz.",
        "Only the first 0.2 s of each response were scored.",
        "3 predictions are longer than their references; the rest was not scored.",
    ]
    assert result.to_json()["predictions"]["rates"] == {"32000": 3}


@pytest.fixture
def measured(tmp_path):
    return Room(tail=0.05).write(tmp_path / "measured").folder


@pytest.mark.parametrize(
    ("method", "suffix"),
    [
        ("nearest", ".wav"),
        ("linear-aligned", ".npy"),
        *(
            pytest.param(*each, marks=pytest.mark.long)
            for each in (("nearest", ".npy"), ("linear", ".wav"), ("linear", ".npy"), ("linear-aligned", ".wav"))
        ),
    ],
)
def test_a_score_is_what_evaluate_says(measured, tmp_path, method, suffix):
    data = open_benchmark(measured)
    write_predictions(data, of_method(method), tmp_path / "predictions", suffix=suffix)
    result = scored(data, tmp_path / "predictions")
    with open_held_out(measured) as held_out:
        evaluated = evaluate(held_out, method_columns([method], held_out), threads=1).of(method)
    assert result.scored == len(held_out)
    for metric in OURS:
        if result.summaries[metric.name] is not None:
            assert result.summaries[metric.name] == evaluated.summaries[metric.name], metric.name
    assert result.summaries["c50"].mean > 0


def test_a_bundles_level_scores_as_it_is_evaluated(dataset, tiny_bundle, tmp_path):
    data = open_benchmark(dataset.folder)
    write_predictions(data, of_bundle(tiny_bundle, None), tmp_path / "predictions")
    result = scored(data, tmp_path / "predictions")
    with open_held_out(dataset.folder) as held_out:
        (column,) = field_columns([tiny_bundle], held_out)
        evaluated = evaluate(held_out, [column], threads=1).of(column.name)
    assert result.scored == len(held_out) * len(dataset.yaws)
    for metric in OURS:
        ours, theirs = (asdict(each.summaries[metric.name]) for each in (result, evaluated))
        # Sums are taken in another order where an array lies otherwise in memory.
        assert ours == pytest.approx(theirs, rel=1e-12), metric.name
    with pytest.raises(SourceError, match="has its own; leave --split out"):
        open_benchmark(dataset.folder, split="hashed")


def test_an_interrupted_score_goes_on(tmp_path):
    folder = written_layouts.raf(tmp_path / "data")
    data = open_benchmark(folder)
    predictions = identity(data, tmp_path / "predictions", change=lambda _, samples: 2 * samples)
    kept = tmp_path / "score.partial"

    def interrupted(cases):
        for case in cases:
            if case == 2:
                raise KeyboardInterrupt
            yield case

    with pytest.raises(KeyboardInterrupt):
        scored(data, predictions, stored=StoredErrors(kept, data.identity()), track=interrupted)
    stored = StoredErrors(kept, data.identity())
    assert len(stored) >= 2
    for name in ("000007", "000008"):
        (folder / "data" / name / "rir.wav").unlink()  # is not read again
    again = scored(data, predictions, stored=stored)
    assert again.to_json() == scored_afresh(tmp_path, predictions).to_json()
    assert not kept.exists()


def scored_afresh(tmp_path, predictions):
    data = open_benchmark(written_layouts.raf(tmp_path / "afresh"))
    return replace(scored(data, predictions), dataset="data")


def test_the_list_has_each_response_with_its_places(tmp_path):
    data = open_benchmark(written_layouts.soundspaces(tmp_path / "data"))
    heading, *rows = listed(data)
    assert heading == [
        "name",
        "listener_x",
        "listener_y",
        "listener_z",
        "emitter_x",
        "emitter_y",
        "emitter_z",
        "yaw_deg",
    ]
    assert [row[0] for row in rows] == TESTED["soundspaces"]
    assert list(map(float, rows[0][1:])) == [*written_layouts.POINTS[0], *written_layouts.POINTS[1], 90.0]
