import json

import numpy as np
import numpy.typing as npt
import pytest
from rich.console import Console

from training.baselines.held_out import EvaluationError
from training.evaluation.evaluate import METRICS, Column, Evaluation, evaluate, milliseconds_per_response
from training.evaluation.published import SOUNDSPACES
from training.evaluation.report import markdown, report

RATE = 8_000
SAMPLES = 4_000
PAIRS, YAWS = 5, 3
VISIBLE = (True, True, False, True, False)
HELD_OUT = tuple(range(1, 1 + PAIRS))

Responses = npt.NDArray[np.float64]


def simulated(pair: int, *, seed: int, t60_s: float = 0.3, gain: float = 1.0, channels: int = 2) -> Responses:
    """A direct sound and a decay that is longer for later pairs; the seed draws the noise of the simulation."""
    random = np.random.default_rng([seed, pair])
    time_s = np.arange(SAMPLES - 200) / RATE
    tail = random.standard_normal((YAWS, channels, len(time_s))) * 10.0 ** (-3.0 * time_s / (t60_s + 0.03 * pair))
    ir = np.zeros((YAWS, channels, SAMPLES))
    ir[..., 200:] = 0.05 * tail
    if pair not in HELD_OUT or VISIBLE[HELD_OUT.index(pair)]:
        ir[..., 190] = 1.0
    return gain * ir


def reference(pair: int) -> Responses:
    return simulated(pair, seed=0)


def column(name, take, kind="baseline", **changes) -> Column:
    return Column(name, lambda index, turns: take(HELD_OUT[index])[turns], kind, **changes)


DEFAULT = (
    column("nearest", lambda pair: simulated(pair, seed=2, t60_s=0.4, gain=1.5), method="aac-nearest"),
    column("linear", lambda pair: simulated(pair, seed=3, t60_s=0.22, gain=0.6)),
)
FLOOR = column("floor", lambda pair: simulated(pair, seed=1), "floor")


@pytest.fixture
def held_out(make_held_out):
    return make_held_out(reference, held_out=HELD_OUT, yaws=YAWS, visible=VISIBLE)


@pytest.fixture
def evaluated(held_out):
    def run(field, *, baselines=DEFAULT, data=held_out, **options) -> Evaluation:
        return evaluate(data, [column("field", field, "field"), *baselines, FLOOR], **options)

    return run


def test_a_perfect_field_has_no_error_and_beats_the_baselines(evaluated) -> None:
    field = evaluated(reference).of("field")
    assert set(field.summaries) == {metric.name for metric in METRICS}
    assert all(summary.mean == 0.0 for summary in field.summaries.values())
    for name in ("t60", "edt", "c50", "level", "spectral_loss"):
        assert field.beats[name] == ("nearest", "linear")


def test_a_field_like_another_simulation_is_at_the_floor(evaluated) -> None:
    evaluation = evaluated(lambda pair: simulated(pair, seed=1))
    assert evaluation.of("field").summaries == evaluation.floor.summaries
    ratios = [entry["times_floor"] for entry in evaluation.to_json()["columns"]["field"]["metrics"].values()]
    assert {ratio for ratio in ratios if ratio is not None} == {1.0}


def test_a_worse_field_does_not_beat_the_baselines(evaluated) -> None:
    field = evaluated(lambda pair: simulated(pair, seed=4, t60_s=0.9, gain=4.0)).of("field")
    for name in ("t60", "edt", "c50", "level"):
        assert field.beats[name] == ()


def test_each_baseline_is_beaten_on_its_own(evaluated) -> None:
    poor = column("poor", lambda pair: simulated(pair, seed=5, gain=3.0))
    field = evaluated(lambda pair: simulated(pair, seed=4, gain=1.2), baselines=(poor, column("exact", reference))).of(
        "field"
    )
    assert field.beats["level"] == ("poor",)


def test_only_what_errs_less_beyond_chance_surpasses(evaluated) -> None:
    """Levels of baselines are off by 3.5 and 4.4 dB at every pair; two draws of the same are off by their noise."""
    twin = column("twin", lambda pair: simulated(pair, seed=7))
    evaluation = evaluated(lambda pair: simulated(pair, seed=1), baselines=(*DEFAULT, twin))
    assert evaluation.of("field").surpassed_by["level"] == ()
    assert evaluation.of("twin").surpassed_by["level"] == ()
    assert evaluation.of("nearest").surpassed_by["level"] == ("field", "twin")
    assert evaluation.of("linear").surpassed_by["level"] == ("field", "nearest", "twin")
    table = markdown(evaluation, SOUNDSPACES).splitlines()
    levels = {row.split("|")[1].strip(): row.split("|")[9].strip() for row in table[4:]}
    assert levels["field"].startswith("**")
    assert levels["twin"].startswith("**")
    assert not levels["nearest"].startswith("**")


def test_hidden_pairs_have_no_direct_sound_and_are_counted(evaluated) -> None:
    evaluation = evaluated(reference)
    for result in evaluation.results:
        for name in ("drr", "itd"):
            assert (result.summaries[name].count, result.summaries[name].missing) == (3 * YAWS, 2 * YAWS)
        assert result.summaries["c50"].missing == 0
    assert evaluation.visible_pairs == 3


def test_a_field_does_not_win_by_being_unmeasurable(evaluated) -> None:
    """Perfect where it sounds, silent at one pair: the errors it does have are zero, but it must not win."""
    field = evaluated(lambda pair: 0.0 * reference(pair) if pair == HELD_OUT[0] else reference(pair)).of("field")
    assert field.summaries["t60"].mean == 0.0
    assert field.summaries["t60"].missing == YAWS
    assert field.beats["t60"] == ()


def test_what_a_method_does_not_answer_is_missing_in_every_metric(held_out) -> None:
    shy = Column("shy", lambda index, turns: None if index == 0 else reference(HELD_OUT[index])[turns], "baseline")
    result = evaluate(held_out, [shy]).of("shy")
    assert {result.summaries[name].missing for name in ("t60", "spectral_loss", "level", "onset")} == {YAWS}
    assert result.ms is not None
    assert milliseconds_per_response(Column("mute", lambda *_: None, "baseline"), held_out) is None


def test_a_late_direct_sound_is_an_onset_error_not_a_loss_of_direct_sound(evaluated) -> None:
    field = evaluated(lambda pair: np.roll(reference(pair), 12, axis=-1)).of("field")  # 1.5 ms
    assert field.summaries["drr"].mean == pytest.approx(0.0, abs=0.02)
    assert field.summaries["onset"].mean == pytest.approx(1.5)


def test_one_microphone_is_measured_by_all_but_what_compares_ears(make_held_out) -> None:
    def mono(pair):
        return simulated(pair, seed=0, channels=1)

    data = make_held_out(mono, held_out=HELD_OUT, yaws=YAWS, visible=VISIBLE)
    evaluation = evaluate(data, [column("field", mono, "field")])
    result = evaluation.of("field")
    for name in ("iacc", "iacc_early", "itd"):
        assert (result.summaries[name].mean, result.summaries[name].missing) == (None, PAIRS * YAWS)
    assert result.summaries["t60"].count == PAIRS * YAWS
    assert evaluation.floor is None
    table = markdown(evaluation, SOUNDSPACES)
    assert "One microphone" in table
    assert "floor is unknown" in table


def test_a_sample_is_a_subset_and_the_same_for_the_same_seed(held_out) -> None:
    first, again = (held_out.sample(pairs=3, yaws=2, seed=4) for _ in range(2))
    np.testing.assert_array_equal(first.held_out, again.held_out)
    assert set(first.held_out) < set(held_out.held_out)
    assert len(first) == 3
    assert list(first.yaw_indices) == [0, 1]
    for index, pair in enumerate(first.held_out):
        assert first.visible[index] == VISIBLE[HELD_OUT.index(pair)]
        np.testing.assert_array_equal(first.reference(index), reference(pair)[[0, 1]].astype(np.float32))
    assert len(held_out.sample(pairs=99, yaws=99, seed=0)) == PAIRS


def test_json_is_plain_and_complete(evaluated) -> None:
    evaluation = evaluated(lambda pair: 0.0 * reference(pair))
    parsed = json.loads(json.dumps(evaluation.to_json(), allow_nan=False))
    assert (parsed["pairs"], parsed["yaws"], parsed["visible_pairs"]) == (PAIRS, YAWS, 3)
    assert list(parsed["columns"]) == ["field", "nearest", "linear", "floor"]
    t60 = parsed["columns"]["field"]["metrics"]["t60"]
    assert (t60["mean"], t60["count"], t60["missing"], t60["beats"]) == (None, 0, PAIRS * YAWS, [])


def test_tables_show_every_method_and_metric_and_what_was_published(evaluated) -> None:
    evaluation = evaluated(lambda pair: 0.0 * reference(pair) if pair == HELD_OUT[0] else reference(pair), of=40)
    console = Console(width=200, record=True)
    console.print(report(evaluation, SOUNDSPACES))
    text = console.export_text()
    for expected in ("T60", "(ms)", "spectral loss", "floor", "9.35", "published", "3 missing", "drawn from 40"):
        assert expected in text
    table = markdown(evaluation, SOUNDSPACES)
    rows = [line for line in table.splitlines() if line.startswith("| ")]
    assert len({line.count("|") for line in rows}) == 1
    assert [line.split("|")[1].strip() for line in rows[2:]] == ["field", "nearest", "linear", "floor"]
    assert "(9.35)" in table
    assert SOUNDSPACES.data in table


def test_the_best_of_the_judged_is_bold_and_never_the_floor(evaluated) -> None:
    lines = markdown(evaluated(lambda pair: simulated(pair, seed=9, gain=1.01)), SOUNDSPACES).splitlines()
    by_name = {line.split("|")[1].strip(): line for line in lines if line.startswith("| ")}
    assert by_name["field"].count("**") >= 2
    assert "**" not in by_name["floor"]


def test_progress_sees_every_pair(evaluated) -> None:
    seen: list[int] = []

    def track(pairs: range):
        for pair in pairs:
            seen.append(pair)
            yield pair

    evaluated(reference, track=track)
    assert seen == list(range(PAIRS))


def test_what_cannot_be_compared_is_refused(evaluated, make_held_out) -> None:
    with pytest.raises(EvaluationError, match="field: responses of"):
        evaluated(lambda pair: reference(pair)[..., :-1])
    with pytest.raises(EvaluationError, match="same name"):
        evaluated(reference, baselines=(column("field", reference),))
    with pytest.raises(EvaluationError, match="held out"):
        make_held_out(reference, held_out=())


def test_time_is_of_one_response(held_out) -> None:
    asked: list[int] = []

    def source(index, turns):
        asked.append(len(turns))
        return reference(HELD_OUT[index])[turns]

    assert milliseconds_per_response(Column("field", source, "field", extra_ms=1e4), held_out) > 1e4
    assert set(asked) == {1}
