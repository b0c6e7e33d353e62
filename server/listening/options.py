"""What a listening test is prepared from, by name: the options that `nafir listening-test` hands on to `nafir-train
listening-test`."""

from pathlib import Path
from typing import Annotated, Final

import typer

PLACES: Final = 10
SECONDS: Final = 4.0
ANCHOR_TRIALS: Final = 6
HIDDEN_TRIALS: Final = 2
FOLDER: Final = Path("listening-test")

Methods = Annotated[
    str | None,
    typer.Option(
        help="Quality levels, fields, baselines and reference, separated by commas. [default: the default level and "
        "aac-nearest; with --rating, all levels of the bundle]",
        metavar="NAME,...",
    ),
]
Rating = Annotated[
    bool, typer.Option("--rating", help="Ask for ratings from 0 to 100 (after ITU-R BS.1534), not for choices.")
]
Places = Annotated[int, typer.Option(min=1, max=40, help="Held-out places that each comparison is heard at.")]
Anchors = Annotated[
    int, typer.Option(min=0, max=50, help="Choices between the truth and an anchor, which tell who listens.")
]
Hidden = Annotated[int, typer.Option(min=0, max=50, help="Choices between each method and the truth itself.")]
Clips = Annotated[
    list[str] | None,
    typer.Option("--clip", help="Name of a clip or an audio file; repeatable. [default: trumpet]", metavar="CLIP"),
]
Seconds = Annotated[float, typer.Option(min=1, max=30, help="Length of the music in each sound.")]
NoScreening = Annotated[bool, typer.Option("--no-screening", help="Do not ask for headphones.")]
TestSeed = Annotated[int, typer.Option(min=0, help="The same seed draws the same places, and the same for listeners.")]
