"""Options that several commands of `nafir-train` have, and their progress bar."""

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from server.core.command_line import writable_folder

Folder = Annotated[Path, typer.Option("--output", "-o", help="Folder to write.", callback=writable_folder)]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for machines.")]
Seed = Annotated[int, typer.Option(min=0, help="The same seed gives the same result.")]
FirstSeed = Annotated[
    int, typer.Option(min=0, help="First of the seeds: several processes may have some each, in folders of their own.")
]

Cluster = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Run on the nodes of a Ray cluster: HOST:PORT, or auto on one of them. Needs the extra cluster.",
    ),
]


def progress_bar() -> Progress:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    # Of the processes that torchrun starts, only the first shows progress.
    return Progress(*columns, console=Console(stderr=True), disable=os.environ.get("RANK", "0") != "0")
