"""`nafir soak`."""

from typing import Annotated

import typer


def soak(
    scene: Annotated[str, typer.Argument(help="Id of a bundled scene.")] = "apartment",
    minutes: Annotated[
        float, typer.Option(min=0.1, help="Length of the run; memory is judged from 12 minutes on.")
    ] = 30.0,
    clients: Annotated[int, typer.Option(min=1, max=32, help="Hostile clients at any time.")] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the clients' actions.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """Run a server for a long time with clients that misbehave, and check that it keeps working.

    Meanwhile a listener at rest compares every sample with an offline render in double precision. The exit code is 1 if
    any requirement is not met; standard error says which and why.
    """
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    from server.bench.report import Judgement, end_with, missed, print_json, print_judgements, print_measures
    from server.soak.run import Plan
    from server.soak.run import soak as run

    columns = TextColumn("soaking"), BarColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True, disable=as_json) as progress:
        task = progress.add_task("", total=1.0)
        measured = run(Plan(scene, 60 * minutes, clients, seed), lambda share: progress.update(task, completed=share))
    judgements = [Judgement(**row) for row in measured["summary"]]
    if as_json:
        print_json(measured)
    else:
        print_measures(
            f"{minutes:g} minutes of {scene}", {name: value for name, value in measured.items() if name != "summary"}
        )
        print_judgements("What has to hold", judgements)
    end_with(missed(judgements))
