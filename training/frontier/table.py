"""The frontier as a table for the terminal."""

from collections.abc import Mapping

from rich.table import Table

from server.acoustics.audibility import THRESHOLDS
from server.acoustics.metrics import PARAMETER_METRICS
from training.frontier.sweep import Frontier

_COSTS = ("mean ms", "p50 ms", "p99 ms", "miss ms", "turn ms", "block us", "memory MB")
_SHOWN = [metric for metric in PARAMETER_METRICS if metric.name in THRESHOLDS]


def report(frontier: Frontier) -> Table:
    """The Pareto-optimal quality levels, quickest first, with each error in its unit and, in brackets, in JND."""
    table = Table(
        title=f"{frontier.scene}: {len(frontier.best)} of {len(frontier.points)} levels measured are worth their time",
        caption=(
            f"mean errors on {frontier.pairs} held-out pairs, by which no level was chosen, "
            f"at {frontier.yaws} orientations, (JND); "
            "milliseconds per pose of a walk, and where the head only turned; microseconds per block of each of four "
            "emitters; largest step between poses 1 cm apart; + offered, * default"
        ),
    )
    table.add_column("level")
    for heading in _COSTS:
        table.add_column(heading, justify="right")
    for metric in _SHOWN:
        table.add_column(f"{metric.label} {metric.unit}".strip(), justify="right")
    table.add_column("mean JND", justify="right")
    table.add_column("step JND", justify="right")
    for point in frontier.best:
        cost = point.cost
        times = (cost.ms_mean, cost.ms_p50, cost.ms_p99, cost.ms_miss, cost.ms_turn, cost.block_us)
        costs = ["none" if value is None else f"{value:.3g}" for value in (*times, cost.memory_mb)]
        errors = [_cell(point.accuracy.errors, point.audible, metric.name) for metric in _SHOWN]
        mark = "*" if point is frontier.default else "+" if point in frontier.offered else ""
        steps = point.accuracy.steps
        largest = f"{max(steps.values()):.2g} {max(steps, key=steps.__getitem__)}" if steps else "none"
        table.add_row(point.level.name + mark, *costs, *errors, f"{point.audible_error:.3g}", largest)
    floor = frontier.floor
    mean = sum(floor.audible.values()) / len(floor.audible)
    errors = [_cell(floor.errors, floor.audible, metric.name) for metric in _SHOWN]
    table.add_row("[dim]floor[/dim]", *[""] * len(_COSTS), *errors, f"{mean:.3g}", "")
    return table


def _cell(errors: Mapping[str, float], audible: Mapping[str, float], name: str) -> str:
    return f"{errors[name]:.3g} ({audible[name]:.2g})" if name in errors else "none"
