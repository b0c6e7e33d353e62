import json
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from rich.console import Console

from training.evaluation.evaluate import METRICS, Evaluation, MetricRow, evaluate, report
from training.evaluation.figure import draw_figure

RATE = 8_000
SAMPLES = 4_000
PAIRS, YAWS = 5, 3
VISIBLE = np.array([True, True, False, True, False])

Responses = npt.NDArray[np.float64]


def simulated(pair: int, *, seed: int, t60_s: float = 0.3, gain: float = 1.0) -> Responses:
    """A direct sound and a decay that is longer for later pairs; the seed draws the noise of the simulation."""
    random = np.random.default_rng([seed, pair])
    time_s = np.arange(SAMPLES - 200) / RATE
    tail = random.standard_normal((YAWS, 2, len(time_s))) * 10.0 ** (-3.0 * time_s / (t60_s + 0.03 * pair))
    ir = np.zeros((YAWS, 2, SAMPLES))
    ir[..., 200:] = 0.05 * tail
    if VISIBLE[pair]:
        ir[..., 190] = 1.0
    return gain * ir


def log_magnitude(ir: Responses) -> npt.NDArray[np.float64]:
    frames = ir.reshape(*ir.shape[:-1], -1, 100)
    return np.log(np.abs(np.fft.rfft(frames, axis=-1)).swapaxes(-1, -2) + 1e-3)


def reference(pair: int) -> Responses:
    return simulated(pair, seed=0)


def evaluated(field, **changes) -> Evaluation:
    options = {
        "baselines": {
            "nearest": lambda pair: simulated(pair, seed=2, t60_s=0.4, gain=1.5),
            "linear": lambda pair: simulated(pair, seed=3, t60_s=0.22, gain=0.6),
        },
        "informational": {"linear, aligned": reference},
        "repeats": lambda pair: simulated(pair, seed=1),
        "visible": VISIBLE,
        "sample_rate": RATE,
        "log_magnitude": log_magnitude,
    }
    return evaluate(reference, field=field, **(options | changes))


def row(evaluation: Evaluation, name: str) -> MetricRow:
    return next(row for row in evaluation.rows if row.name == name)


def test_a_perfect_field_has_no_error_and_beats_the_baselines() -> None:
    evaluation = evaluated(reference)
    assert [row.name for row in evaluation.rows] == [metric.name for metric in METRICS]
    assert all(row.columns["field"].mean == 0.0 for row in evaluation.rows)
    for name in ("t60", "edt", "c50", "level", "spectral_loss"):
        assert row(evaluation, name).beats_baselines
        assert row(evaluation, name).above_floor


def test_a_field_like_another_simulation_is_at_the_floor() -> None:
    evaluation = evaluated(lambda pair: simulated(pair, seed=1))
    for result in evaluation.rows:
        assert result.columns["field"] == result.columns["floor"]


def test_a_worse_field_does_not_beat_the_baselines() -> None:
    evaluation = evaluated(lambda pair: simulated(pair, seed=4, t60_s=0.9, gain=4.0))
    for name in ("t60", "edt", "c50", "level"):
        assert not row(evaluation, name).beats_baselines
        assert not row(evaluation, name).passes


def test_beating_one_baseline_is_not_enough() -> None:
    evaluation = evaluated(lambda pair: simulated(pair, seed=4, gain=1.2), baselines={"poor": poor, "exact": reference})
    assert not row(evaluation, "level").beats_baselines
    alone = evaluated(lambda pair: simulated(pair, seed=4, gain=1.2), baselines={"poor": poor})
    assert row(alone, "level").beats_baselines


def poor(pair: int) -> Responses:
    return simulated(pair, seed=5, gain=3.0)


def test_nothing_is_to_be_won_where_a_baseline_is_at_the_floor() -> None:
    evaluation = evaluated(lambda pair: simulated(pair, seed=4, t60_s=0.6), baselines={"exact": reference})
    result = row(evaluation, "t60")
    assert not result.beats_baselines
    assert not result.above_floor
    assert result.passes


def test_hidden_pairs_have_no_direct_sound_and_are_counted() -> None:
    evaluation = evaluated(reference)
    for name in ("drr", "itd"):
        for summary in row(evaluation, name).columns.values():
            assert (summary.count, summary.missing) == (3 * YAWS, 2 * YAWS)
    assert row(evaluation, "c50").columns["field"].missing == 0
    assert evaluation.visible_pairs == 3


def test_a_field_does_not_win_by_being_unmeasurable() -> None:
    """Perfect where it sounds, silent at one pair: the errors it does have are zero, but it must not win."""
    evaluation = evaluated(lambda pair: np.zeros((YAWS, 2, SAMPLES)) if pair == 0 else reference(pair))
    result = row(evaluation, "t60")
    assert result.columns["field"].mean == 0.0
    assert result.columns["field"].missing == YAWS
    assert not result.beats_baselines


def test_a_late_direct_sound_is_an_onset_error_not_a_loss_of_direct_sound() -> None:
    evaluation = evaluated(lambda pair: np.roll(reference(pair), 12, axis=-1))  # 1.5 ms
    assert row(evaluation, "drr").columns["field"].mean == pytest.approx(0.0, abs=0.02)
    assert row(evaluation, "onset").columns["field"].mean == pytest.approx(1.5)


def test_json_is_plain_and_complete() -> None:
    evaluation = evaluated(lambda pair: 0.0 * reference(pair))
    parsed = json.loads(json.dumps(evaluation.to_json(), allow_nan=False))
    assert (parsed["pairs"], parsed["yaws"], parsed["baselines"]) == (PAIRS, YAWS, ["nearest", "linear"])
    t60 = parsed["rows"][0]
    assert t60["columns"]["field"] == {"mean": None, "median": None, "count": 0, "missing": PAIRS * YAWS}
    assert set(t60["columns"]) == {"field", "nearest", "linear", "linear, aligned", "floor"}
    assert not t60["passes"]


def test_table_shows_every_metric_and_column() -> None:
    console = Console(width=160, record=True)
    console.print(report(evaluated(reference)))
    text = console.export_text()
    for expected in (
        "T60 (%)",
        "EDT (ms)",
        "spectral loss (ln)",
        "linear, aligned",
        "floor",
        "beats both",
        "6 missing",
    ):
        assert expected in text


def test_progress_sees_every_pair() -> None:
    seen: list[int] = []

    def track(pairs: range):
        for pair in pairs:
            seen.append(pair)
            yield pair

    evaluated(reference, track=track)
    assert seen == list(range(PAIRS))


def test_what_cannot_be_compared_is_refused() -> None:
    with pytest.raises(ValueError, match="field: responses of"):
        evaluated(lambda pair: reference(pair)[..., :-1])
    with pytest.raises(ValueError, match="same name"):
        evaluated(reference, baselines={"field": reference})
    with pytest.raises(ValueError, match="at least one"):
        evaluated(reference, baselines={})
    with pytest.raises(ValueError, match="held out"):
        evaluated(reference, visible=VISIBLE[:0])


def test_figure_is_a_picture(tmp_path: Path) -> None:
    evaluation = evaluated(lambda pair: simulated(pair, seed=4))
    path = tmp_path / "accuracy.png"
    draw_figure(
        evaluation,
        path,
        references=reference,
        columns={"field": lambda pair: simulated(pair, seed=4)},
        examples=[(0, "in sight"), (2, "hidden")],
        sample_rate=RATE,
    )
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        pixels = np.asarray(picture.convert("RGB"))
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100
