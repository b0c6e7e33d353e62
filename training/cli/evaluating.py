"""`nafir-train evaluate`, `tabulate`, `maps`, `spectrograms`, `probe`, `probe-emitters`, `fractions`: the accuracy of
fields, as tables and pictures."""

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer
from rich.console import Console

from server.core.command_line import figure_file, require_at_most_one, writable_file, writable_folder
from server.core.files import require_matplotlib, require_writable
from server.core.numerals import parse_decimal
from training.cli.options import Cluster, FirstSeed, Json, Seed, progress_bar

if TYPE_CHECKING:
    from training.baselines.held_out import HeldOut


def evaluate(
    places: Annotated[
        list[Path],
        typer.Argument(
            metavar="BUNDLE... DATA", help="Scene bundles, or runs on measured data, and last the dataset folder."
        ),
    ],
    methods: Annotated[
        str, typer.Option(help="Methods to compare with, separated by commas; an empty string for none.")
    ] = "nearest,linear,linear-aligned,mean-spectrogram",
    pairs: Annotated[int | None, typer.Option(min=1, help="Held-out pairs to draw; all if not given.")] = None,
    yaws: Annotated[int | None, typer.Option(min=1, help="Head orientations of each; all if not given.")] = None,
    half: Annotated[
        str | None,
        typer.Option(help="report for pairs that levels were not chosen by, choice for the others; all if not given."),
    ] = None,
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
    cluster: Cluster = None,
    as_json: Json = False,
) -> None:
    """Measure errors on held-out pairs, storage and time of fields, beside baselines and the repeatability floor."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # times are of one core
    from rich.progress import track

    from server.scene.bundle import MANIFEST_FILE, Bundle
    from training.data.dataset import Half
    from training.evaluation.fields import record_accuracy
    from training.evaluation.report import markdown, report
    from training.evaluation.run import evaluate_bundles
    from training.parallel.jobs import open_jobs

    require_at_most_one({"--json": as_json, "--markdown": as_markdown})
    chosen = next((known for known in get_args(Half) if known == half), None)
    if half is not None and chosen is None:
        raise typer.BadParameter(f"knows {' and '.join(get_args(Half))}", param_hint="--half")
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
    with open_jobs(cluster, threads=os.cpu_count() or 1) as jobs:
        evaluation, published = evaluate_bundles(
            bundles,
            places[-1],
            runs=runs,
            methods=[name.strip() for name in methods.split(",") if name.strip()],
            pairs=pairs,
            yaws=yaws,
            half=chosen,
            draws=draws,
            hrtf=hrtf,
            tilt_deg=tilt,
            seed=seed,
            figure=figure,
            keep=None if output is None else Path(f"{output}.partial"),
            jobs=jobs,
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
    bundle: Annotated[Path, typer.Argument(help="Scene bundle; or, of measured data, a run.")],
    data: Annotated[Path, typer.Argument(help="Dataset folder the bundle's field was trained on.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="PNG to write.", callback=figure_file)],
    level: Annotated[str | None, typer.Option(help="Quality level; the default one if not given.")] = None,
    emitters: Annotated[int, typer.Option(min=1, max=8, help="How many emitters to map.")] = 3,
    spacing_m: Annotated[float, typer.Option(min=0.05, help="Between the cells of a map.")] = 0.25,
    coded: Annotated[str, typer.Option(help="Codecs of further columns: aac or opus, or both, by a comma.")] = "",
    methods: Annotated[
        str, typer.Option(help="Of measured data: methods to map, separated by commas.")
    ] = "nearest,linear,helmholtz,helmholtz-lowpass",
) -> None:
    """Draw loudness maps side by side: simulated or measured, predicted by the field, and interpolated."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from rich.progress import track

    from server.field.fields_by_level import FieldsByLevel
    from server.scene.bundle import Bundle
    from training.baselines.held_out import open_held_out
    from training.evaluation.maps import draw_maps, map_emitters
    from training.evaluation.methods import codec_named

    console = Console(stderr=True)
    with open_held_out(data) as held_out:
        if held_out.simulated is None:
            _map_measured(bundle, data, held_out, output, emitters=emitters, methods=names_of(methods))
            return
        drawn = map_emitters(
            held_out,
            FieldsByLevel.load(Bundle.load(bundle)).choose(level),
            emitters=emitters,
            spacing_m=spacing_m,
            codecs=[codec_named(name) for name in names_of(coded)],
            track=lambda steps, doing: track(steps, doing, console=console),
        )
    draw_maps(drawn, output)
    for number, of_emitter in enumerate(drawn, start=1):
        mapped = list(of_emitter.levels_db)[1:]
        errors = ", ".join(f"{method} {of_emitter.errors_db(method):.2f} dB" for method in mapped)
        typer.echo(f"emitter {number}: mean error against the simulation: {errors}")


def _map_measured(
    place: Path, data: Path, held_out: "HeldOut", output: Path, *, emitters: int, methods: list[str]
) -> None:
    from server.scene.bundle import Bundle
    from training.evaluation.fields import field_columns
    from training.evaluation.measured_maps import draw_measured, map_measured
    from training.evaluation.methods import method_columns
    from training.simulation.responses import open_responses

    if (place / "run.json").is_file():
        # Torch takes seconds to load, and bundles do not need it.
        from training.evaluation.measured_fields import run_columns

        columns = run_columns(place, open_responses(data), held_out)[:1]
    else:
        columns = field_columns([Bundle.load(place)], held_out)[:1]
    drawn = map_measured(held_out, [*columns, *method_columns(methods, held_out)], emitters=emitters)
    draw_measured(drawn, output)
    for number, of_emitter in enumerate(drawn, start=1):
        mapped = list(of_emitter.levels_db)[1:]
        errors = ", ".join(f"{method} {of_emitter.error_db(method):.2f} dB" for method in mapped)
        typer.echo(f"emitter {number}: mean error at held-out listeners: {errors}")


def spectrograms(
    places: Annotated[
        list[Path],
        typer.Argument(metavar="BUNDLE... DATA", help="Scene bundles, or runs on measured data, and last the dataset."),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="PNG to write.", callback=figure_file)],
    pair: Annotated[int, typer.Option(min=0, help="Which of the held-out pairs, counted from 0.")] = 0,
    methods: Annotated[str, typer.Option(help="Further rows, separated by commas.")] = "",
) -> None:
    """Draw log-magnitude and phase of a held-out response's left ear, truth above predictions."""
    from server.scene.bundle import Bundle
    from training.baselines.held_out import EvaluationError, open_held_out
    from training.evaluation.evaluate import Column
    from training.evaluation.fields import field_columns
    from training.evaluation.methods import method_columns
    from training.evaluation.spectrogram_figure import draw_spectrograms
    from training.simulation.responses import open_responses

    runs = [place for place in places[:-1] if (place / "run.json").is_file()]
    bundles = [Bundle.load(place) for place in places[:-1] if place not in runs]
    with open_held_out(places[-1]) as held_out:
        if pair >= len(held_out):
            raise EvaluationError(f"--pair: {held_out.name} has {len(held_out)} held-out pairs, counted from 0")
        columns: list[Column] = field_columns(bundles, held_out)
        if runs:
            from training.evaluation.measured_fields import run_columns

            columns += [column for run in runs for column in run_columns(run, open_responses(places[-1]), held_out)]
        columns += method_columns(names_of(methods), held_out)
        shown = {"truth": held_out.reference(pair)[0, 0]}
        for column in columns:
            answer = column.source(pair, held_out.yaw_indices[:1])
            if answer is not None:
                shown[column.name] = answer[0, 0]
        draw_spectrograms(shown, held_out.sample_rate, output)
    typer.echo(f"{output}: {', '.join(shown)}")


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


def probe_emitters(
    run: Annotated[Path, typer.Argument(help="Finished run of a naf.")],
    data: Annotated[Path, typer.Argument(help="Dataset folder from simulate, that it was trained on.")],
    spacing_m: Annotated[float, typer.Option(min=0.05, help="Between the places that are tested.")] = 0.1,
    points: Annotated[int, typer.Option(min=1, help="Points of each response to average features over.")] = 256,
    figure: Annotated[
        Path | None, typer.Option(help="Draw decoded distances and t-SNE to this PNG.", callback=figure_file)
    ] = None,
    seed: Seed = 0,
    as_json: Json = False,
) -> None:
    """Decode the distance from emitter to nearest wall as in the paper, beside an untrained network and MFCC."""
    from training.evaluation.emitter_probe import probe_emitters as probe_run
    from training.evaluation.emitter_probe_figure import draw_emitter_probe

    console = Console(stderr=True)

    def shown(steps: Sequence[int], doing: str) -> Iterable[int]:
        from rich.progress import track

        return track(steps, doing, console=console)

    found = probe_run(run, data, spacing_m=spacing_m, points=points, seed=seed, track=shown)
    if figure is not None:
        draw_emitter_probe(found, figure)
    if as_json:
        typer.echo(json.dumps(found.to_json(), indent=2))
        return
    typer.echo(f"fitted at {found.fitted} places, tested at {len(found.cells)}, {found.spacing_m:g} m apart")
    for name, read in found.reads.items():
        typer.echo(f"{name}: {100 * read.explained:.1f} % of the variance, mean error {read.mean_error_m:.2f} m")


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
    first_seed: FirstSeed = 0,
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
    chosen = trials(names_of(fields), [percentage(text) for text in names_of(percents)], seeds, first_seed)
    with progress_bar() as progress:
        found = measure_fractions(data, output, chosen, Effort(epochs, points, pairs), progress)
    figure_of(found).savefig(output / "fractions.png", dpi=110)
    if as_json:
        typer.echo(json.dumps(found.to_json(), indent=2))
        return
    for metric in SHOWN:
        for field, by_percent in spreads(found, metric).items():
            told = [
                f"{percent:g} %: {mean:.3g}" + (f" ± {spread:.2g}" if runs > 1 else "")
                for percent, (mean, spread, runs) in by_percent.items()
            ]
            typer.echo(f"{metric}, {field}: {', '.join(told)}")


def names_of(text: str) -> list[str]:
    """The parts of a list that is separated by commas."""
    return [part.strip() for part in text.split(",") if part.strip()]


def percentage(text: str) -> float:
    try:
        return parse_decimal(text)
    except ValueError as exc:
        raise typer.BadParameter(f"{text!r}: {exc}", param_hint="--fractions") from exc
