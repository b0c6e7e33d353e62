"""The frontier as a picture: audible error over the time per pose."""

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from training.frontier.labels import Label, place_labels
from training.frontier.points import Point
from training.frontier.sweep import Frontier

_PARETO, _OTHER, _FLOOR, _DEADLINE, _BOUND, _TEXT = "#0b6e99", "#aeb9c1", "#8d6a9f", "#d1495b", "#66a182", "#2b3a42"
_SPREAD = "#bfdbe6"


def draw_frontier(frontier: Frontier, path: Path) -> None:
    """Writes a PNG: all points at their mean time, the line of the Pareto-optimal ones with the spread of their times,
    the repeatability floor, and the deadline of a block. The levels that are offered have names."""
    figure = Figure(figsize=(11.5, 6.6), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    best, offered = list(frontier.best), list(frontier.offered)
    others = [point for point in frontier.points if point not in best and not point.bound]
    bounds = [point for point in frontier.points if point.bound]
    axes.scatter(*_coordinates(others), s=20, color=_OTHER, label="measured, not Pareto-optimal", zorder=2)
    axes.scatter(*_coordinates(bounds), s=48, marker="x", color=_BOUND, label="if the phase were known", zorder=3)
    axes.hlines(
        [point.audible_error for point in best],
        [point.cost.ms_p50 for point in best],
        [point.cost.ms_p99 for point in best],
        color=_SPREAD,
        linewidth=3,
        label="from the median pose to the slowest of a hundred",
        zorder=1,
    )
    axes.step(*_coordinates(best), where="post", color=_PARETO, linewidth=1.4, zorder=3)
    axes.scatter(
        *_coordinates(best),
        s=34,
        facecolors="white",
        edgecolors=_PARETO,
        linewidths=1.6,
        label="Pareto-optimal",
        zorder=4,
    )
    axes.scatter(*_coordinates(offered), s=44, color=_PARETO, label="quality level of the bundle", zorder=5)
    axes.scatter(
        *_coordinates([frontier.default]), s=170, facecolors="none", edgecolors=_PARETO, linewidths=1.8, zorder=4
    )
    floor = sum(frontier.floor.audible.values()) / len(frontier.floor.audible)
    axes.axhline(floor, color=_FLOOR, linestyle="--", linewidth=1.2, label="the same simulated twice (floor)")
    axes.axvline(frontier.block_ms, color=_DEADLINE, linestyle=":", linewidth=1.4, label="one block of 256 samples")
    axes.set_xscale("log")
    costs = [time_ms for point in frontier.points for time_ms in (point.cost.ms_p50, point.cost.ms_mean)]
    slowest = [point.cost.ms_p99 for point in best]
    axes.set_xlim(min(costs) / 2, max([*costs, *slowest, frontier.block_ms]) * 2)
    axes.set_ylim(0, 1.12 * max(point.audible_error for point in best))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.set(
        xlabel="milliseconds per pose of a walk, one core; points at the mean",
        ylabel="mean error, just-noticeable differences",
    )
    measured_on = f"{frontier.pairs} held-out pairs at {frontier.yaws} orientations"
    axes.set_title(f"What accuracy costs in time: {frontier.scene}, {measured_on}", fontsize=12)
    axes.grid(alpha=0.25, which="major")
    axes.legend(frameon=False, fontsize=9, loc="lower left")
    place_labels(
        axes,
        [_label(point, is_default=point is frontier.default) for point in offered],
        zip(*_coordinates([*best, *others, *bounds]), strict=True),
        lines_y=[floor],
        colour=_TEXT,
        line_colour=_OTHER,
    )
    figure.savefig(path, dpi=110)


def _label(point: Point, *, is_default: bool) -> Label:
    name = point.level.name
    return Label(point.cost.ms_mean, point.audible_error, f"{name} (default)" if is_default else name)


def _coordinates(points: list[Point]) -> tuple[list[float], list[float]]:
    return [point.cost.ms_mean for point in points], [point.audible_error for point in points]
