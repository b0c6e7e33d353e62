"""`nafir bench`: performance on this host. Results are medians of several rounds; run it on an idle machine.

Every command returns an `Outcome`. `_finish` adds it to the history if `--record` is given. It ends with exit code 1 if
a goal of the run is not reached, with a line on standard error that says why. A command that raises adds nothing to the
history.
"""

import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, cast, get_args

import typer

from server.bench.report import (
    Judgement,
    end_with,
    missed,
    print_json,
    print_judgements,
    print_measures,
    print_rows,
)
from server.core.command_line import StrictTyper, require_at_most_one, writable_file, writable_folder
from server.core.errors import NafirError


@dataclass(frozen=True)
class Outcome:
    """Result of a run of `bench`: figures by name, and failures."""

    bench: str
    figures: Mapping[str, float | None]
    problems: tuple[str, ...] = ()

    @classmethod
    def judged(cls, bench: str, judgements: list[Judgement], problems: Iterable[str] = ()) -> "Outcome":
        figures = {each.measure: each.value for each in judgements if not each.is_skipped}
        return cls(bench, figures, (*missed(judgements), *problems))


def _finish(outcome: Outcome, *, record: bool, history: Path) -> None:
    if record:
        from server.bench.history import Run, append_run

        path = history / f"{outcome.bench}.json"
        append_run(path, Run.now(shlex.join(["nafir", *sys.argv[1:]]), outcome.figures, outcome.problems))
        typer.echo(f"recorded in {path}", err=True)
    end_with(outcome.problems)


app = StrictTyper(help="Measure what things cost on this host.", no_args_is_help=True, result_callback=_finish)


@app.callback()
def _bench(
    record: Annotated[bool, typer.Option("--record", help="Add the run to the history of its benchmark.")] = False,
    history: Annotated[
        Path, typer.Option(help="Folder of histories, one JSON file each.", callback=writable_folder)
    ] = Path("benchmarks/history"),
) -> None:
    pass


Scene = Annotated[str, typer.Argument(help="Id of a bundled scene, or the folder of any scene bundle.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]


@app.command()
def field(
    scene: Scene = "apartment",
    rounds: Annotated[int, typer.Option(min=1, help="Rounds, of which the median counts.")] = 20,
    poses: Annotated[int, typer.Option(min=1, help="Random poses per round.")] = 20,
    as_json: AsJson = False,
) -> Outcome:
    """Time from a pose to a binaural impulse response, one at a time on one core, at every quality level.

    At the default level also until it is ready to be convolved: for a pose that moved, for a head that only turned, and
    for ambisonic channels; and each part of the first by itself.
    """
    from server.bench.field import measure_levels
    from server.field.fields_by_level import FieldsByLevel
    from server.scene.bundle import Bundle, find_bundle

    measured = measure_levels(FieldsByLevel.load(Bundle.load(find_bundle(scene))), rounds=rounds, poses=poses)
    judgements = [Judgement(**row) for row in measured["summary"]]
    if as_json:
        print_json(measured)
    else:
        print_measures("Host", measured["host"])
        print_rows(f"One impulse response of scene {measured['scene']}, {measured['ir_s']:g} s", measured["levels"])
        if measured["responses"]:
            print_rows("From a pose to a response ready to be convolved, default level", measured["responses"])
        print_judgements("Goals", judgements)
    rows = [*measured["levels"], *measured["responses"]]
    figures = {f"{scene}, {row['name']}, {name}": row[name] for row in rows for name in _TIMES}
    return Outcome("field", figures, tuple(missed(judgements)))


@app.command()
def convolver(
    quick: Annotated[
        bool, typer.Option("--quick", help="Only blocks of 256, 1 s of impulse response, 1 and 16 sources.")
    ] = False,
    as_json: AsJson = False,
) -> Outcome:
    """The convolver compared with pedalboard and SciPy: speed, error, evenness, exchanges, drift, start-up.

    Two to six minutes, or one at most with --quick. Without pedalboard (extra `dev`) its columns stay empty.
    """
    from server.bench.convolver import FULL, QUICK, measure_convolver

    plan = QUICK if quick else FULL
    with _progress(plan.steps) as advance:
        measured = measure_convolver(plan, advance)
    judgements = [Judgement(**row) for row in measured["summary"]]
    if as_json:
        print_json(measured)
    else:
        if measured["peer"] is None:
            typer.echo("pedalboard is not installed: there is nothing to compare with (pip install pedalboard)")
        _print_convolver(measured, judgements)
    return Outcome.judged("convolver", judgements)


@app.command()
def start(
    rounds: Annotated[int, typer.Option(min=1, help="Rounds, of which the median counts.")] = 5,
    is_first: Annotated[
        bool, typer.Option("--first", help="Also start a server that has everything to compile: some minutes.")
    ] = False,
    as_json: AsJson = False,
) -> Outcome:
    """How long new processes take: `nafir --help`, `nafir ir`, and `nafir serve` until it is ready."""
    from server.bench.startup import measure_starts

    measured = measure_starts(rounds, is_first=is_first)
    judgements = [Judgement(**row) for row in measured["summary"]]
    if as_json:
        print_json(measured)
    else:
        print_measures("Host", measured["host"])
        print_judgements("Goals", judgements)
    return Outcome.judged("start", judgements)


@app.command()
def stream(
    scene: Annotated[
        list[str] | None,
        typer.Option(
            help="A bundled scene's id, the folder of any scene bundle, or `bench`, a scene that isolates rendering; "
            "repeatable. [default: apartment, bench]"
        ),
    ] = None,
    emitters: Annotated[
        list[int] | None, typer.Option(min=1, max=16, help="Of each session; repeatable. [default: 1, 16]")
    ] = None,
    sessions: Annotated[
        int | None, typer.Option(min=1, help="How many sessions. [default: finds how many there can be]")
    ] = None,
    duration_s: Annotated[float, typer.Option(min=1, help="How long the run is that counts.")] = 60.0,
    poses_per_second: Annotated[float, typer.Option(min=0, help="Of each listener; 0 to stand still.")] = 30.0,
    moving_emitters: Annotated[
        bool, typer.Option("--moving-emitters", help="Emitters move as well, as often as their listener.")
    ] = False,
    block_size: Annotated[
        int, typer.Option(help="Samples of each block. Poses count from the next block on: short blocks cost more.")
    ] = 256,
    listeners: Annotated[
        int, typer.Option(min=1, max=8, help="Of each session, in one stream. Goals are for one.")
    ] = 1,
    as_json: AsJson = False,
) -> Outcome:
    """How many sessions one core serves, with fewer than one block in a thousand late.

    A goal has to hold in the apartment, whose responses a network computes, and in `bench`, where rendering is hardest
    and responses cost nothing. A search takes about five minutes for each scene and number of emitters; a given number
    of sessions takes one and a half. Each step is reported when it ends. After Ctrl-C the results so far are printed.
    """
    from server.bench.sessions import Plan, failures, measure_sessions
    from server.protocol.client_messages import BlockSize

    if block_size not in get_args(BlockSize):
        raise NafirError(f"--block-size: {block_size} is none of {', '.join(map(str, get_args(BlockSize)))}")
    plan = Plan(
        scenes=tuple(dict.fromkeys(scene)) if scene else Plan.scenes,
        emitters=tuple(emitters) if emitters else Plan.emitters,
        sessions=sessions,
        duration_s=duration_s,
        poses_per_s=poses_per_second,
        sways=moving_emitters,
        block_size=cast("BlockSize", block_size),
        listeners=listeners,
    )
    measured = measure_sessions(plan, _steps_told())
    judgements = [Judgement(**row) for row in measured["summary"]]
    if as_json:
        print_json(measured)
    else:
        _print_sessions(measured, judgements)
    interrupted = [] if measured["is_complete"] else ["it was interrupted"]
    return Outcome.judged("stream", judgements, [*failures(measured["cases"]), *interrupted])


@app.command()
def costs(
    scene: Annotated[
        str, typer.Option(help="A bundled scene's id, the folder of any scene bundle, or `bench`.")
    ] = "apartment",
    poses_per_second: Annotated[float, typer.Option(min=0, help="Of each listener; 0 to stand still.")] = 30.0,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="File for `nafir plan-capacity --costs`.", callback=writable_file),
    ] = None,
    as_json: AsJson = False,
) -> Outcome:
    """Where a listener-second goes: what each part of a server on one core costs, with few sessions and with many.

    Two minutes. Capacity is planned from these costs, on this machine or, with a file of them, on any other.
    """
    from server.bench.costs import listener_second, measure_costs, write_costs
    from server.bench.machine import describe_machine

    measured = measure_costs(scene, poses_per_s=poses_per_second, advance=_steps_told())
    if output is not None:
        write_costs(output, measured)
    rows = [listener_second(run) for run in measured.runs]
    if as_json:
        tables = [
            {"sessions": run.sessions, "emitters": run.emitters, "parts": parts}
            for run, parts in zip(measured.runs, rows, strict=True)
        ]
        print_json({"host": describe_machine(), "costs": measured.model_dump(mode="json"), "listener_second": tables})
    else:
        print_measures("Host", describe_machine())
        for run, parts in zip(measured.runs, rows, strict=True):
            late = f"{run.late_share:.1%} late"
            print_rows(f"A listener-second of {run.sessions} × {run.emitters} in {measured.scene}, {late}", parts)
    figures: dict[str, float | None] = {
        f"{measured.scene}, {run.sessions} sessions of {run.emitters} emitters, ms a listener-second": sum(
            part["ms"] for part in parts
        )
        for run, parts in zip(measured.runs, rows, strict=True)
    }
    return Outcome("costs", figures)


_OVERLOAD = "late_share", "steps_down", "answer_s", "memory_growth"


@app.command()
def overload(
    scene: Annotated[
        str, typer.Option(help="A bundled scene's id, the folder of any scene bundle, or `bench`.")
    ] = "apartment",
    emitters: Annotated[int, typer.Option(min=1, max=16, help="Of each session.")] = 16,
    sessions: Annotated[
        int | None, typer.Option(min=1, help="How many sessions a core serves. [default: finds out, some five minutes]")
    ] = None,
    duration_s: Annotated[float, typer.Option(min=1, help="How long those let in are listened to.")] = 60.0,
    as_json: AsJson = False,
) -> Outcome:
    """What becomes of three times as many sessions as one core serves, when all ask at once.

    Those let in may have no late blocks and no lower quality, and all others have to be told within a second when to
    come back. They do so for half a minute.
    """
    from server.bench.overload import failures, measure_overload

    measured = measure_overload(
        scene, emitters=emitters, sessions=sessions, duration_s=duration_s, advance=_steps_told()
    )
    _report(as_json, f"Three times {measured['capacity']} sessions of {emitters} emitters at once", measured)
    figures = {name: measured[name] for name in ("admitted", "admitted_later", *_OVERLOAD)}
    return Outcome("overload", figures, tuple(failures(measured)))


@app.command()
def effects(
    as_json: AsJson = False,
    markdown: Annotated[bool, typer.Option("--markdown", help="Print a table for a README.")] = False,
) -> Outcome:
    """How much time a plan of effects saves, and how large its error is, in six situations."""
    require_at_most_one({"--json": as_json, "--markdown": markdown})
    from server.bench.effects import SCENARIOS, measure_effects
    from server.bench.effects_table import markdown_table, terminal_rows
    from server.bench.machine import describe_machine, instruction_set, processor

    with _progress(len(SCENARIOS)) as advance:
        measured = measure_effects(SCENARIOS, advance)
    if as_json:
        print_json({"host": describe_machine(), "situations": measured})
    elif markdown:
        typer.echo(markdown_table(measured))
        typer.echo(f"\n{processor()}, {instruction_set()}")
    else:
        print_measures("Host", describe_machine())
        print_rows("Effects by plan, beside all of them and none", terminal_rows(measured))
    return Outcome("effects", {f"{each['situation']}, {name}": each[name] for each in measured for name in _BY_PLAN})


@app.command()
def listen(
    url: Annotated[str, typer.Option(help="The server's stream.")] = "ws://127.0.0.1:8000/v1/stream",
    scene: Annotated[str, typer.Option(help="Id of a scene it serves.")] = "apartment",
    emitters: Annotated[int, typer.Option(min=1, help="Emitters that sound.")] = 2,
    duration_s: Annotated[float, typer.Option(min=1, help="How long to listen.")] = 60.0,
    poses_per_second: Annotated[float, typer.Option(min=0.1, help="How often the listener moves.")] = 30.0,
    as_json: AsJson = False,
) -> Outcome:
    """Listen to a running server while walking in circles: late blocks and pose-to-sound latency."""
    from websockets.exceptions import WebSocketException

    from server.bench import listen as one_stream
    from server.bench.machine import describe_machine

    try:
        import asyncio

        measured = asyncio.run(one_stream.listen(url, scene, emitters, duration_s, poses_per_second))
    except (OSError, WebSocketException) as exc:
        raise NafirError(f"{url}: {exc}") from exc
    _report(as_json, f"One stream of {url}", {"listener_host": describe_machine(), **measured})
    return Outcome("listen", {name: value for name, value in measured.items() if isinstance(value, int | float)})


def _steps_told() -> Callable[[str], None]:
    """A callback that prints a line for each step, for runs whose number of steps is unknown."""
    from rich.console import Console

    console, began_s = Console(stderr=True), time.monotonic()
    return lambda step: console.print(f"{time.monotonic() - began_s:6.0f} s  {step}", highlight=False)


@contextmanager
def _progress(total: int) -> Iterator[Callable[[str], None]]:
    """A progress bar that is redrawn only between measurements, since a thread that redraws would affect them."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=Console(stderr=True), transient=True, auto_refresh=False) as progress:
        task = progress.add_task("", total=total)
        yield lambda step: progress.update(task, advance=1, description=step, refresh=True)


def _report(as_json: bool, title: str, measured: dict[str, Any]) -> None:
    if as_json:
        print_json(measured)
    else:
        print_measures(title, measured)


def _print_convolver(measured: dict[str, Any], judgements: list[Judgement]) -> None:
    print_measures("Host", measured["host"])
    cases = measured["cases"]
    title = "Source-seconds per CPU-second: ours, pedalboard's (peer), oaconvolve's (SciPy)"
    print_rows(title, [{head: case[name] for head, name in {**_CASE, **_ALONE}.items()} for case in cases])
    if shared := [case for case in cases if case["sources"] > 1]:
        columns = {**_CASE, **_SHARED}
        print_rows("With a shared tail", [{head: case[name] for head, name in columns.items()} for case in shared])
    fades, splatter, drift = measured["fade_cost_ratio"], measured["splatter_db"], measured["drift"]
    print_measures(
        "Exchanges, drift, threads, start",
        {
            **{f"splatter above 4 kHz, {name}, dB": level for name, level in splatter.items()},
            **{f"cost of exchanging every block, {sources} sources": ratio for sources, ratio in fades.items()},
            f"error after {drift['duration_s']:.0f} s (in the first), dB": (
                f"{drift['last_second_error_db']:.1f} ({drift['first_second_error_db']:.1f})"
            ),
            **{name: measured[name] for name in ("threads_scale", "warm_start_s", "cold_start_s")},
        },
    )
    print_judgements("Goals", judgements)


def _print_sessions(measured: dict[str, Any], judgements: list[Judgement]) -> None:
    print_measures("Host", measured["host"])
    print_rows("Scenes", measured["scenes"])
    for case in measured["cases"]:
        rows = {name: value for name, value in case.items() if name not in {"scene", "emitters", "trials"}}
        again = {name: rows.pop(name) for name in case if name.startswith("with_")}
        for name, measures in {"": rows, **again}.items():
            title = f"{case['scene']}, {case['emitters']} emitters {name}".replace("_", " ")
            print_measures(title, {**measures, "behind_s": max(measures.get("behind_s", ()), default=None)})
    print_judgements("Goals", judgements)


_TIMES = ("ms_p50", "ms_p99")
_BY_PLAN = ("plan_us", "ratio", "error_jnd")
"""Figures of each level, and of each situation, that go into a history."""

_CASE = {"block": "block_size", "ir s": "ir_s", "sources": "sources"}
_ALONE = {
    "ours": "x_realtime",
    "peer": "peer_x_realtime",
    "ratio": "ratio",
    "SciPy": "oaconvolve_x_realtime",
    "error dB": "max_error_db",
    "worst / mean": "worst_to_mean_block",
}
_SHARED = {
    "ours": "shared_tail_x_realtime",
    "ratio": "shared_tail_ratio",
    "worst / mean": "shared_tail_worst_to_mean_block",
}
"""Columns of tables: short headings and the keys of their values."""
