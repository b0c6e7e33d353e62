"""The figure of a probe of emitters: a row for each kind of features, with the t-SNE of the features as colours, the
decoded distance, and the decoded over the true distance."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from server.acoustics.geometry import FloorPlan
from training.evaluation.emitter_probe import EmitterProbe

_MAP = "viridis"


def draw_emitter_probe(probe: EmitterProbe, path: Path) -> None:
    """Write a PNG; the first row is the truth."""
    rows = len(probe.reads) + 1
    figure = Figure(figsize=(10.5, 3.0 * rows), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, 3, squeeze=False)
    farthest = float(probe.true_m.max())
    drawn = _draw_cells(panels[0][1], probe, probe.true_m, farthest)
    panels[0][1].set_title("true distance of the emitter\nto the nearest wall (m)", fontsize=10)
    for axes in (panels[0][0], panels[0][2]):
        axes.set_axis_off()
    for axes_of_row, (name, read) in zip(panels[1:], probe.reads.items(), strict=True):
        if read.colours is None:
            axes_of_row[0].set_axis_off()
        else:
            _draw_cells(axes_of_row[0], probe, read.colours, farthest)
            axes_of_row[0].set_title(f"{name}: t-SNE", fontsize=10)
        _draw_cells(axes_of_row[1], probe, read.distance_m, farthest)
        axes_of_row[1].set_title(f"{name}: decoded, {100 * read.explained:.0f} % of variance", fontsize=10)
        axes_of_row[2].plot(probe.true_m, read.distance_m, ".", color="#0b6e99", markersize=2.5)
        axes_of_row[2].axline((0.0, 0.0), slope=1.0, color="#222222", linewidth=1.0)
        axes_of_row[2].set(xlabel="true (m)", ylabel="decoded (m)")
        axes_of_row[2].grid(alpha=0.25)
    figure.colorbar(drawn, ax=list(panels[:, 1]), shrink=0.5, pad=0.01, extend="both")
    figure.savefig(path, dpi=100)


def _draw_cells(axes: Axes, probe: EmitterProbe, values: npt.NDArray[np.float64], farthest: float) -> PathCollection:
    _draw_walls(axes, probe.plan)
    axes.plot(*probe.listeners[:, :2].T, "x", color="#ff3b30", markersize=5)
    x, y = probe.cells[:, 0], probe.cells[:, 1]
    if values.ndim > 1:  # colours
        return axes.scatter(x, y, c=values, s=7, linewidths=0, marker="s")
    return axes.scatter(x, y, c=values, vmin=0.0, vmax=farthest, cmap=_MAP, s=7, linewidths=0, marker="s")


def _draw_walls(axes: Axes, plan: FloorPlan) -> None:
    walls = np.asarray(plan.corners)
    axes.plot(*np.concatenate([walls, walls[:1]]).T, color="black", linewidth=1.5)
    axes.set_aspect("equal")
    axes.set_axis_off()
