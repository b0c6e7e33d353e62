"""`nafir-train plan` and `nafir-train simulate`: the plan of a scene's simulation, and the simulation."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from server.core.command_line import require_at_most_one
from server.core.errors import NafirError
from training.cli.learning import print_findings
from training.cli.options import Cluster, Folder, Seed, progress_bar

if TYPE_CHECKING:
    from training.data.levels.level_scene import LevelScene
    from training.data.scene_file import SceneFile
    from training.data.simulation_plan import SimulationPlan
    from training.simulation.check import PlanCheck
    from training.simulation.pairs import PairSimulation

# Captions are wrapped to the width of their table.
_CHECK_WIDTH = 100
_TAIL_RAYS_TRIED = 2_000

Scene = Annotated[Path, typer.Argument(help="Scene file (TOML), or the folder of an imported level.")]
Effects = Annotated[
    str,
    typer.Option(
        metavar="plan|all|NAME=on|off,...",
        help="What the scene calls for; everything; or what it calls for but for these, as in the scene file's "
        "[effects].",
    ),
]

Workers = Annotated[int, typer.Option(min=0, help="Threads; 0 for one per core.")]


def wide_console(*, stderr: bool = False) -> Console:
    """A console that is as wide as the plan's table where the output is not a terminal."""
    return Console(stderr=stderr, width=None if Console(stderr=stderr).is_terminal else 150)


def simulation_of(scene: Path, seed: int, effects: str, folder: Path) -> "PairSimulation":
    """A prepared simulation, new or as it was begun in `folder`, with a plan that predicts its cost on this host."""
    from training.data.dataset import Dataset
    from training.data.levels.level_scene import is_same_scene
    from training.simulation.cost import is_brief, with_costs
    from training.simulation.run import prepared

    read, decided = _plan_by_size(scene, seed, effects)
    begun = Dataset.open(folder, finished=False) if (folder / "pairs.h5").exists() else None
    if begun is not None and (begun.seed != seed or not is_same_scene(begun.place, read)):
        begun = None  # `simulate` refuses the folder
    simulation = prepared(read, seed=seed, plan=decided, begun=begun)
    return replace(simulation, plan=with_costs(simulation)) if is_brief(read) else simulation


def _plan_by_size(scene: Path, seed: int, effects: str) -> "tuple[SceneFile | LevelScene, SimulationPlan]":
    """The scene and its plan, with a cost that follows from a scene file's numbers alone; that of a level is not
    known."""
    from training.data.levels.level_scene import LevelScene, read_scene
    from training.data.simulation_plan import overrides_among
    from training.simulation.planner import planner_of
    from training.simulation.size import SimulationSize

    named = _parse_effects(effects)
    read = read_scene(scene)
    planner = planner_of(read, seed)
    decided = planner.everything if effects == "all" else planner.plan(overrides_among({**read.effects, **named}))
    cost_s = None if isinstance(read, LevelScene) else 60 * SimulationSize(read).core_minutes
    return read, replace(decided, cost_s=cost_s)


def _parse_effects(effects: str) -> dict[str, bool]:
    from training.data.simulation_plan import SimulatedEffect

    if effects in {"plan", "all"}:
        return {}
    named = {}
    for part in effects.split(","):
        name, _, state = (piece.strip() for piece in part.partition("="))
        if name not in list(SimulatedEffect) or state not in {"on", "off"}:
            known = ", ".join(SimulatedEffect)
            raise typer.BadParameter(f"{part!r}: NAME=on or NAME=off, of {known}", param_hint="--effects")
        if name in named:
            raise NafirError(f"--effects: {name} is there twice: give it once")
        named[name] = state == "on"
    return named


def plan(
    scene: Scene,
    effects: Effects = "plan",
    check: Annotated[
        int | None,
        typer.Option(min=1, help="Simulate so many emitters by the plan and with everything on, and compare."),
    ] = None,
    seed: Seed = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for machines.")] = False,
) -> None:
    """Show what simulating a scene calls for, why, and how long it will take."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from training.simulation.cost import is_brief, with_costs
    from training.simulation.run import prepared

    with wide_console(stderr=True).status("planning"):
        read, planned = _plan_by_size(scene, seed, effects)
    if is_brief(read):
        planned = with_costs(prepared(read, seed=seed, plan=planned, most_tail_rays=_TAIL_RAYS_TRIED))
    checked = None if check is None else _check(scene, planned, check, seed)
    if as_json:
        content = planned.to_json() if checked is None else {"plan": planned.to_json(), "check": checked.to_json()}
        typer.echo(json.dumps(content, indent=2))
        return
    console = wide_console()
    print_plan(console, read, planned, seed)
    if checked is not None:
        console.print(_check_table(checked))


def _check(scene: Path, planned: "SimulationPlan", emitters: int, seed: int) -> "PlanCheck":
    from rich.progress import track

    from training.data.levels.level_scene import read_scene
    from training.simulation.check import check_plan
    from training.simulation.planner import planner_of

    read, console = read_scene(scene), Console(stderr=True)
    return check_plan(
        read,
        planned,
        planner_of(read, seed).everything,
        emitters=emitters,
        seed=seed,
        track=lambda steps: track(steps, "simulating emitters", console=console),
    )


def _check_table(checked: "PlanCheck") -> Table:
    title = f"{checked.pairs} pairs of {checked.emitters} emitters against everything on"
    seconds = (
        f"{checked.plan_s:.1f} s for these emitters and {checked.once_s:.1f} s once, with everything on "
        f"{checked.everything_s:.1f} s: the whole scene {checked.speedup:.1f} times as fast"
    )
    table = Table(title=title, title_justify="left", caption=seconds, caption_justify="left", min_width=_CHECK_WIDTH)
    table.add_column("mean error")
    for column in ("plan", "floor"):
        table.add_column(column, justify="right")
    for name, error in checked.errors.items():
        table.add_row(name, f"{error:.3g}", f"{checked.floor[name]:.3g}")
    return table


def print_plan(console: Console, scene: "SceneFile | LevelScene", plan: "SimulationPlan", seed: int) -> None:
    """Prints the plan as a table, the size of the simulation, and notes on the scene file."""
    from training.data.levels.level_scene import LevelScene
    from training.simulation.size import SimulationSize, level_extent

    console.print(plan_table(plan))
    if isinstance(scene, LevelScene):
        extent = level_extent(scene, len(scene.probe_positions(seed)))
    else:
        extent = f"{SimulationSize(scene).extent} at most"
    console.print(extent, highlight=False)
    for note in plan.notes:
        console.print(f"note: {note}", highlight=False)


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
    if plan.cost_s is None:
        return ""
    measured = any(each.cost_s is not None for each in plan.decisions)
    how = "by short runs of its parts here" if measured else "at most, by its numbers alone"
    return f"about {plan.cost_s:,.0f} s of one core, {how}"


def simulate(
    scene: Scene,
    output: Folder,
    effects: Effects = "plan",
    seed: Seed = 0,
    workers: Workers = 0,
    cluster: Cluster = None,
) -> None:
    """Simulate what a scene calls for, between all pairs of probes. Run again after an interruption to go on."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    require_at_most_one({"--workers": workers > 0, "--cluster": cluster is not None})
    simulate_into(output, scene, effects=effects, seed=seed, workers=workers, cluster=cluster)


def simulate_into(
    output: Path, scene: Path, *, effects: str, seed: int, workers: int, cluster: str | None = None
) -> None:
    """Fills a dataset folder, or goes on where it stopped, and prints the plan and what the dataset holds."""
    from training.data.levels.level_scene import read_scene
    from training.data.scene_file import SceneFile
    from training.parallel.jobs import open_jobs
    from training.simulation.responses import SimulatedResponses
    from training.simulation.run import simulate as simulate_scene

    console = wide_console(stderr=True)
    with console.status("planning, and tracing the late sound that pairs may share"):
        ready = simulation_of(scene, seed, effects, output)
        read = read_scene(scene)
    print_plan(console, read, ready.plan, seed)
    with open_jobs(cluster, threads=workers or os.cpu_count() or 1) as jobs, progress_bar() as progress:
        dataset = simulate_scene(scene, output, seed=seed, jobs=jobs, progress=progress, simulation=ready)
    if isinstance(read, SceneFile):
        print_findings(SimulatedResponses(dataset))
    trained, held_out = (len(dataset.pairs(held_out=held_out)) for held_out in (False, True))
    typer.echo(f"{output}: {trained} pairs to train on and {held_out} held out, {len(dataset.yaws)} orientations each")
