"""The figure of an evaluation: decays of a few held-out pairs above, the spread of every error below."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from server.acoustics.room_parameters import energy_decay_db
from training.evaluation.evaluate import FLOOR, METRICS, Evaluation, PairSource

_COLOURS = ("#0b6e99", "#d1495b", "#edae49", "#8d6a9f", "#66a182")
_REFERENCE_COLOUR = "#222222"
_DECAY_FLOOR_DB = -65.0


def draw_figure(
    evaluation: Evaluation,
    path: Path,
    *,
    references: PairSource,
    columns: Mapping[str, PairSource],
    examples: Sequence[tuple[int, str]],
    sample_rate: float,
) -> None:
    """Writes a PNG.

    `examples`: held-out pairs whose decays are shown, each with a title. `columns`: the estimates drawn beside the
    reference in those panels, named as in the evaluation; left ear, first yaw.
    """
    colour = dict(zip([name for name in evaluation.errors if name != FLOOR], _COLOURS, strict=False))
    colour[FLOOR] = "#9a9a9a"
    across = max(len(examples), 5)
    figure = Figure(figsize=(3.1 * across, 9.6), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    upper, lower = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=(1.0, 1.9))))
    upper.suptitle("Energy decay of held-out pairs, left ear", fontsize=13)
    for number, (axes, (pair, title)) in enumerate(
        zip(np.atleast_1d(upper.subplots(1, len(examples), sharey=True)), examples, strict=True)
    ):
        _draw_decay(axes, references(pair)[0, 0], sample_rate, "reference", _REFERENCE_COLOUR)
        for name, source in columns.items():
            _draw_decay(axes, source(pair)[0, 0], sample_rate, name, colour.get(name, "#555555"))
        axes.set(title=title, xlabel="time (s)", ylim=(_DECAY_FLOOR_DB, 3.0))
        axes.grid(alpha=0.25)
        if number == 0:
            axes.set_ylabel("energy still to come (dB)")
            axes.legend(frameon=False, fontsize=9)
    lower.suptitle("Errors over all held-out pairs and orientations: quartiles, 5 to 95 %, and mean (dot)", fontsize=13)
    panels = lower.subplots(2, -(-len(METRICS) // 2)).ravel()
    for axes, metric in zip(panels, METRICS, strict=False):
        _draw_errors(axes, {name: errors[metric.name] for name, errors in evaluation.errors.items()}, colour)
        axes.set_title(f"{metric.label} ({metric.unit})" if metric.unit else metric.label)
    for axes in panels[len(METRICS) :]:
        axes.set_visible(False)
    figure.savefig(path, dpi=110)


def _draw_decay(axes: Axes, ir: npt.NDArray[np.floating], sample_rate: float, label: str, colour: str) -> None:
    curve = energy_decay_db(ir, sample_rate)
    every = max(1, len(curve) // 1000)
    shown = np.where(curve[::every] > _DECAY_FLOOR_DB - 5.0, curve[::every], np.nan)
    reference = label == "reference"
    axes.plot(
        np.arange(len(curve))[::every] / sample_rate,
        shown,
        color=colour,
        label=label,
        linewidth=2.2 if reference else 1.4,
        zorder=1 if reference else 2,
    )


def _draw_errors(axes: Axes, errors: Mapping[str, npt.NDArray[np.float64]], colour: Mapping[str, str]) -> None:
    present = {name: values[~np.isnan(values)] for name, values in errors.items()}
    drawn = [name for name, values in present.items() if len(values)]
    if drawn:
        boxes = axes.boxplot(
            [present[name] for name in drawn],
            positions=[list(errors).index(name) for name in drawn],
            whis=(5, 95),
            showfliers=False,
            showmeans=True,
            widths=0.65,
            patch_artist=True,
            medianprops={"color": "white", "linewidth": 1.5},
            meanprops={"marker": "o", "markerfacecolor": "black", "markeredgecolor": "white", "markersize": 5},
        )
        for name, box in zip(drawn, boxes["boxes"], strict=True):
            box.set(facecolor=colour.get(name, "#555555"), edgecolor="none")
    axes.set_xticks(range(len(errors)), list(errors), rotation=30, ha="right", fontsize=9)
    axes.set_xlim(-0.6, len(errors) - 0.4)
    axes.set_ylim(bottom=0.0)
    axes.grid(axis="y", alpha=0.25)
