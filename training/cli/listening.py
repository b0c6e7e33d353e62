"""`nafir-train listening-test`."""

import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from server.core.command_line import writable_folder
from server.listening import options
from server.listening.options import Anchors, Clips, Hidden, Methods, NoScreening, Places, Rating, Seconds, TestSeed


def listening_test(
    places: Annotated[
        list[Path],
        typer.Argument(metavar="BUNDLE... DATA", help="Scene bundles, and last the dataset folder."),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of the test.", callback=writable_folder)
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
) -> None:
    """Make a listening test: music at held-out places through every method, equally loud. `nafir listening-test` serves
    it."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from rich.progress import track

    from server.scene.bundle import Bundle
    from training.listening.music import DEFAULT_CLIPS
    from training.listening.prepare import Options, prepare

    if len(places) < 2:
        raise typer.BadParameter("takes scene bundles, and last the dataset folder", param_hint="BUNDLE... DATA")
    console = Console(stderr=True)
    asked = Options(
        methods=None if methods is None else tuple(name.strip() for name in methods.split(",") if name.strip()),
        rating=rating,
        places=at,
        anchors=anchors,
        hidden=hidden,
        clips=tuple(clips) if clips else DEFAULT_CLIPS,
        seconds=seconds,
        screening=not no_screening,
        seed=seed,
    )
    test, is_known = prepare(
        [Bundle.load(place) for place in places[:-1]],
        places[-1],
        output,
        asked,
        track=lambda steps, doing: track(steps, doing, console=console),
    )
    design = test.design
    questions = sum(trial.part != "practice" for trial in design.trials)
    state = "is this test already" if is_known else "is made"
    typer.echo(
        f"{output}: {state}: {questions} questions to each listener about {', '.join(design.rated)}; "
        f"{design.samples / design.sample_rate:.1f} s each at {design.loudness_lufs:.1f} LUFS"
    )
