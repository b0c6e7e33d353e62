"""`nafir-train benchmark` and `predict`: scores of anybody's responses, and responses of ours in the same form."""

import csv
import json
import os
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from server.core.command_line import require_at_most_one, writable_file, writable_folder
from server.core.errors import NafirError
from server.scene.limits import HIGHEST_RATE_HZ, LOWEST_RATE_HZ
from training.cli.options import Json

if TYPE_CHECKING:
    from training.evaluation.benchmark_data import BenchmarkData


class Format(StrEnum):
    """The form of a written prediction."""

    WAV = "wav"
    NPY = "npy"


LayoutName = Annotated[
    str,
    typer.Option(help="soundspaces, raf, meshrir, acousticrooms or nafir; recognised from the folder if not given."),
]
SplitName = Annotated[
    str,
    typer.Option(
        metavar="SPLIT",
        help="File of a published split, or hashed, unseen (AcousticRooms) or folders (MeshRIR); the dataset's own, or "
        "else the layout's, if not given.",
    ),
]
Points = Annotated[Path | None, typer.Option(help="points.txt of SoundSpaces, where it is not in the scene's folder.")]
SourceRate = Annotated[
    int, typer.Option(min=4_000, max=768_000, help="Rate of MeshRIR's arrays, which do not tell it.")
]


def benchmark(
    dataset: Annotated[
        Path | None, typer.Argument(help="Folder of SoundSpaces, RAF, MeshRIR, AcousticRooms, or of nafir-train.")
    ] = None,
    predictions: Annotated[
        Path | None, typer.Option(help="Folder with a WAV or NumPy file for each test response, named like it.")
    ] = None,
    layout: LayoutName = "",
    split: SplitName = "",
    points: Points = None,
    source_rate: SourceRate = 48_000,
    predictions_rate: Annotated[
        int | None,
        typer.Option(
            min=LOWEST_RATE_HZ, max=HIGHEST_RATE_HZ, help="Rate of NumPy files; that of the score if not given."
        ),
    ] = None,
    sample_rate: Annotated[
        int | None,
        typer.Option(min=LOWEST_RATE_HZ, max=HIGHEST_RATE_HZ, help="Rate to score at, Hz; the dataset's if not given."),
    ] = None,
    duration_s: Annotated[
        float | None, typer.Option("--duration-s", min=0.01, help="Score the first part only; all if not given.")
    ] = None,
    allow_missing: Annotated[
        bool,
        typer.Option("--allow-missing", help="Score the predictions there are; the score cannot be compared then."),
    ] = False,
    list_responses: Annotated[
        bool, typer.Option("--list", help="Print names and places of the responses to predict as CSV, and stop.")
    ] = False,
    definitions: Annotated[
        bool, typer.Option("--definitions", help="Print what each error means, and stop; needs no dataset.")
    ] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Write the score as JSON, too; until then it stores what is measured, to go on with.",
            callback=writable_file,
        ),
    ] = None,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print the table as Markdown.")] = False,
    as_json: Json = False,
) -> None:
    """Score predicted impulse responses on a published split, by our definitions and by those of others."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    require_at_most_one({"--list": list_responses, "--definitions": definitions, "--predictions": bool(predictions)})
    require_at_most_one({"--json": as_json, "--markdown": as_markdown})
    if definitions:
        _print_definitions(as_json=as_json)
        return
    if dataset is None:
        raise NafirError("DATASET: name the folder of a dataset (--definitions alone needs none)")
    data = _opened(dataset, layout, split, points, source_rate)
    if list_responses:
        from training.evaluation.predicted import listed

        csv.writer(sys.stdout, lineterminator="\n").writerows(listed(data))
        return
    if predictions is None:
        raise NafirError("--predictions: name the folder of your responses (--list prints what to predict)")
    from dataclasses import replace

    from rich.progress import track

    from training.evaluation.benchmark import score
    from training.evaluation.benchmark_report import markdown, report
    from training.evaluation.predictions import Predictions
    from training.evaluation.stored_errors import StoredErrors

    rate = sample_rate or data.sample_rate
    data = replace(data, scored_rate=rate, duration_s=duration_s)
    found = Predictions.find(predictions, data.scored, data.known, data.normal, npy_rate=predictions_rate or rate)
    stored = None
    if output is not None:
        stored = StoredErrors(Path(f"{output}.partial"), [*found.signature(), data.identity()])
    console = Console(stderr=True)
    result = score(
        data,
        found,
        allow_missing=allow_missing,
        stored=stored,
        track=lambda cases: track(cases, "scoring", console=console),
    )
    if output is not None:
        output.write_text(json.dumps(result.to_json(), indent=1) + "\n")
    if as_json:
        typer.echo(json.dumps(result.to_json(), indent=2))
    elif as_markdown:
        typer.echo(markdown(result))
    else:
        Console(width=None if console.is_terminal else 140).print(report(result))


def predict(
    dataset: Annotated[
        Path, typer.Argument(help="Folder of SoundSpaces, RAF, MeshRIR, AcousticRooms, or of nafir-train.")
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder to write responses to.", callback=writable_folder)
    ],
    method: Annotated[
        str | None, typer.Option(help="A baseline, as in nafir-train evaluate --methods: nearest or linear, say.")
    ] = None,
    bundle: Annotated[Path | None, typer.Option(help="Scene bundle whose field predicts.")] = None,
    level: Annotated[str | None, typer.Option(help="Its quality level; the default one if not given.")] = None,
    form: Annotated[Format, typer.Option("--format", help="Form of the files.")] = Format.WAV,
    layout: LayoutName = "",
    split: SplitName = "",
    points: Points = None,
    source_rate: SourceRate = 48_000,
) -> None:
    """Write responses of a baseline or a bundle for the test part of a split, as nafir-train benchmark reads them."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    require_at_most_one({"--method": method is not None, "--bundle": bundle is not None})
    if level is not None and bundle is None:
        raise NafirError("--level: is that of a bundle: name it by --bundle")
    from rich.progress import track

    from server.scene.bundle import Bundle
    from training.evaluation.predicted import of_bundle, of_method, write_predictions

    if bundle is not None:
        make_source = of_bundle(Bundle.load(bundle), level)
    elif method is not None:
        make_source = of_method(method)
    else:
        raise NafirError("--method or --bundle: say what predicts")
    data = _opened(dataset, layout, split, points, source_rate)
    console = Console(stderr=True)
    count = write_predictions(
        data, make_source, output, suffix=f".{form}", track=lambda pairs: track(pairs, "predicting", console=console)
    )
    typer.echo(f"{output}: {count} responses of {data.name}, split {data.split.name}")


def _opened(dataset: Path, layout: str, split: str, points: Path | None, source_rate: int) -> "BenchmarkData":
    from training.data.importers.layouts import Options
    from training.evaluation.benchmark_data import open_benchmark

    options = Options(points=points, source_rate=source_rate)
    with Console(stderr=True).status("listing responses"):
        return open_benchmark(dataset, layout=layout, split=split, options=options)


def _print_definitions(*, as_json: bool) -> None:
    from training.evaluation.benchmark_report import definitions
    from training.evaluation.literature import METRICS

    typer.echo(json.dumps([metric.to_json() for metric in METRICS], indent=2) if as_json else definitions())
