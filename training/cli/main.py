"""`nafir-train`: simulate, train, export, evaluate."""

import json
import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from server.core.command_line import StrictTyper, writable_folder
from server.core.errors import NafirError
from server.core.files import require_matplotlib, require_writable
from training.cli import benchmarking, learning, watching
from training.cli import evaluating as evaluation
from training.cli import simulating as simulation
from training.cli.baking import bake
from training.cli.exporting import export
from training.cli.importing import importing
from training.cli.importing_levels import bundle_level, import_level
from training.cli.listening import listening_test
from training.cli.options import Cluster, Json, Seed
from training.cli.options import progress_bar as _progress

app = StrictTyper(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
app.add_typer(importing, name="import")
app.command()(bake)
app.command()(import_level)
app.command()(bundle_level)
app.command()(simulation.plan)
app.command()(listening_test)
app.command()(simulation.simulate)
app.command()(learning.train)
app.command()(learning.ablate)
app.command()(export)

for command in (
    evaluation.evaluate,
    evaluation.tabulate,
    evaluation.maps,
    evaluation.spectrograms,
    evaluation.probe,
    evaluation.probe_emitters,
    evaluation.fractions,
    watching.draw_views,
    watching.cross_modal,
):
    app.command()(command)
app.command()(benchmarking.benchmark)
app.command()(benchmarking.predict)


@app.command()
def frontier(
    bundle: Annotated[Path, typer.Argument(help="Scene bundle; its fields are swept.")],
    data: Annotated[Path, typer.Argument(help="Dataset folder the bundle's fields were trained on.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for frontier.json and frontier.png.", callback=writable_folder),
    ],
    pairs: Annotated[
        int, typer.Option(min=4, help="Held-out pairs to measure: half to choose levels, half to report errors.")
    ] = 80,
    yaws: Annotated[int, typer.Option(min=1, help="Head orientations of each.")] = 3,
    walk_s: Annotated[float, typer.Option(min=10, help="Seconds of the walk that costs are measured on.")] = 300.0,
    phases_of: Annotated[list[str] | None, typer.Option(help="Fields to sweep over phases; all, or none.")] = None,
    reuse_of: Annotated[list[str] | None, typer.Option(help="Fields to sweep over reuse of responses.")] = None,
    default_ms: Annotated[float, typer.Option(help="A response of the default level takes no longer.")] = 2.5,
    record: Annotated[bool, typer.Option(help="Write a few of the Pareto-optimal levels into the bundle.")] = False,
    seed: Seed = 0,
    cluster: Cluster = None,
    as_json: Json = False,
) -> None:
    """Measure accuracy against time for everything a bundle could offer. Run again after an interruption to go on."""
    from server.scene.bundle import MANIFEST_FILE, Bundle
    from training.data.dataset import Dataset
    from training.frontier.candidates import candidates
    from training.frontier.figure import draw_frontier
    from training.frontier.sweep import Effort, sweep
    from training.frontier.sweep import record as record_frontier
    from training.frontier.table import report
    from training.parallel.jobs import open_jobs

    require_matplotlib("--output")
    if record:
        require_writable(bundle / MANIFEST_FILE, "--record")
    loaded = Bundle.load(bundle)
    effort = Effort(pairs=pairs, yaws=yaws, walk_s=walk_s, default_ms=default_ms, seed=seed)
    levels = candidates(loaded, phases_of, reuse_of or ())
    with open_jobs(cluster, threads=os.cpu_count() or 1) as jobs, _progress() as progress:
        measured = sweep(loaded, Dataset.open(data), levels, output, effort, progress, jobs=jobs)
    (output / "frontier.json").write_text(json.dumps(measured.to_json(), indent=2) + "\n")
    draw_frontier(measured, output / "frontier.png")
    if record:
        record_frontier(loaded, measured, bundle)
    if as_json:
        typer.echo(json.dumps(measured.to_json(), indent=2))
    else:
        Console(width=None if Console().is_terminal else 170).print(report(measured))


def main() -> None:
    """Entry point of the console script. Nafir's own errors, and those of files, become one line and exit code 2."""
    try:
        app()
    except NafirError as exc:
        typer.echo(f"nafir-train: {exc}", err=True)
        raise SystemExit(2) from exc
    except OSError as exc:
        # Folders that cannot be written, full disks. HDF5 writes its own messages and sets no `strerror`.
        place = "" if exc.filename is None else f"{exc.filename}: "
        typer.echo(f"nafir-train: {place}{exc.strerror or exc}", err=True)
        raise SystemExit(2) from exc
    except ModuleNotFoundError as exc:
        typer.echo(
            f"nafir-train: {exc.name} is missing; install the training extra: pip install 'nafir[training]'", err=True
        )
        raise SystemExit(2) from exc
