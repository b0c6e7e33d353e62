"""The frontier as a table for people."""

from rich.table import Table

from server.acoustics.audibility import THRESHOLDS
from server.acoustics.metrics import PARAMETER_METRICS
from training.frontier.sweep import Frontier

_SHOWN = [metric for metric in PARAMETER_METRICS if metric.name in THRESHOLDS]


def report(frontier: Frontier) -> Table:
    """The quality levels, quickest first, each error in its unit and, in brackets, in JND."""
    table = Table(
        title=f"{frontier.scene}: {len(frontier.best)} of {len(frontier.points)} levels measured are worth their time",
        caption=f"mean errors on {frontier.pairs} held-out pairs at {frontier.yaws} orientations, (JND); * default",
    )
    table.add_column("level")
    for heading in ("p50 ms", "p99 ms", "memory MB", "storage MB"):
        table.add_column(heading, justify="right")
    for metric in _SHOWN:
        table.add_column(f"{metric.label} {metric.unit}".strip(), justify="right")
    table.add_column("mean JND", justify="right")
    for point in frontier.best:
        cost = point.cost
        costs = [f"{value:.3g}" for value in (cost.ms_p50, cost.ms_p99, cost.memory_mb, cost.storage_mb)]
        errors = [_cell(point.accuracy.errors, point.audible, metric.name) for metric in _SHOWN]
        name = point.level.name + ("*" if point is frontier.default else "")
        table.add_row(name, *costs, *errors, f"{point.audible_error:.3g}")
    floor = frontier.floor
    mean = sum(floor.audible.values()) / len(floor.audible)
    errors = [_cell(floor.errors, floor.audible, metric.name) for metric in _SHOWN]
    table.add_row("[dim]floor[/dim]", "", "", "", "", *errors, f"{mean:.3g}")
    return table


def _cell(errors: dict[str, float], audible: "dict[str, float]", name: str) -> str:
    return f"{errors[name]:.3g} ({audible[name]:.2g})" if name in errors else "none"
