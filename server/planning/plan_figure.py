"""A plan of effects as a picture: the change without each effect, beside the threshold of hearing it, and its cost."""

from pathlib import Path
from typing import TYPE_CHECKING

from server.core.errors import NafirError
from server.planning.plan_query import Decided, PlanDocument

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ON, _OFF, _ASKED = "#0b6e99", "#b9c2c8", "#d1495b"
_LEAST_JND, _MOST_JND = 0.02, 150.0


def draw(plan: PlanDocument, path: Path) -> None:
    """Write a PNG or SVG, by the suffix.

    Raises NafirError if matplotlib is not installed; the server does not depend on it.
    """
    try:
        figure = figure_of(plan)
    except ImportError as exc:
        raise NafirError("figure: needs matplotlib; pip install matplotlib, or leave --figure out") from exc
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as exc:
        raise NafirError(f"{path}: {exc}") from exc


def figure_of(plan: PlanDocument) -> "Figure":
    """Draw the plan. For each effect, the emitter for which it changes most is drawn. Raises ImportError without
    matplotlib."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = _rows(plan)
    figure = Figure(figsize=(10.5, 0.36 * len(rows) + 1.3), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    change, cost = figure.subplots(1, 2, sharey=True, width_ratios=(2, 1))
    figure.suptitle(f"What {plan.scene} calls for: {plan.cost_us:.1f} us per block on, {plan.saved_us:.1f} us saved")
    _draw_changes(change, rows)
    _draw_costs(cost, rows, plan)
    return figure


def _rows(plan: PlanDocument) -> list[Decided]:
    """Return one decision per effect, with the smallest change first."""
    most: dict[str, Decided] = {}
    for each in plan.decisions:
        if each.name not in most or each.change_jnd > most[each.name].change_jnd:
            most[each.name] = each
    return sorted(most.values(), key=lambda each: each.change_jnd)


def _colour(each: Decided) -> str:
    return _ASKED if each.overridden else _ON if each.called_for else _OFF


def _draw_changes(axes: "Axes", rows: list[Decided]) -> None:
    for at, each in enumerate(rows):
        wide = max(each.change_jnd, _LEAST_JND)
        axes.barh(at, wide - _LEAST_JND, left=_LEAST_JND, color=_colour(each))
        said = (
            f"{float(f'{each.change_jnd:.2g}'):g} JND, {each.parameter}" if each.change_jnd >= _LEAST_JND else "nothing"
        )
        inside = wide > 3
        axes.annotate(
            said,
            (wide, at),
            xytext=(-5 if inside else 5, 0),
            textcoords="offset points",
            va="center",
            ha="right" if inside else "left",
            fontsize=8,
            color="white" if inside and each.called_for else "#222222",
        )
    axes.axvline(1.0, color="#222222", linewidth=1)
    axes.set(xscale="log", xlim=(_LEAST_JND, _MOST_JND), xlabel="change without it (just-noticeable differences)")
    axes.set_yticks(range(len(rows)), [each.title for each in rows])
    axes.grid(axis="x", alpha=0.25)


def _draw_costs(axes: "Axes", rows: list[Decided], plan: PlanDocument) -> None:
    for at, each in enumerate(rows):
        costs = [other.cost_us or 0.0 for other in plan.decisions if other.name == each.name]
        axes.barh(at, sum(costs), color=_colour(each))
        axes.annotate(
            f"{sum(costs):.1f}", (sum(costs), at), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8
        )
    axes.set(xscale="symlog", xlabel="us per block; grey: saved")
    axes.margins(x=0.25)
    axes.grid(axis="x", alpha=0.25)
