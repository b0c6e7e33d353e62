"""`nafir listening-test` and `nafir listening-results`."""

import importlib.util
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from server.core.command_line import figure_file, writable_file, writable_folder
from server.core.errors import NafirError
from server.listening import options
from server.listening.options import Anchors, Clips, Hidden, Methods, NoScreening, Places, Rating, Seconds, TestSeed

_NEEDED = ("training", "h5py")
"""Modules without which no test can be prepared."""


def listening_test(
    places: Annotated[
        list[Path],
        typer.Argument(
            metavar="TEST | BUNDLE... DATA",
            help="Folder of a listening test; or scene bundles, and last the dataset folder, to make one from.",
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the test that is made.", callback=writable_folder)
    ] = options.FOLDER,
    methods: Methods = None,
    rating: Rating = False,
    at: Places = options.PLACES,
    anchors: Anchors = options.ANCHOR_TRIALS,
    hidden: Hidden = options.HIDDEN_TRIALS,
    clips: Clips = None,
    seconds: Seconds = options.SECONDS,
    no_screening: NoScreening = False,
    seed: TestSeed = 0,
    host: Annotated[str | None, typer.Option(help="Address to listen on. [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on; 0 picks one. [default: 8000]")] = None,
) -> None:
    """Serve a page on which people say by ear which sounds are nearest to the truth.

    With BUNDLE and DATA the test is made first, which needs the training extra; run again, the same test goes on. With
    TEST alone the test of that folder is served. Answers are stored in the folder `results` of the test.
    """
    folder = places[0]
    if len(places) == 1:
        for_making = {"--methods": methods, "--rating": rating, "--clip": clips, "--no-screening": no_screening}
        for option, given in for_making.items():
            if given:
                raise NafirError(f"{option}: is for making a test: give BUNDLE... DATA too, or leave it out")
    else:
        folder = output
        _prepare(
            [str(place) for place in places],
            {
                "--output": str(output),
                "--methods": methods,
                "--at": str(at),
                "--anchors": str(anchors),
                "--hidden": str(hidden),
                "--seconds": str(seconds),
                "--seed": str(seed),
            },
            clips or [],
            [flag for flag, is_set in {"--rating": rating, "--no-screening": no_screening}.items() if is_set],
        )
    _serve(folder, {"host": host, "port": port})


def listening_results(
    test: Annotated[Path, typer.Argument(help="Folder of a listening test.")],
    figure: Annotated[Path | None, typer.Option(help="Draw the results to this PNG.", callback=figure_file)] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Write the results as JSON, too.", callback=writable_file)
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON, for programs.")] = False,
) -> None:
    """Count the answers of a listening test, with confidence intervals, and say whose answers do not count and why."""
    from rich.console import Console

    from server.listening.analysis import analyse
    from server.listening.design import ListeningTest
    from server.listening.figure import draw
    from server.listening.report import report

    results = analyse(ListeningTest.open(test))
    document = results.model_dump_json(indent=2)
    if output is not None:
        output.write_text(document + "\n")
    if figure is not None:
        draw(results, figure)
    if as_json:
        typer.echo(document)
    else:
        console = Console(width=None if Console().is_terminal else 170)
        for part in report(results):
            console.print(part)


def _prepare(places: list[str], values: dict[str, str | None], clips: list[str], flags: list[str]) -> None:
    """Runs `nafir-train listening-test`. The server does not import the training side, which need not be installed.
    Raises NafirError without it, and ends as it ends if it fails."""
    for module in _NEEDED:
        if importlib.util.find_spec(module) is None:
            raise NafirError(
                f"BUNDLE DATA: making a listening test needs {module}: pip install 'nafir[training]'; or make it "
                "elsewhere with nafir-train listening-test, and give its folder in their place"
            )
    given = [part for option, value in values.items() if value is not None for part in (option, value)]
    given += [part for clip in clips for part in ("--clip", clip)]
    done = subprocess.run([sys.executable, "-m", "training", "listening-test", *places, *given, *flags], check=False)
    if done.returncode:
        raise typer.Exit(done.returncode)


def _serve(folder: Path, given: dict[str, str | int | None]) -> None:
    import uvicorn
    from rich.console import Console

    from server.api import serving
    from server.api.listeners import bind, url_of
    from server.api.settings import settings_of
    from server.core.files import require_writable_folder
    from server.listening.app import create_app
    from server.listening.design import ListeningTest
    from server.listening.listeners import Listeners
    from server.runtime.drain import Drain

    test = ListeningTest.open(folder)
    require_writable_folder(test.results, "TEST")
    settings = settings_of(given)
    listeners = bind(settings.host, settings.port)
    drain = Drain(settings.drain_s)
    application = create_app(Listeners(test), settings, drain)
    url = url_of(listeners[0], settings.host)
    asked = "choices" if test.design.kind == "choice" else "ratings"
    announcement = f"[bold]Nafir[/] asks for {asked} in {test.design.name} at [link]{url}[/]; answers: {test.results}"
    # The log of requests would hold addresses and codes together.
    config = uvicorn.Config(application, **serving.uvicorn_options(settings))
    try:
        serving.serve(
            serving.Server(config, drain, on_start=lambda: Console().print(announcement, highlight=False)), listeners
        )
    finally:
        for listener in listeners:
            listener.close()
