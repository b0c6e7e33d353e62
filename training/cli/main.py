"""`nafir-train`: simulate, train, export, evaluate."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from server.core.command_line import StrictTyper, require_at_most_one, writable_folder
from server.core.errors import NafirError
from server.core.files import require_matplotlib, require_writable
from server.core.numerals import parse_integer
from training.cli import benchmarking, watching
from training.cli import evaluating as evaluation
from training.cli import simulating as simulation
from training.cli.importing import importing
from training.cli.importing_levels import bundle_level, import_level
from training.cli.listening import listening_test
from training.cli.options import Cluster, Json, Seed
from training.cli.options import progress_bar as _progress

if TYPE_CHECKING:
    from training.data.responses import ResponseSet

app = StrictTyper(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)
app.add_typer(importing, name="import")
app.command()(import_level)
app.command()(bundle_level)
app.command()(simulation.plan)
app.command()(listening_test)

Folder = Annotated[Path, typer.Option("--output", "-o", help="Folder to write.", callback=writable_folder)]


@app.command()
def simulate(
    scene: simulation.Scene,
    output: Folder,
    effects: simulation.Effects = "plan",
    seed: Seed = 0,
    workers: Annotated[int, typer.Option(min=0, help="Threads; 0 for one per core.")] = 0,
    cluster: Cluster = None,
) -> None:
    """Simulate what a scene calls for, between all pairs of probes. Run again after an interruption to go on."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    from training.data.levels.level_scene import read_scene
    from training.data.scene_file import SceneFile
    from training.parallel.jobs import open_jobs
    from training.simulation.run import simulate as simulate_scene

    require_at_most_one({"--workers": workers > 0, "--cluster": cluster is not None})
    console = simulation.wide_console(stderr=True)
    with console.status("planning, and tracing the late sound that pairs may share"):
        ready = simulation.simulation_of(scene, seed, effects)
        read = read_scene(scene)
    simulation.print_plan(console, read, ready.plan, seed)
    with open_jobs(cluster, threads=workers or os.cpu_count() or 1) as jobs, _progress() as progress:
        dataset = simulate_scene(scene, output, seed=seed, jobs=jobs, progress=progress, simulation=ready)
    from training.simulation.responses import SimulatedResponses

    if isinstance(read, SceneFile):
        _print_findings(SimulatedResponses(dataset))
    trained, held_out = (len(dataset.pairs(held_out=held_out)) for held_out in (False, True))
    typer.echo(f"{output}: {trained} pairs to train on and {held_out} held out, {len(dataset.yaws)} orientations each")


@app.command()
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
    epochs: Annotated[int | None, typer.Option(min=1, help="Passes over the training set.")] = None,
    minutes: Annotated[float | None, typer.Option(min=0.001, help="Time to train for, in place of epochs.")] = None,
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
    from training.learning.train import train as train_field
    from training.simulation.responses import open_responses

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
    responses = open_responses(data)
    if os.environ.get("RANK", "0") == "0":
        _print_findings(responses)
    if cluster is None:
        with _progress() as progress:
            train_field(responses, output, configuration, progress)
    else:
        from training.learning.on_cluster import train_on_cluster

        with Console(stderr=True).status("training on the cluster"):
            train_on_cluster(cluster, data, output, configuration, workers=workers or 2)
    typer.echo(f"{output}: {configuration.name} is trained")


@app.command()
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
    with open_jobs(cluster, threads=1) as jobs, _progress() as progress:
        rows = ablate_factors(responses, output, configurations, progress, jobs=jobs)
    if as_json:
        typer.echo(json.dumps([asdict(row) for row in rows], indent=2))
        return
    for line in table(rows):
        typer.echo("".join(column.ljust(24 if number == 0 else 15) for number, column in enumerate(line)).rstrip())


@app.command()
def export(
    runs: Annotated[
        list[Path],
        typer.Argument(
            help="Run folders from train, all of one scene, the default first; for the nearest response, shaped, the "
            "folder of imported responses itself."
        ),
    ],
    output: Folder,
    data: Annotated[Path | None, typer.Option(help="Dataset folder, if it has moved since training.")] = None,
    precision: Annotated[str, typer.Option(help="float32 or int8, or both, separated by a comma.")] = "float32",
    ranks: Annotated[str, typer.Option(help="Lower ranks, 64,32 say, to write factorised fields at too.")] = "",
    exact_tables: Annotated[
        bool, typer.Option("--exact-tables", help="Add every naf once more, with less arithmetic for the same numbers.")
    ] = False,
    accept: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LAW=REASON",
            help="Offer the scene although its fields break a law of nafir check, named as in nafir check --json; the "
            "bundle keeps the reason. Once for each law.",
        ),
    ] = None,
) -> None:
    """Write finished runs as the fields of a scene bundle. Every graph is checked against torch, and by nafir check."""
    from training.bundling.export import PRECISIONS
    from training.bundling.export import export as export_bundle
    from training.data.responses import FILE
    from training.learning.runs import dataset_folder
    from training.simulation.responses import open_responses

    chosen = [known for name in precision.split(",") for known in PRECISIONS if known == name.strip()]
    if len(chosen) != len(precision.split(",")):
        raise typer.BadParameter(f"knows {', '.join(PRECISIONS)}", param_hint="--precision")
    lower = [_rank(text) for text in ranks.split(",") if ranks]
    accepted = _accepted(accept or ())
    responses = open_responses(data or (runs[0] if (runs[0] / FILE).is_file() else dataset_folder(runs[0])))
    with _progress() as progress:
        bundle = export_bundle(
            responses,
            runs,
            output,
            precisions=chosen,
            ranks=lower,
            exact_tables=exact_tables,
            accepted=accepted,
            progress=progress,
        )
    for entry in bundle.manifest.accepted:
        typer.echo(f"{output}: breaks the law {entry.law}, accepted: {entry.reason}")
    for name in accepted.keys() - {entry.law for entry in bundle.manifest.accepted}:
        typer.echo(f"{output}: keeps the law {name}; there was nothing to accept")
    size = sum(path.stat().st_size for path in output.iterdir())
    fields = ", ".join(bundle.manifest.fields)
    typer.echo(f"{output}: scene {bundle.id}, {fields}, {size / 1e6:.1f} MB, digest {bundle.digest[:12]}")


def _rank(text: str) -> int:
    try:
        rank = parse_integer(text)
    except ValueError as exc:
        raise NafirError(f"--ranks: {exc}") from exc
    if rank < 1:
        raise NafirError(f"--ranks: {rank} is not above zero")
    return rank


def _accepted(entries: Sequence[str]) -> dict[str, str]:
    """Reasons by law. Raises NafirError if a law is named twice."""
    accepted: dict[str, str] = {}
    for law, reason in map(_law_and_reason, entries):
        if law in accepted:
            raise NafirError(f"--accept: two reasons for {law}: give one")
        accepted[law] = reason
    return accepted


def _law_and_reason(entry: str) -> tuple[str, str]:
    law, separator, reason = entry.partition("=")
    if not separator:
        raise typer.BadParameter(f"{entry!r}: is not LAW=REASON", param_hint="--accept")
    return law.strip(), reason.strip()


def _print_findings(responses: "ResponseSet") -> None:
    """Prints what training may want to know about a dataset."""
    from training.bundling.data_reference import health_of
    from training.simulation.responses import SimulatedResponses

    rays = responses.dataset.effects.rays if isinstance(responses, SimulatedResponses) else None
    for line in health_of(responses).lines(rays):
        typer.echo(f"{responses.file.parent}: {line}", err=True)


for command in (
    evaluation.evaluate,
    evaluation.tabulate,
    evaluation.maps,
    evaluation.spectrograms,
    evaluation.probe,
    evaluation.probe_emitters,
    evaluation.fractions,
    watching.draw_views,
    watching.cross_modal,
):
    app.command()(command)
app.command()(benchmarking.benchmark)
app.command()(benchmarking.predict)


@app.command()
def frontier(
    bundle: Annotated[Path, typer.Argument(help="Scene bundle; its fields are swept.")],
    data: Annotated[Path, typer.Argument(help="Dataset folder the bundle's fields were trained on.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder for frontier.json and frontier.png.", callback=writable_folder),
    ],
    pairs: Annotated[
        int, typer.Option(min=4, help="Held-out pairs to measure: half to choose levels, half to report errors.")
    ] = 80,
    yaws: Annotated[int, typer.Option(min=1, help="Head orientations of each.")] = 3,
    walk_s: Annotated[float, typer.Option(min=10, help="Seconds of the walk that costs are measured on.")] = 300.0,
    phases_of: Annotated[list[str] | None, typer.Option(help="Fields to sweep over phases; all, or none.")] = None,
    reuse_of: Annotated[list[str] | None, typer.Option(help="Fields to sweep over reuse of responses.")] = None,
    default_ms: Annotated[float, typer.Option(help="A response of the default level takes no longer.")] = 2.5,
    record: Annotated[bool, typer.Option(help="Write a few of the Pareto-optimal levels into the bundle.")] = False,
    seed: Seed = 0,
    cluster: Cluster = None,
    as_json: Json = False,
) -> None:
    """Measure accuracy against time for everything a bundle could offer. Run again after an interruption to go on."""
    from server.scene.bundle import MANIFEST_FILE, Bundle
    from training.data.dataset import Dataset
    from training.frontier.candidates import candidates
    from training.frontier.figure import draw_frontier
    from training.frontier.sweep import Effort, sweep
    from training.frontier.sweep import record as record_frontier
    from training.frontier.table import report
    from training.parallel.jobs import open_jobs

    require_matplotlib("--output")
    if record:
        require_writable(bundle / MANIFEST_FILE, "--record")
    loaded = Bundle.load(bundle)
    effort = Effort(pairs=pairs, yaws=yaws, walk_s=walk_s, default_ms=default_ms, seed=seed)
    levels = candidates(loaded, phases_of, reuse_of or ())
    with open_jobs(cluster, threads=os.cpu_count() or 1) as jobs, _progress() as progress:
        measured = sweep(loaded, Dataset.open(data), levels, output, effort, progress, jobs=jobs)
    (output / "frontier.json").write_text(json.dumps(measured.to_json(), indent=2) + "\n")
    draw_frontier(measured, output / "frontier.png")
    if record:
        record_frontier(loaded, measured, bundle)
    if as_json:
        typer.echo(json.dumps(measured.to_json(), indent=2))
    else:
        Console(width=None if Console().is_terminal else 170).print(report(measured))


def main() -> None:
    """Entry point of the console script. Nafir's own errors, and those of files, become one line and exit code 2."""
    try:
        app()
    except NafirError as exc:
        typer.echo(f"nafir-train: {exc}", err=True)
        raise SystemExit(2) from exc
    except OSError as exc:
        # Folders that cannot be written, full disks. HDF5 writes its own messages and sets no `strerror`.
        place = "" if exc.filename is None else f"{exc.filename}: "
        typer.echo(f"nafir-train: {place}{exc.strerror or exc}", err=True)
        raise SystemExit(2) from exc
    except ModuleNotFoundError as exc:
        typer.echo(
            f"nafir-train: {exc.name} is missing; install the training extra: pip install 'nafir[training]'", err=True
        )
        raise SystemExit(2) from exc
