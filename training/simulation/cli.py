"""`nafir-train simulate` and `nafir-train plan`: what a scene's simulation calls for, and that simulation."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from training.simulation.plan import SimulationPlan

Scene = Annotated[Path, typer.Argument(help="Scene file (TOML).")]
Effects = Annotated[
    str,
    typer.Option(
        metavar="plan|all|NAME=on|off,...",
        help="What the scene calls for; everything; or what it calls for but for these, as in the scene file's "
        "[effects].",
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="The same seed gives the same result.")]


def plan_of(scene: Path, seed: int, effects: str) -> "SimulationPlan":
    """With its costs on this host."""
    import numpy as np

    from training.scene_file import SceneFile
    from training.simulation.cost import SimulationCost
    from training.simulation.plan import overrides_among
    from training.simulation.planner import planner_of

    read = SceneFile.read(scene)
    planner = planner_of(read, seed)
    if effects == "all":
        plan = planner.everything
    else:
        plan = planner.plan(overrides_among({**read.effects, **_named(effects)}))
    yaws = 2 * np.pi * np.arange(read.simulation.yaws) / read.simulation.yaws
    return SimulationCost(read, read.probe_positions(seed), yaws).with_costs(plan)


def _named(effects: str) -> dict[str, bool]:
    from training.simulation.plan import SimulatedEffect

    if effects == "plan":
        return {}
    named = {}
    for part in effects.split(","):
        name, _, state = (piece.strip() for piece in part.partition("="))
        if name not in list(SimulatedEffect) or state not in {"on", "off"}:
            known = ", ".join(SimulatedEffect)
            raise typer.BadParameter(f"{part!r}: NAME=on or NAME=off, of {known}", param_hint="--effects")
        named[name] = state == "on"
    return named


def plan(
    scene: Scene,
    effects: Effects = "plan",
    seed: Seed = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines.")] = False,
) -> None:
    """What simulating a scene calls for, why, and what it will take; nothing is simulated."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    planned = plan_of(scene, seed, effects)
    if as_json:
        typer.echo(json.dumps(planned.to_json(), indent=2))
    else:
        console = Console()
        Console(width=None if console.is_terminal else 150).print(plan_table(planned))


def plan_table(plan: "SimulationPlan") -> Table:
    table = Table(title=_summary(plan), title_justify="left", caption=_caption(plan), caption_justify="left")
    for column, justify in (("effect", "left"), ("", "left"), ("JND", "right"), ("of", "left"), ("s", "right")):
        table.add_column(column, justify="right" if justify == "right" else "left", no_wrap=True)
    table.add_column("why")
    for each in plan.decisions:
        state = ("on" if each.called_for else "off") + (" (as asked)" if each.overridden else "")
        cost = "" if each.cost_s is None else f"{each.cost_s:.0f}"
        change = f"{each.change_jnd:.2f}"
        table.add_row(each.name.replace("_", " "), state, change, each.parameter, cost, each.reason)
    return table


def _summary(plan: "SimulationPlan") -> str:
    parts = [f"images of up to {plan.image_order} surfaces", f"{plan.rays} rays per emitter"]
    if plan.tail_start_s is not None:
        parts.append(f"one tail for all from {1e3 * plan.tail_start_s:.0f} ms on, of {plan.tail_rays} rays")
    return "; ".join(parts)


def _caption(plan: "SimulationPlan") -> str:
    return "" if plan.cost_s is None else f"about {plan.cost_s:.0f} s of one core, by short runs of its parts here"
