"""The figure of an evaluation: decays of a few held-out pairs, and below them the distribution of each error."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from server.acoustics.metrics import Metric
from server.acoustics.room_parameters import energy_decay_db
from training.baselines.held_out import Responses
from training.evaluation.evaluate import METRICS, Evaluation, Kind, Result, Source

_COLOURS: Mapping[Kind, str] = {
    "field": "#0b6e99",
    "baseline": "#c4702b",
    "simulation": "#8d6a9f",
    "floor": "#8a8a8a",
}
_KINDS: Mapping[Kind, str] = {
    "field": "field",
    "baseline": "baseline",
    "simulation": "one simulation",
    "floor": "floor: two simulations of a pair",
}
_REFERENCE_COLOUR, _TEXT = "#222222", "#2b3a42"
_DECAY_FLOOR_DB = -65.0
_DPI = 110
_ACROSS = 5  # panels of errors in a row
_PERCENTILES = (5, 25, 50, 75, 95)
_LOGARITHMIC_FROM = 10.0
"""If the ratio between the largest and the smallest median of a metric is at least this, its axis is logarithmic."""
_MOST_DECADES = 4.0
_BELOW: Mapping[str, Any] = {"marker": "<", "markeredgecolor": "white", "markersize": 9}


def draw_figure(
    evaluation: Evaluation,
    path: Path,
    *,
    references: Callable[[int], Responses],
    reference_name: str,
    columns: Mapping[str, Source],
    yaw_index: npt.NDArray[np.integer],
    examples: Sequence[tuple[int, str]],
    sample_rate: float,
) -> None:
    """Write `figure_of` as a PNG."""
    figure = figure_of(
        evaluation,
        references=references,
        reference_name=reference_name,
        columns=columns,
        yaw_index=yaw_index,
        examples=examples,
        sample_rate=sample_rate,
    )
    figure.savefig(path, dpi=_DPI)


def figure_of(
    evaluation: Evaluation,
    *,
    references: Callable[[int], Responses],
    reference_name: str,
    columns: Mapping[str, Source],
    yaw_index: npt.NDArray[np.integer],
    examples: Sequence[tuple[int, str]],
    sample_rate: float,
) -> Figure:
    """Draw decays above and errors below.

    `examples`: held-out pairs whose decays are shown, each with a title. `reference_name`: the label of their own
    responses. `columns`: the estimates that are drawn beside the reference, named as in the evaluation; their first
    channel is shown. `yaw_index` (1,) is the index of the orientation in the data's yaws.
    """
    rows = len(evaluation.results)
    heights = 3.6, 2 * (0.9 + 0.22 * rows) + 1.0
    layout = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.06)
    figure = Figure(figsize=(15.0, sum(heights)), layout=layout, facecolor="white")
    FigureCanvasAgg(figure)
    upper, lower = np.ravel(np.asarray(figure.subfigures(2, 1, height_ratios=heights)))
    panels = np.atleast_1d(upper.subplots(1, len(examples), sharey=True))
    for axes, (pair, title) in zip(panels, examples, strict=True):
        _draw_decay(axes, references(pair)[0, 0], sample_rate, reference_name, _REFERENCE_COLOUR)
        for name, source in columns.items():
            if (answer := source(pair, yaw_index)) is not None:
                _draw_decay(axes, answer[0, 0], sample_rate, name, _COLOURS[evaluation.of(name).kind])
        axes.set(xlabel="time (s)", ylim=(_DECAY_FLOOR_DB, 3.0))
        axes.set_title(title, fontsize=11, color=_TEXT)
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("energy still to come (dB)")
    upper.suptitle(f"Energy decay of held-out pairs{', left ear' if evaluation.channels == 2 else ''}", fontsize=13)
    _add_legend(upper, list(panels))
    _draw_all_errors(lower, evaluation)
    return figure


def _add_legend(part: SubFigure, panels: Sequence[Axes]) -> None:
    """Add one legend entry per name, whichever panels show it."""
    entries: dict[str, Artist] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    part.legend(
        handles=list(entries.values()),
        labels=list(entries),
        loc="outside lower center",
        ncols=len(entries),
        frameon=False,
        fontsize=10,
    )


def _draw_decay(axes: Axes, ir: npt.NDArray[np.floating], sample_rate: float, label: str, colour: str) -> None:
    if not np.any(ir):
        return
    curve = energy_decay_db(ir, sample_rate)
    every = max(1, len(curve) // 1000)
    shown = np.where(curve[::every] > _DECAY_FLOOR_DB - 5.0, curve[::every], np.nan)
    is_reference = colour == _REFERENCE_COLOUR
    axes.plot(
        np.arange(len(curve))[::every] / sample_rate,
        shown,
        color=colour,
        label=label,
        linewidth=2.2 if is_reference else 1.4,
        zorder=1 if is_reference else 2,
    )


def _draw_all_errors(part: SubFigure, evaluation: Evaluation) -> None:
    part.suptitle(f"Errors of {_counted(evaluation)}: 5 to 95 %, quartiles, median (line) and mean (dot)", fontsize=13)
    down = math.ceil(len(METRICS) / _ACROSS)
    panels = part.subplots(down, _ACROSS, sharey=True, squeeze=False).ravel()
    is_below = False
    for axes, metric in zip(panels, METRICS, strict=False):
        is_below |= _draw_errors(axes, evaluation.results, metric)
        sighted = f", {evaluation.visible_pairs} in sight" if metric.needs_direct_sound else ""
        axes.set_title(f"{metric.label}{f' ({metric.unit})' if metric.unit else ''}{sighted}", fontsize=11, color=_TEXT)
    for axes in panels[len(METRICS) :]:
        axes.set_visible(False)
    panels[0].set_ylim(len(evaluation.results) - 0.5, -0.5)
    kinds = dict.fromkeys(result.kind for result in evaluation.results)
    handles: list[Artist] = [Patch(color=_COLOURS[kind], label=_KINDS[kind]) for kind in kinds]
    if is_below:
        handles.append(Line2D([], [], **_BELOW, color=_TEXT, linestyle="none", label="median below the axis"))
    part.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, fontsize=10)


def _counted(evaluation: Evaluation) -> str:
    """A sentence with the numbers of evaluated pairs and orientations, and of all of them."""
    pairs = (
        f"all {evaluation.pairs}"
        if evaluation.pairs == evaluation.held_out
        else f"{evaluation.pairs} of {evaluation.held_out}"
    )
    orientations = "one orientation" if evaluation.yaws == 1 else f"{evaluation.yaws} orientations"
    return f"{pairs} held-out pairs, {orientations} each"


def _draw_errors(axes: Axes, results: Sequence[Result], metric: Metric) -> bool:
    """Draw a row for each method. An arrow marks medians below a logarithmic axis; returns whether there is one."""
    present = [result.errors[metric.name][~np.isnan(result.errors[metric.name])] for result in results]
    spreads = {row: np.percentile(values, _PERCENTILES) for row, values in enumerate(present) if len(values)}
    low, is_logarithmic = _lower_end(list(spreads.values()))
    for row, (least, lower, middle, upper, most) in spreads.items():
        colour = _COLOURS[results[row].kind]
        ends = np.maximum([least, lower, upper, most], low)
        axes.plot(ends[[0, 3]], [row, row], color=colour, linewidth=1.2, solid_capstyle="butt", zorder=2)
        axes.barh(row, ends[2] - ends[1], left=ends[1], height=0.62, color=colour, zorder=3)
        axes.plot(max(float(present[row].mean()), low), row, "o", color="black", mec="white", ms=5, zorder=5)
        if middle > low:
            axes.plot([middle, middle], [row - 0.31, row + 0.31], color="white", linewidth=1.6, zorder=4)
        elif is_logarithmic:
            axes.plot(low, row, **_BELOW, color=colour, zorder=6, clip_on=False)
    axes.set_yticks(range(len(results)), [result.name for result in results], fontsize=9)
    axes.tick_params(axis="x", labelsize=9)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", alpha=0.25, zorder=0)
    axes.spines[["top", "right"]].set_visible(False)
    _set_scale(axes, low, is_logarithmic=is_logarithmic)
    return is_logarithmic and any(spread[2] <= low for spread in spreads.values())


def _lower_end(spreads: Sequence[npt.NDArray[np.floating]]) -> tuple[float, bool]:
    """The lower end of the axis for these percentiles, and whether the axis is logarithmic."""
    medians = [spread[2] for spread in spreads if spread[2] > 0]
    if not medians or max(medians) < _LOGARITHMIC_FROM * min(medians):
        return 0.0, False
    most = max(spread[-1] for spread in spreads)
    least = min(value for spread in spreads for value in spread[1:3] if value > 0)
    return max(0.8 * least, most / 10**_MOST_DECADES), True


def _set_scale(axes: Axes, low: float, *, is_logarithmic: bool) -> None:
    if not is_logarithmic:
        axes.set_xlim(left=0.0)
        axes.xaxis.set_major_locator(MaxNLocator(4))
        return
    axes.set_xscale("log")
    axes.set_xlim(left=low)
    decades = np.log10(axes.get_xlim()[1] / low)
    between = (1.0, 2.0, 5.0) if decades < 1.2 else (1.0, 3.0) if decades < 2.2 else (1.0,)
    axes.xaxis.set_major_locator(LogLocator(subs=between))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
