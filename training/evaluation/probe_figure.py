"""The figure of a probe: true distances to walls, distances decoded from the field's features, and distances decoded
from MFCC."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from training.evaluation.probe import ProbeResult

_COLOURS = {"features": "#0b6e99", "MFCC": "#d1495b"}
_MAP = "viridis"


def draw_probe(probing: ProbeResult, path: Path) -> None:
    """Write a PNG with four panels: a map of the true distance, a map of the distance decoded from features, distances
    decoded from MFCC at left-out places, and decoded against true distances at left-out places."""
    figure = Figure(figsize=(15.5, 3.9), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 4, gridspec_kw={"width_ratios": (1.0, 1.0, 1.0, 0.85)})
    farthest = float(probing.true_map_m.max())
    cells = (
        ("true distance to the nearest wall", probing.true_map_m),
        ("decoded from features", probing.decoded_map_m),
    )
    for axes, (title, distances) in zip(panels, cells, strict=False):
        size = probing.spacing_m
        x = np.round((probing.cells - probing.cells.min(axis=0)) / size).astype(int)
        grid = np.full(x.max(axis=0)[::-1] + 1, np.nan)
        grid[x[:, 1], x[:, 0]] = distances
        west, south = probing.cells.min(axis=0) - size / 2
        extent = (west, west + grid.shape[1] * size, south, south + grid.shape[0] * size)
        image = axes.imshow(grid, origin="lower", extent=extent, vmin=0.0, vmax=farthest, cmap=_MAP, aspect="equal")
        _draw_walls(axes, probing, title)
    axes = panels[2]
    decoded = np.clip(probing.coefficients.predicted, 0.0, farthest)
    axes.scatter(*probing.places[:, :2].T, c=decoded, vmin=0.0, vmax=farthest, cmap=_MAP, s=90, edgecolors="black")
    axes.set_aspect("equal")
    _draw_walls(axes, probing, "decoded from MFCC, at places left out")
    figure.colorbar(image, ax=list(panels[:3]), shrink=0.75, pad=0.01, label="distance (m)")
    for name, decoding in (("features", probing.features), ("MFCC", probing.coefficients)):
        label = f"{name}: {100 * decoding.mean:.0f} % of variance"
        _scatter(panels[3], probing.distance_m, decoding.predicted, _COLOURS[name], label)
    panels[3].axline((0.0, 0.0), slope=1.0, color="#222222", linewidth=1.0, zorder=0)
    panels[3].set(xlabel="true distance (m)", ylabel="decoded (m)")
    panels[3].set_title("places left out of the fit", fontsize=11)
    panels[3].set_box_aspect(1.0)
    panels[3].grid(alpha=0.25)
    panels[3].legend(frameon=False, fontsize=9, loc="upper left")
    figure.savefig(path, dpi=110)


def _draw_walls(axes: Axes, probing: ProbeResult, title: str) -> None:
    walls = np.asarray(probing.plan.corners)
    axes.plot(*np.concatenate([walls, walls[:1]]).T, color="black", linewidth=2.0)
    low, high = walls.min(axis=0) - 0.2, walls.max(axis=0) + 0.2
    axes.set(xlabel="east (m)", ylabel="north (m)", xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_title(title, fontsize=11)


def _scatter(
    axes: Axes, true_m: npt.NDArray[np.float64], decoded_m: npt.NDArray[np.float64], colour: str, label: str
) -> None:
    axes.plot(true_m, decoded_m, "o", color=colour, markersize=5, alpha=0.8, markeredgewidth=0, label=label)
