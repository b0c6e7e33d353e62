"""`nafir-train`: simulate, train, export, evaluate."""

import json
import logging
import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from server.errors import NafirError

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)

Folder = Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]
Seed = Annotated[int, typer.Option(min=0, help="The same seed gives the same result.")]


def _progress() -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=Console(stderr=True))


@app.command()
def simulate(
    scene: Annotated[Path, typer.Argument(help="Scene file (TOML).")],
    output: Folder,
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(min=0, help="Processes; 0 for one per core.")] = 0,
) -> None:
    """Simulate all pairs of probes of a scene. Run again after an interruption to go on."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from training.simulation.run import simulate as simulate_scene

    with _progress() as progress:
        dataset = simulate_scene(scene, output, seed=seed, workers=workers or os.cpu_count() or 1, progress=progress)
    trained, held_out = (len(dataset.pairs(held_out=held_out)) for held_out in (False, True))
    typer.echo(f"{output}: {trained} pairs to train on and {held_out} held out, {len(dataset.yaws)} orientations each")


@app.command()
def train(
    data: Annotated[Path, typer.Argument(help="Dataset folder from simulate.")],
    output: Folder,
    seed: Seed = 0,
    epochs: Annotated[int | None, typer.Option(min=1, help="Passes over the training set.")] = None,
) -> None:
    """Train a field on a dataset. Run again after an interruption to go on."""
    from dataclasses import replace

    from training.dataset import Dataset
    from training.train import Configuration
    from training.train import train as train_field

    configuration = replace(Configuration(seed=seed), **({} if epochs is None else {"epochs": epochs}))
    with _progress() as progress:
        train_field(Dataset.open(data), output, configuration, progress)
    typer.echo(f"{output}: trained for {configuration.epochs} epochs")


@app.command()
def export(
    run: Annotated[Path, typer.Argument(help="Run folder from train.")],
    output: Folder,
    data: Annotated[Path | None, typer.Option(help="Dataset folder, if it has moved since training.")] = None,
) -> None:
    """Write the scene bundle of a finished run, after checking the graph against torch."""
    from training.dataset import Dataset
    from training.export import export as export_bundle
    from training.train import dataset_folder

    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    bundle = export_bundle(Dataset.open(data or dataset_folder(run)), run, output)
    size = sum(path.stat().st_size for path in output.iterdir())
    typer.echo(f"{output}: scene {bundle.id}, {size / 1e6:.1f} MB, digest {bundle.digest[:12]}")


@app.command()
def evaluate(
    bundle: Annotated[Path, typer.Argument(help="Scene bundle.")],
    data: Annotated[Path, typer.Argument(help="Dataset folder the bundle's field was trained on.")],
    figure: Annotated[Path | None, typer.Option(help="Draw decays and errors to this PNG.")] = None,
    record: Annotated[bool, typer.Option(help="Write the measured errors into the bundle.")] = False,
    as_json: Json = False,
) -> None:
    """Errors on the held-out pairs beside the baselines and the repeatability floor."""
    from rich.progress import track

    from server.scene.bundle import Bundle
    from training.dataset import Dataset
    from training.evaluation.evaluate import report
    from training.evaluation.held_out import evaluate_bundle, record_accuracy

    console = Console(stderr=True)
    loaded = Bundle.load(bundle)
    evaluation = evaluate_bundle(
        loaded, Dataset.open(data), figure=figure, track=lambda pairs: track(pairs, "evaluating", console=console)
    )
    if record:
        record_accuracy(loaded, evaluation)
    if as_json:
        typer.echo(json.dumps(evaluation.to_json(), indent=2))
    else:
        Console(width=None if console.is_terminal else 140).print(report(evaluation))


def main() -> None:
    """Entry point of the console script: Nafir's own errors, and those of files, become one line and exit code 2."""
    try:
        app()
    except NafirError as exc:
        typer.echo(f"nafir-train: {exc}", err=True)
        raise SystemExit(2) from exc
    except OSError as exc:
        # Folders that cannot be written, full disks; HDF5 words these itself and has no `strerror`.
        place = "" if exc.filename is None else f"{exc.filename}: "
        typer.echo(f"nafir-train: {place}{exc.strerror or exc}", err=True)
        raise SystemExit(2) from exc
    except ModuleNotFoundError as exc:
        typer.echo(
            f"nafir-train: {exc.name} is missing; install the training extra: pip install 'nafir[training]'", err=True
        )
        raise SystemExit(2) from exc
