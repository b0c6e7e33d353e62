"""`nafir-train train` and `nafir-train ablate`: a field, and the factors that its errors depend on."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from server.core.command_line import require_at_most_one
from server.core.errors import NafirError
from training.cli.options import Cluster, Folder, Json, Seed, progress_bar

if TYPE_CHECKING:
    from training.data.responses import ResponseSet
    from training.learning.runs import Configuration

Epochs = Annotated[int | None, typer.Option(min=1, help="Passes over the training set.")]
Minutes = Annotated[float | None, typer.Option(min=0.001, help="Time to train for, in place of epochs.")]


def train(
    data: Annotated[Path, typer.Argument(help="Dataset folder from simulate or import.")],
    output: Folder,
    field: Annotated[
        str, typer.Option(help="factorised, directional, naf, naf-whole, naf-dual, naf-no-grid or naf-time-domain.")
    ] = "factorised",
    rank: Annotated[
        int | None,
        typer.Option(min=16, max=256, help="Size of the field's basis, if it has one; 128 if not given."),
    ] = None,
    width: Annotated[
        int | None,
        typer.Option(min=32, max=4096, help="Width of a field with a basis; 256 if not given."),
    ] = None,
    order: Annotated[
        int | None,
        typer.Option(min=0, max=3, help="Order of a directional field's spherical harmonics; 2 if not given."),
    ] = None,
    seed: Seed = 0,
    epochs: Epochs = None,
    minutes: Minutes = None,
    as_long_as: Annotated[
        Path | None, typer.Option(help="Finished run: train for the time that it took, its targets included.")
    ] = None,
    share: Annotated[float, typer.Option(min=0.001, max=1, help="Share of the training pairs to use.")] = 1.0,
    patience: Annotated[
        int | None,
        typer.Option(min=1, help="Stop after so many rounds (epochs, or twentieths of the time) without progress."),
    ] = None,
    learning_rate: Annotated[float | None, typer.Option(min=1e-7, help="The field's own if not given.")] = None,
    points: Annotated[
        int | None,
        typer.Option(min=1, help="Points of each response that a naf trains on per step; 2000 if not given."),
    ] = None,
    teacher: Annotated[
        Path | None, typer.Option(help="Run folder of a naf on the same data, for a factorised field to learn from.")
    ] = None,
    cluster: Cluster = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="Processes on the cluster, of a core each; 2 if not given.")
    ] = None,
) -> None:
    """Train a field on a dataset. Run again after an interruption to go on; with torchrun, in several processes."""
    # Targets need many small matrix products, where threads of OpenBLAS wait for each other. Torch has its own threads.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from training.learning.runs import configure, minutes_of

    if workers is not None and cluster is None:
        raise NafirError("--workers: are processes on a cluster: name it by --cluster")
    lengths = {"--epochs": epochs, "--minutes": minutes, "--as-long-as": as_long_as}
    require_at_most_one({option: value is not None for option, value in lengths.items()})
    if as_long_as is not None:
        minutes = minutes_of(as_long_as)
    given = {"epochs": epochs, "minutes": minutes, "patience": patience, "learning_rate": learning_rate}
    configuration = configure(
        field,
        rank=rank,
        width=width,
        order=order,
        points=points,
        teacher=teacher,
        seed=seed,
        share=share,
        **{name: value for name, value in given.items() if value is not None},
    )
    train_into(output, data, configuration, cluster=cluster, workers=workers)


def train_into(
    output: Path,
    data: Path,
    configuration: "Configuration",
    *,
    cluster: str | None = None,
    workers: int | None = None,
) -> None:
    """Trains a field, or goes on where its training stopped, and prints what is known of its data."""
    from training.learning.train import train as train_field
    from training.simulation.responses import open_responses

    responses = open_responses(data)
    if os.environ.get("RANK", "0") == "0":
        print_findings(responses)
    if cluster is None:
        with progress_bar() as progress:
            train_field(responses, output, configuration, progress)
    else:
        from training.learning.on_cluster import train_on_cluster

        with Console(stderr=True).status("training on the cluster"):
            train_on_cluster(cluster, data, output, configuration, workers=workers or 2)
    typer.echo(f"{output}: {configuration.name} is trained")


def print_findings(responses: "ResponseSet") -> None:
    """Prints what training may want to know about a dataset."""
    from training.bundling.data_reference import health_of
    from training.simulation.responses import SimulatedResponses

    rays = responses.dataset.effects.rays if isinstance(responses, SimulatedResponses) else None
    for line in health_of(responses).lines(rays):
        typer.echo(f"{responses.file.parent}: {line}", err=True)


def ablate(
    data: Annotated[Path, typer.Argument(help="Dataset folder from simulate or import.")],
    output: Folder,
    rank: Annotated[int, typer.Option(min=16, max=256, help="Size of the basis.")] = 128,
    epochs: Annotated[int, typer.Option(min=1, help="Passes over the training set, of every run.")] = 14,
    teacher: Annotated[Path | None, typer.Option(help="Run folder of a naf on the same data, to learn from.")] = None,
    seed: Seed = 0,
    cluster: Cluster = None,
    as_json: Json = False,
) -> None:
    """Train the factorised field once per factor and compare errors on the held-out pairs. Run again to go on."""
    from dataclasses import asdict

    from training.evaluation.ablation import ablate as ablate_factors
    from training.evaluation.ablation import table, variants
    from training.learning.runs import configure
    from training.parallel.jobs import open_jobs
    from training.simulation.responses import open_responses

    responses = open_responses(data)
    configurations = variants(configure("factorised", rank=rank, epochs=epochs, seed=seed), responses, teacher)
    with open_jobs(cluster, threads=1) as jobs, progress_bar() as progress:
        rows = ablate_factors(responses, output, configurations, progress, jobs=jobs)
    if as_json:
        typer.echo(json.dumps([asdict(row) for row in rows], indent=2))
        return
    for line in table(rows):
        typer.echo("".join(column.ljust(24 if number == 0 else 15) for number, column in enumerate(line)).rstrip())
