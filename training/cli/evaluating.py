"""`nafir-train evaluate`, `tabulate`, `maps`, `probe`, `fractions`: the accuracy of fields, as tables and pictures."""

import json
import os
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from server.core.command_line import figure_file, require_at_most_one, writable_file, writable_folder
from server.core.files import require_matplotlib, require_writable
from server.core.numerals import parse_decimal
from training.cli.options import Json, Seed, progress_bar


def evaluate(
    places: Annotated[
        list[Path],
        typer.Argument(
            metavar="BUNDLE... DATA", help="Scene bundles, or runs on measured data, and last the dataset folder."
        ),
    ],
    methods: Annotated[
        str, typer.Option(help="Methods to compare with, separated by commas; an empty string for none.")
    ] = "nearest,linear,linear-aligned",
    pairs: Annotated[int | None, typer.Option(min=1, help="Held-out pairs to draw; all if not given.")] = None,
    yaws: Annotated[int | None, typer.Option(min=1, help="Head orientations of each; all if not given.")] = None,
    draws: Annotated[int, typer.Option(min=1, help="Compare with medians of so many more simulations.")] = 1,
    hrtf: Annotated[
        Path | None, typer.Option(help="Hear simulated data and fields through this head (SOFA, SimpleFreeFieldHRIR).")
    ] = None,
    tilt: Annotated[
        float, typer.Option(min=0, max=90, help="Tilt heads by so many degrees up, down, left and right in turn.")
    ] = 0.0,
    figure: Annotated[
        Path | None, typer.Option(help="Draw decays and errors to this PNG.", callback=figure_file)
    ] = None,
    record: Annotated[bool, typer.Option(help="Write the measured errors of every level into the bundle.")] = False,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Write the results as JSON, too; until then it stores what is measured, to go on with.",
            callback=writable_file,
        ),
    ] = None,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print the table as Markdown.")] = False,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Measure errors on held-out pairs, storage and time of fields, beside baselines and the repeatability floor."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # times are of one core
    from rich.progress import track

    from server.scene.bundle import MANIFEST_FILE, Bundle
    from training.evaluation.fields import record_accuracy
    from training.evaluation.report import markdown, report
    from training.evaluation.run import evaluate_bundles

    require_at_most_one({"--json": as_json, "--markdown": as_markdown})
    runs = [place for place in places[:-1] if (place / "run.json").is_file()]
    bundles = [Bundle.load(place) for place in places[:-1] if place not in runs]
    if record and (len(bundles) != 1 or runs or draws > 1):
        problem = "takes one bundle, and errors from one simulation, as a frontier's are"
        raise typer.BadParameter(problem, param_hint="--record")
    if record and (hrtf is not None or tilt):
        problem = "takes errors through the head of the data, level: leave out --hrtf and --tilt"
        raise typer.BadParameter(problem, param_hint="--record")
    if record:
        require_writable(bundles[0].folder / MANIFEST_FILE, "--record")
    console = Console(stderr=True)
    evaluation, published = evaluate_bundles(
        bundles,
        places[-1],
        runs=runs,
        methods=[name.strip() for name in methods.split(",") if name.strip()],
        pairs=pairs,
        yaws=yaws,
        draws=draws,
        hrtf=hrtf,
        tilt_deg=tilt,
        seed=seed,
        figure=figure,
        keep=None if output is None else Path(f"{output}.partial"),
        track=lambda steps, doing: track(steps, doing, console=console),
    )
    if record:
        record_accuracy(bundles[0], evaluation)
    if output is not None:
        output.write_text(json.dumps(evaluation.to_json(), indent=1) + "\n")
    if as_json:
        typer.echo(json.dumps(evaluation.to_json(), indent=2))
    elif as_markdown:
        typer.echo(markdown(evaluation, published))
    else:
        Console(width=None if console.is_terminal else 170).print(report(evaluation, published))


def tabulate(
    results: Annotated[list[Path], typer.Argument(help="What evaluate --json wrote, a file per scene.")],
    figure: Annotated[
        Path | None, typer.Option(help="Draw errors in units of the floor to this PNG.", callback=figure_file)
    ] = None,
    as_json: Json = False,
) -> None:
    """Print one Markdown table of the default levels over scenes, and the times of all steps if they were recorded."""
    from dataclasses import asdict

    from training.evaluation.scenes import TIMES, SceneResult, markdown, step_times, times_markdown

    scenes = [SceneResult.read(path) for path in results]
    if figure is not None:
        from training.evaluation.scenes_figure import draw_scenes

        draw_scenes(scenes, figure)
    logs = {result.scene: path.parent / TIMES for result, path in zip(scenes, results, strict=True)}
    times = {scene: step_times(log) for scene, log in logs.items() if log.exists()}
    if as_json:
        records = [{**result.to_json(), "times": list(map(asdict, times.get(result.scene, [])))} for result in scenes]
        typer.echo(json.dumps(records, indent=1))
        return
    typer.echo(markdown(scenes))
    if times:
        typer.echo("\n" + times_markdown(times))


def maps(
    bundle: Annotated[Path, typer.Argument(help="Scene bundle.")],
    data: Annotated[Path, typer.Argument(help="Dataset folder the bundle's field was trained on.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="PNG to write.", callback=figure_file)],
    level: Annotated[str | None, typer.Option(help="Quality level; the default one if not given.")] = None,
    emitters: Annotated[int, typer.Option(min=1, max=8, help="How many emitters to map.")] = 3,
    spacing_m: Annotated[float, typer.Option(min=0.05, help="Between the cells of a map.")] = 0.25,
) -> None:
    """Draw loudness maps side by side: simulated, predicted by the field, nearest and linear interpolation."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from rich.progress import track

    from server.field.fields_by_level import FieldsByLevel
    from server.scene.bundle import Bundle
    from training.baselines.held_out import open_held_out
    from training.evaluation.maps import draw_maps, map_emitters

    console = Console(stderr=True)
    field = FieldsByLevel.load(Bundle.load(bundle)).choose(level)
    with open_held_out(data) as held_out:
        drawn = map_emitters(
            held_out,
            field,
            emitters=emitters,
            spacing_m=spacing_m,
            track=lambda steps, doing: track(steps, doing, console=console),
        )
    draw_maps(drawn, output)
    for number, of_emitter in enumerate(drawn, start=1):
        methods = list(of_emitter.levels_db)[1:]
        errors = ", ".join(f"{method} {of_emitter.errors_db(method):.2f} dB" for method in methods)
        typer.echo(f"emitter {number}: mean error against the simulation: {errors}")


def probe(
    bundle: Annotated[Path, typer.Argument(help="Scene bundle.")],
    data: Annotated[Path, typer.Argument(help="Dataset folder the bundle's field was trained on.")],
    field: Annotated[str | None, typer.Option(help="Field of the bundle; the default level's if not given.")] = None,
    emitters: Annotated[int | None, typer.Option(min=1, help="Probes to draw as emitters; all if not given.")] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Draw true and decoded distances to this PNG.", callback=figure_file)
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Decode the distance to the nearest wall from a field's hidden features, against MFCC of the true responses."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from rich.progress import track

    from server.scene.bundle import Bundle
    from training.baselines.held_out import open_held_out
    from training.evaluation.probe import probe as probe_field
    from training.evaluation.probe_figure import draw_probe

    console = Console(stderr=True)
    with open_held_out(data) as held_out:
        probing = probe_field(
            Bundle.load(bundle),
            held_out,
            field=field,
            emitters=emitters,
            seed=seed,
            track=lambda steps, doing: track(steps, doing, console=console),
        )
    if figure is not None:
        draw_probe(probing, figure)
    if as_json:
        typer.echo(json.dumps(probing.to_json(), indent=2))
        return
    for name, decoding in (("hidden features", probing.features), ("MFCC of the responses", probing.coefficients)):
        spread = f"± {100 * decoding.spread:.1f}"
        typer.echo(f"{name}: {100 * decoding.mean:.1f} {spread} % of the variance over {len(probing.places)} places")


def fractions(
    data: Annotated[Path, typer.Argument(help="Dataset folder from simulate.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder of runs, fractions.json and .png.", callback=writable_folder),
    ],
    fields: Annotated[str, typer.Option(help="Fields to train, separated by commas.")] = "naf,naf-no-grid,directional",
    percents: Annotated[
        str, typer.Option("--fractions", help="Percentages of the training pairs, separated by commas.")
    ] = "5,10,25,50,100",
    seeds: Annotated[int, typer.Option(min=1, max=100, help="Runs of each field on each fraction.")] = 3,
    epochs: Annotated[int, typer.Option(min=1, help="Passes over all pairs; runs on fewer make as many steps.")] = 8,
    points: Annotated[int, typer.Option(min=1, help="Points of each response that a naf trains on per step.")] = 100,
    pairs: Annotated[int, typer.Option(min=1, help="Held-out pairs to score.")] = 40,
    as_json: Json = False,
) -> None:
    """Train fields on fractions of the training pairs, several seeds each; draw their errors. Run again to go on."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from training.trials.fractions import Effort, measure_fractions, trials
    from training.trials.fractions_figure import SHOWN, figure_of, spreads

    require_matplotlib("--output")
    chosen = trials(names_of(fields), [percentage(text) for text in names_of(percents)], seeds)
    with progress_bar() as progress:
        found = measure_fractions(data, output, chosen, Effort(epochs, points, pairs), progress)
    figure_of(found).savefig(output / "fractions.png", dpi=110)
    if as_json:
        typer.echo(json.dumps(found.to_json(), indent=2))
        return
    for metric in SHOWN:
        for field, by_percent in spreads(found, metric).items():
            told = [f"{percent:g} %: {mean:.3g} ± {spread:.2g}" for percent, (mean, spread, _) in by_percent.items()]
            typer.echo(f"{metric}, {field}: {', '.join(told)}")


def names_of(text: str) -> list[str]:
    """The parts of a list that is separated by commas."""
    return [part.strip() for part in text.split(",") if part.strip()]


def percentage(text: str) -> float:
    try:
        return parse_decimal(text)
    except ValueError as exc:
        raise typer.BadParameter(f"{text!r}: {exc}", param_hint="--fractions") from exc
