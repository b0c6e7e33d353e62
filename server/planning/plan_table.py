"""A plan of effects as a table for a terminal."""

from rich.console import Console
from rich.table import Table

from server.planning.plan_query import Decided, PlanDocument


def print_plan(plan: PlanDocument, console: Console | None = None) -> None:
    """Print one row per effect and emitter; emitters with the same decision share a row."""
    console = console or Console()
    emitters = list(dict.fromkeys(each.emitter for each in plan.decisions if each.emitter is not None))
    table = Table(title=f"Effects that {plan.scene} calls for", title_justify="left")
    if len(emitters) > 1:
        table.add_column("emitter")
    for heading in ("name", "called_for"):
        table.add_column(heading, no_wrap=True)
    for heading in ("change_jnd", "cost_us"):
        table.add_column(heading, justify="right")
    table.add_column("reason")
    for group in _alike(plan.decisions):
        first = group[0]
        whose = [] if len(emitters) < 2 else ["all" if len(group) == len(emitters) else _names(group)]
        state = ("on" if first.called_for else "off") + (" (asked for)" if first.overridden else "")
        cost = "" if first.cost_us is None else f"{sum(each.cost_us or 0 for each in group):.1f}"
        jnd = f"{max(each.change_jnd for each in group):.2f}"
        style = "bold" if first.called_for else "dim"
        table.add_row(*whose, first.name.value, state, jnd, cost, first.reason, style=style)
    console.print(table)
    console.print(f"{plan.cost_us:.1f} us per block of what is on; {plan.saved_us:.1f} us saved", highlight=False)


def _alike(decisions: tuple[Decided, ...]) -> list[list[Decided]]:
    """Group the decisions of several emitters that agree, in the order of the decisions."""
    groups: dict[tuple[object, ...], list[Decided]] = {}
    for each in decisions:
        groups.setdefault((each.name, each.called_for, each.overridden, each.reason), []).append(each)
    return list(groups.values())


def _names(group: list[Decided]) -> str:
    return "all" if group[0].emitter is None else ", ".join(str(each.emitter) for each in group)
