"""`nafir check`."""

import json
from pathlib import Path
from typing import Annotated

import typer

from server.core.command_line import figure_file


def check(
    scene: Annotated[str, typer.Argument(help="Id of a bundled scene, or the folder of any scene bundle.")],
    figure: Annotated[
        Path | None, typer.Option(help="Draw what was measured to this PNG (needs matplotlib).", callback=figure_file)
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the poses that are tried.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """Check the numerical health of a scene bundle at its corners, all over it and at the worst poses that a search
    finds.

    The exit code is 1 if a law is broken, unless the scene was exported with a reason to accept that. Slow fields are
    checked at fewer poses, for about 15 seconds each.
    """
    from rich.console import Console
    from rich.progress import track

    from server.health.check import check as check_bundle
    from server.health.report import reasons, table, to_json
    from server.scene.bundle import Bundle, find_bundle

    bundle = Bundle.load(find_bundle(scene))
    console = Console(stderr=True)
    health = check_bundle(
        bundle,
        seed=seed,
        track=lambda names: track(names, "checking", console=console, transient=True, disable=as_json),
    )
    if figure is not None:
        from server.health.figure import draw

        draw(health, bundle, figure)
    if as_json:
        typer.echo(json.dumps(to_json(health), indent=2))
    else:
        terminal = Console()
        printer = terminal if terminal.is_terminal else Console(width=170)
        printer.print(table(health))
        for reason in reasons(health):
            printer.print(f"  {reason}", highlight=False)
    if health.broken:
        raise typer.Exit(1)
