"""The figure of `nafir-train evaluate`: what it says, and that all of it can be read."""

import dataclasses
import itertools

import numpy as np
import pytest
from matplotlib.text import Text
from PIL import Image

from tests.training.held_out import held_out_in
from training.evaluation.evaluate import METRICS, Column, evaluate
from training.evaluation.figure import draw_figure, figure_of
from training.evaluation.methods import METHODS
from training.evaluation.run import _drawn

SAMPLES, RATE = 4_000, 8_000
HELD_OUT = (1, 3, 5)
LEVEL = "factorised-w1024-r16-200cm-120deg-whole"


def response(pair, *, seed=0, t60_s=0.3, gain=1.0):
    """(yaw, ear, sample): a direct sound, and a tail drawn by the seed."""
    random = np.random.default_rng([seed, pair])
    time_s = np.arange(SAMPLES - 200) / RATE
    ir = np.zeros((2, 2, SAMPLES))
    ir[..., 200:] = 0.05 * random.standard_normal((2, 2, len(time_s))) * 10.0 ** (-3.0 * time_s / t60_s)
    ir[..., 190] = 1.0
    return gain * ir


def column(name, kind="baseline", **changes):
    return Column(name, lambda index, turns: response(HELD_OUT[index], **changes)[turns], kind)


@pytest.fixture(scope="module")
def held_out(tmp_path_factory):
    folder = tmp_path_factory.mktemp("held_out")
    return held_out_in(folder, response, held_out=HELD_OUT, yaws=2, visible=(True, True, False))


@pytest.fixture(scope="module")
def columns():
    """Two levels of a field, every method there is, and the floor; the last method errs a thousand times more."""
    methods = [column(name, seed=3 + number, gain=1.01) for number, name in enumerate(METHODS)]
    methods[-1] = column(methods[-1].name, seed=99, gain=1e4)
    fields = [column(LEVEL, "field", seed=1, gain=1.001), column("short", "field", seed=1, gain=1.002)]
    return [*fields, *methods, column("floor", "floor", seed=2)]


@pytest.fixture(scope="module")
def evaluated(held_out):
    """The errors of columns, by their names measured once for all tests; `of` so many pairs that there were."""
    measured = {}

    def evaluated(columns, of=None):
        names = tuple(each.name for each in columns)
        if names not in measured:
            measured[names] = evaluate(held_out, columns)
        return measured[names] if of is None else dataclasses.replace(measured[names], held_out=of)

    return evaluated


@pytest.fixture(scope="module")
def draw(held_out, columns, evaluated):
    """The figure of these columns, of so many pairs that there were; drawn once for all tests."""
    figures = {}

    def drawn(of=None, *, columns=columns):
        evaluation = evaluated(columns, of)
        asked = evaluation.held_out, tuple(each.name for each in columns)
        if asked not in figures:
            figures[asked] = figure_of(
                evaluation,
                references=held_out.reference,
                reference_name="measured response",
                columns={each.name: each.source for each in columns if each.name in {LEVEL, "nearest"}},
                yaw_index=np.array([0]),
                examples=[(0, "in sight, 1.5 m"), (1, "in sight, 3.5 m"), (2, "round the corner, 12.5 m")],
                sample_rate=RATE,
            )
        return figures[asked]

    return drawn


def texts(figure):
    return [text for text in figure.findobj(Text) if text.get_visible() and text.get_text()]


def panel(figure, label):
    return next(axes for axes in figure.findobj(type(figure.axes[0])) if axes.get_title().startswith(label))


def test_the_heading_says_how_many_pairs_of_how_many(draw):
    (heading,) = [each for each in texts(draw(of=106)) if each.get_text().startswith("Errors")]
    assert heading.get_text().startswith("Errors of 3 of 106 held-out pairs, 2 orientations each")
    of_all = draw()
    (heading,) = [each for each in texts(of_all) if each.get_text().startswith("Errors")]
    assert heading.get_text().startswith("Errors of all 3 held-out pairs")
    assert "DRR (dB), 2 in sight" in {each.get_text() for each in texts(of_all)}


def test_decays_are_those_of_the_data_a_field_and_a_baseline(draw, columns):
    decays = draw().axes[:3]
    for axes in decays:
        assert [line.get_label() for line in axes.get_lines()] == ["measured response", LEVEL, "nearest"]
        assert len({line.get_color() for line in axes.get_lines()}) == 3
    assert [each.name for each in _drawn(columns[:-1])] == [LEVEL, "nearest"]
    assert [each.name for each in _drawn(columns[:2])] == [LEVEL]


def test_every_method_has_a_row_in_every_panel_of_errors(draw, columns):
    figure = draw()
    names = [each.name for each in columns]
    for metric in METRICS:
        axes = panel(figure, metric.label)
        assert list(axes.get_yticks()) == list(range(len(names)))
    labelled = [axes for axes in figure.axes if [tick.get_text() for tick in axes.get_yticklabels()] == names]
    assert labelled


def test_axes_are_logarithmic_where_errors_span_decades(draw, columns):
    assert panel(draw(), "level").get_xscale() == "log"
    # Without the method that is off by 80 dB.
    calm = panel(draw(columns=[each for each in columns if each.name != list(METHODS)[-1]]), "spectral loss")
    assert calm.get_xscale() == "linear"
    assert calm.get_xlim()[0] == 0


def test_the_smallest_error_is_told_from_the_next_beside_the_largest(draw):
    """Of levels 0.009, 0.017, 0.09 and 80 dB; on a linear axis the first three are one."""
    axes = panel(draw(), "level")
    at = axes.transAxes.inverted().transform
    medians = [20 * np.log10(gain) for gain in (1.001, 1.01, 1e4)]
    places = [at(axes.transData.transform((value, 0)))[0] for value in medians]
    assert min(np.diff(places)) > 0.1


@pytest.mark.parametrize("of", [3, 106])
def test_no_label_overlaps_another_or_is_cut_off(draw, of):
    figure = draw(of)
    figure.draw_without_rendering()
    boxes = {}
    for axes in figure.axes:
        for axis in (axes.xaxis, axes.yaxis):
            # Ticks beyond an axis's ends are made and not drawn.
            low, high = sorted(axis.get_view_interval())
            drawn = [tick.label1 for tick in axis.get_major_ticks() if low <= tick.get_loc() <= high]
            boxes |= {text: text.get_window_extent() for text in drawn if text.get_visible() and axes.get_visible()}
    in_axes = {label for axes in figure.axes for axis in (axes.xaxis, axes.yaxis) for label in axis.findobj(Text)}
    boxes |= {text: text.get_window_extent() for text in texts(figure) if text not in in_axes}
    boxes |= {axis.label: axis.label.get_window_extent() for axes in figure.axes for axis in (axes.xaxis, axes.yaxis)}
    boxes = {text: box for text, box in boxes.items() if box.width > 0 and box.height > 0}
    assert len(boxes) > 60
    for (one, box), (other, its) in itertools.combinations(boxes.items(), 2):
        assert not box.padded(-0.5).overlaps(its.padded(-0.5)), f"{one.get_text()!r} overlaps {other.get_text()!r}"
    for text, box in boxes.items():
        assert figure.bbox.containsx(box.x0), text.get_text()
        assert figure.bbox.containsx(box.x1), text.get_text()
        assert figure.bbox.containsy(box.y0), text.get_text()
        assert figure.bbox.containsy(box.y1), text.get_text()


def test_a_median_below_a_logarithmic_axis_is_marked_and_the_mark_explained(draw, columns, held_out):
    def entries(figure):
        return {text.get_text() for text in texts(figure)}

    assert "median below the axis" not in entries(draw())
    exact = Column("exact", lambda index, turns: held_out.reference(index)[turns], "field")
    figure = draw(columns=[exact, *columns])
    assert "median below the axis" in entries(figure)
    assert any(line.get_marker() == "<" for line in panel(figure, "level").get_lines())


def test_it_is_written_as_a_picture(held_out, columns, tmp_path):
    path = tmp_path / "accuracy.png"
    draw_figure(
        evaluate(held_out, columns[:3]),
        path,
        references=held_out.reference,
        reference_name="measured response",
        columns={LEVEL: columns[0].source},
        yaw_index=np.array([0]),
        examples=[(0, "in sight")],
        sample_rate=RATE,
    )
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        assert picture.width == 1650
        pixels = np.asarray(picture.convert("RGB"))
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100
