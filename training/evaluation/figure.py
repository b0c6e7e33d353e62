"""The figure of an evaluation: decays of a few held-out pairs above, the spread of every error below."""

from collections.abc import Callable, Mapping, Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from server.acoustics.room_parameters import energy_decay_db
from training.evaluation.evaluate import METRICS, RATED, Evaluation, Source
from training.evaluation.held_out import Responses

_COLOURS = (
    "#0b6e99",
    "#d1495b",
    "#edae49",
    "#8d6a9f",
    "#66a182",
    "#b56576",
    "#3d5a80",
    "#a68a64",
    "#5b8e7d",
    "#bc4b51",
    "#7b6d8d",
)
_FLOOR_COLOUR = "#9a9a9a"
_REFERENCE_COLOUR = "#222222"
_DECAY_FLOOR_DB = -65.0


def draw_figure(
    evaluation: Evaluation,
    path: Path,
    *,
    references: Callable[[int], Responses],
    columns: Mapping[str, Source],
    turn: npt.NDArray[np.integer],
    examples: Sequence[tuple[int, str]],
    sample_rate: float,
) -> None:
    """Writes a PNG.

    `examples`: held-out pairs whose decays are shown, each with a title. `columns`: the estimates drawn beside the
    reference in those panels, named as in the evaluation; first channel, at the orientation `turn` (1,), an index into
    the yaws of the data.
    """
    judged = [result.name for result in evaluation.results if result.kind in RATED]
    colour = dict(zip(judged, cycle(_COLOURS), strict=False))
    across = max(len(examples), 5)
    figure = Figure(figsize=(3.1 * across, 9.6), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    upper, lower = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=(1.0, 1.9))))
    upper.suptitle(f"Energy decay of held-out pairs{', left ear' if evaluation.channels == 2 else ''}", fontsize=13)
    for number, (axes, (pair, title)) in enumerate(
        zip(np.atleast_1d(upper.subplots(1, len(examples), sharey=True)), examples, strict=True)
    ):
        _draw_decay(axes, references(pair)[0, 0], sample_rate, "reference", _REFERENCE_COLOUR)
        for name, source in columns.items():
            if (answer := source(pair, turn)) is not None:
                _draw_decay(axes, answer[0, 0], sample_rate, name, colour[name])
        axes.set(title=title, xlabel="time (s)", ylim=(_DECAY_FLOOR_DB, 3.0))
        axes.grid(alpha=0.25)
        if number == 0:
            axes.set_ylabel("energy still to come (dB)")
            axes.legend(frameon=False, fontsize=9)
    lower.suptitle("Errors over all held-out pairs and orientations: quartiles, 5 to 95 %, and mean (dot)", fontsize=13)
    panels = lower.subplots(2, -(-len(METRICS) // 2)).ravel()
    for axes, metric in zip(panels, METRICS, strict=False):
        _draw_errors(axes, {result.name: result.errors[metric.name] for result in evaluation.results}, colour)
        axes.set_title(f"{metric.label} ({metric.unit})" if metric.unit else metric.label)
    for axes in panels[len(METRICS) :]:
        axes.set_visible(False)
    figure.savefig(path, dpi=110)


def _draw_decay(axes: Axes, ir: npt.NDArray[np.floating], sample_rate: float, label: str, colour: str) -> None:
    if not np.any(ir):
        return
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
            box.set(facecolor=colour.get(name, _FLOOR_COLOUR), edgecolor="none")
    axes.set_xticks(range(len(errors)), list(errors), rotation=30, ha="right", fontsize=9)
    axes.set_xlim(-0.6, len(errors) - 0.4)
    axes.set_ylim(bottom=0.0)
    axes.grid(axis="y", alpha=0.25)
