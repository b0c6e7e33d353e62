"""The figure over scenes: the errors of each method, in multiples of the difference between two simulations."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from server.acoustics.metrics import Metric
from training.evaluation.evaluate import FLOOR, METRICS, ONE_SIMULATION
from training.evaluation.paper_metrics import PAPER_METRICS
from training.evaluation.scenes import NAF, NAF_WHOLE, NEAREST, SceneResult

_DEFAULT = "default level"
_STYLES = {
    NAF_WHOLE: ("v", "#edae49", "the paper's network, whole responses (naf-whole)"),
    NAF: ("^", "#d1495b", "the same network, late reverberation (naf)"),
    NEAREST: ("s", "#66a182", "nearest pair"),
    ONE_SIMULATION: ("x", "#8d6a9f", "one simulation"),
    _DEFAULT: ("o", "#0b6e99", "default level"),
}
"""The marker, colour and label of each method; the last is drawn on top."""
_FLOOR_COLOUR, _TEXT = "#8d6a9f", "#2b3a42"
# Early IACC behaves like IACC, and the onset is exact because it comes from geometry.
_HIDDEN = {"iacc_early", "onset", *(metric.name for metric in PAPER_METRICS)}
_SHOWN = [metric for metric in METRICS if metric.name not in _HIDDEN]
_ACROSS = 4


def draw_scenes(results: Sequence[SceneResult], path: Path) -> None:
    """Write the figure as a PNG."""
    figure = figure_of(results)
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=110)


def figure_of(results: Sequence[SceneResult]) -> Figure:
    """Draw a panel per metric: scenes from left to right, and the mean error divided by the floor's mean error upwards.
    Values that could not be measured, or have no floor, are left out."""
    down = math.ceil(len(_SHOWN) / _ACROSS)
    width = max(11.5, 0.5 * len(results) * _ACROSS)
    figure = Figure(figsize=(width, 2.9 * down + 1.0), layout="constrained", facecolor="white")
    panels = figure.subplots(down, _ACROSS, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, metric in zip(panels, _SHOWN, strict=False):
        _draw_metric(axes, results, metric)
    for axes in panels[::_ACROSS]:
        axes.set_ylabel("mean error, times the floor", color=_TEXT)
    for axes in panels[len(_SHOWN) :]:
        axes.set_visible(False)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles[::-1], labels[::-1], loc="outside upper left", ncols=3, frameon=False, fontsize=10, labelcolor=_TEXT
    )
    return figure


def _draw_metric(axes: Axes, results: Sequence[SceneResult], metric: Metric) -> None:
    axes.axhline(1.0, color=_FLOOR_COLOUR, linestyle="--", linewidth=1.2, label="two simulations of a pair (floor)")
    for name, (marker, colour, label) in _STYLES.items():
        axes.plot(
            range(len(results)),
            [_times_floor(result, name, metric) for result in results],
            marker=marker,
            markersize=7 if name == _DEFAULT else 6,
            color=colour,
            linewidth=1.0,
            alpha=1.0 if name == _DEFAULT else 0.85,
            label=label,
        )
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.set_title(metric.label, fontsize=11, color=_TEXT)
    axes.set_xticks(range(len(results)), [result.scene for result in results], rotation=30, ha="right", fontsize=9)
    axes.set_xlim(-0.4, len(results) - 0.6)
    axes.grid(axis="y", alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)


def _times_floor(result: SceneResult, name: str, metric: Metric) -> float:
    method = result.ours if name == _DEFAULT else result.methods.get(name)
    error = None if method is None else method.errors.get(metric.name)
    floor = result.methods[FLOOR].errors.get(metric.name) if FLOOR in result.methods else None
    return np.nan if error is None or not floor else error / floor
