import numpy as np
import pytest
from numpy.testing import assert_array_equal

from training.evaluation import stored_errors
from training.evaluation.evaluate import METRICS, Column, evaluate
from training.evaluation.run import evaluate_bundles
from training.evaluation.stored_errors import StoredErrors, signature

PAIRS, SAMPLES = 6, 2_000


def noise(pair, seed=0):
    random = np.random.default_rng([seed, pair])
    return 0.1 * random.standard_normal((2, 2, SAMPLES)) * np.exp(-np.arange(SAMPLES) / 200)


@pytest.fixture
def held_out(make_held_out):
    return make_held_out(noise, held_out=tuple(range(PAIRS)), yaws=2, visible=(True,) * PAIRS)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "table.json.partial"


class Source:
    """Counts what it is asked for, and is interrupted at its third pair where told to be."""

    def __init__(self, *, is_interrupted=False):
        self.asked = []
        self.is_interrupted = is_interrupted

    def __call__(self, index, turns):
        if self.is_interrupted and len(self.asked) == 2:
            raise KeyboardInterrupt
        self.asked.append(index)
        return noise(index, seed=1)[turns]


def run(held_out, path, source, depends_on=("bundle",)):
    stored = StoredErrors(path, depends_on)
    return evaluate(held_out, [Column("field", source, "baseline")], threads=1, stored=stored)


def test_what_was_interrupted_goes_on_and_comes_to_the_same(held_out, path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run(held_out, path, Source(is_interrupted=True))
    resumed = Source()
    errors = run(held_out, path, resumed).of("field").errors
    # What a response takes is measured at the end, of any pairs.
    assert resumed.asked[: PAIRS - 2] == [2, 3, 4, 5]
    whole = evaluate(held_out, [Column("field", Source(), "baseline")]).of("field").errors
    for metric in METRICS:
        assert_array_equal(errors[metric.name], whole[metric.name])
    assert len(StoredErrors(path, ("bundle",))) == PAIRS


def test_of_anything_else_or_by_other_code_all_is_measured_anew(held_out, path, monkeypatch) -> None:
    run(held_out, path, Source())
    assert len(StoredErrors(path, ("bundle",))) == PAIRS
    assert len(StoredErrors(path, ("another bundle",))) == 0
    run(held_out, path, Source())
    monkeypatch.setattr(stored_errors, "code_digest", lambda: "other")
    assert len(StoredErrors(path, ("bundle",))) == 0


def test_a_line_that_was_not_finished_is_measured_anew(held_out, path) -> None:
    run(held_out, path, Source())
    path.write_text(path.read_text()[:-9])
    kept = StoredErrors(path, ("bundle",))
    assert len(kept) == PAIRS - 1
    assert kept.get(PAIRS - 1) == {}
    run(held_out, path, Source())
    assert len(StoredErrors(path, ("bundle",))) == PAIRS


def test_missing_errors_stay_missing(path) -> None:
    StoredErrors(path, ()).put(3, {1: {"t60": np.array([np.nan, 0.1])}})
    column = StoredErrors(path, ()).get(3)[1]
    assert_array_equal(column["t60"], [np.nan, 0.1])


def test_a_folder_that_was_written_to_has_another_signature(tmp_path) -> None:
    (tmp_path / "pairs.h5").write_bytes(b"1")
    before = signature(tmp_path)
    assert signature(tmp_path) == before
    (tmp_path / "pairs.h5").write_bytes(b"22")
    assert signature(tmp_path) != before


def test_nothing_is_left_of_an_evaluation_that_ends(tiny_bundle, dataset, path) -> None:
    evaluation, _ = evaluate_bundles([tiny_bundle], dataset.folder, methods=[], pairs=2, yaws=1, keep=path)
    assert evaluation.pairs == 2
    assert not path.exists()
