"""Labels of plots cover neither markers nor each other."""

import itertools

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from training.frontier.labels import Label, place_labels


@pytest.mark.parametrize("scale", ["linear", "log"])
def test_labels_of_a_crowd_cover_no_marker_and_no_label_and_stay_inside(scale):
    rng = np.random.default_rng(5)
    points = np.concatenate([rng.uniform(1, 10, (12, 2)), [(9.9, 9.9), (9.8, 9.8), (1.0, 1.0)]])
    figure = Figure(figsize=(9, 5), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.scatter(*points.T, s=40)
    axes.set_xscale(scale)
    axes.set_xlim(0.5, 11)
    axes.set_ylim(0, 11)
    labels = [Label(x, y, f"a level of some name {number}") for number, (x, y) in enumerate(points.tolist()[8:])]
    placed = place_labels(axes, labels, points.tolist(), lines_y=[5.0], colour="black", line_colour="grey")
    canvas.draw()
    boxes = [Text.get_window_extent(annotation) for annotation in placed]  # without the lines to their markers
    assert {annotation.get_text() for annotation in placed} == {label.text for label in labels}
    assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))
    for box in boxes:
        assert not any(box.contains(*at) for at in axes.transData.transform(points))
        extent = axes.get_window_extent()
        assert extent.x0 <= box.x0 < box.x1 <= extent.x1
        assert extent.y0 <= box.y0 < box.y1 <= extent.y1
