"""The frontier as a picture: audible error over the time a response takes."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from training.frontier.points import Point
from training.frontier.sweep import Frontier

_PARETO, _OTHER, _FLOOR, _DEADLINE, _BOUND = "#0b6e99", "#b9c4cb", "#8d6a9f", "#d1495b", "#66a182"


def draw_frontier(frontier: Frontier, path: Path) -> None:
    """Writes a PNG: all points, the line of those worth their time, the repeatability floor, the block deadline."""
    figure = Figure(figsize=(10.5, 6.0), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    best = list(frontier.best)
    others = [point for point in frontier.points if point not in best and not point.bound]
    bounds = [point for point in frontier.points if point.bound]
    axes.scatter(*_coordinates(others), s=22, color=_OTHER, label="measured, not worth their time", zorder=2)
    axes.scatter(*_coordinates(bounds), s=48, marker="x", color=_BOUND, label="if the phase were known", zorder=3)
    axes.step(*_coordinates(best), where="post", color=_PARETO, linewidth=1.6, zorder=3)
    axes.scatter(*_coordinates(best), s=46, color=_PARETO, label="quality levels (Pareto-optimal)", zorder=4)
    default = frontier.default
    axes.scatter(*_coordinates([default]), s=170, facecolors="none", edgecolors=_PARETO, linewidths=1.8, zorder=4)
    axes.set_xscale("log")
    floor = sum(frontier.floor.audible.values()) / len(frontier.floor.audible)
    axes.axhline(floor, color=_FLOOR, linestyle="--", linewidth=1.2, label="the same simulated twice (floor)")
    axes.axvline(frontier.block_ms, color=_DEADLINE, linestyle=":", linewidth=1.4, label="one block of 256 samples")
    for number, point in enumerate(best):
        name = f"{point.level.name} (default)" if point is default else point.level.name
        axes.annotate(
            name,
            (point.cost.ms_p50, point.audible_error),
            xytext=(26, -34 - 15 * number),  # one below the other: close points would write over each other
            textcoords="offset points",
            fontsize=8.5,
            color="#2b3a42",
            arrowprops={"arrowstyle": "-", "color": _OTHER, "linewidth": 0.8},
        )
    low = min(point.cost.ms_p50 for point in frontier.points)
    high = max([*(point.cost.ms_p50 for point in frontier.points), frontier.block_ms])
    axes.set_xlim(low / 1.6, high * 4)
    axes.set_ylim(bottom=0)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set(
        xlabel="milliseconds per binaural response, median, one core", ylabel="mean error, just-noticeable differences"
    )
    measured_on = f"{frontier.pairs} held-out pairs at {frontier.yaws} orientations"
    axes.set_title(f"What accuracy costs in time: {frontier.scene}, {measured_on}", fontsize=12)
    axes.grid(alpha=0.25, which="both")
    axes.legend(frameon=False, fontsize=9)
    figure.savefig(path, dpi=110)


def _coordinates(points: list[Point]) -> tuple[list[float], list[float]]:
    return [point.cost.ms_p50 for point in points], [point.audible_error for point in points]
