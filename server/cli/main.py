"""The `nafir` command: serve scenes, write impulse responses, render paths.

Errors that a user can correct end the process with one line and exit code 2, as wrong usage does.
"""

import contextlib
import io
import json
import os
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from server.bench import cli as bench
from server.bench.capacity_cli import plan_capacity
from server.cli import keys
from server.cli.listen import listen
from server.core.command_line import StrictTyper, figure_file, require_at_most_one, writable_file
from server.core.errors import NafirError, RequestError
from server.core.files import require_readable
from server.health.cli import check
from server.listening.cli import listening_results, listening_test
from server.rendering.partitions import BLOCK_SIZES, is_block_size
from server.runtime.memory import collect_rarely_at_start
from server.soak.cli import soak

if TYPE_CHECKING:
    import socket
    from collections.abc import Sequence

    from server.api.settings import Settings
    from server.field.field import AcousticField
    from server.offline.render import RenderedEmitter
    from server.planning.scene_acoustics import Output
    from server.runtime.service_notices import ServiceNotices
    from server.scene.bundle import Bundle

app = StrictTyper(
    name="nafir",
    help="Hear how a place sounds while you move through it.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
app.add_typer(bench.app, name="bench")
app.add_typer(keys.app, name="keys")
app.command()(plan_capacity)
app.command()(check)
app.command()(soak)
app.command()(listen)
app.command()(listening_test)
app.command()(listening_results)

Scene = Annotated[str, typer.Argument(help="Id of a bundled scene, or the folder of any scene bundle.")]
Level = Annotated[str | None, typer.Option(help="Quality level of the scene. [default: its first]", metavar="NAME")]
Doors = Annotated[
    list[str] | None,
    typer.Option(help="How far a door of the scene is open, 0 shut to 1; repeatable.", metavar="NAME=SHARE"),
]
Hrtf = Annotated[Path | None, typer.Option(help="SOFA file with the head to use instead of KEMAR.")]
Ambisonics = Annotated[
    bool, typer.Option("--ambisonics", help="AmbiX channels (ACN, SN3D) in place of two ears, in the head's axes.")
]
WorldAmbisonics = Annotated[
    bool, typer.Option("--ambisonics", help="AmbiX channels (ACN, SN3D) in place of two ears, in the scene's axes.")
]
Order = Annotated[int | None, typer.Option(help="Order of the ambisonics, 1 to 3. [default: 1]", metavar="N")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON, for programs.")]


def main() -> None:
    """Entry point of the console script."""
    collect_rarely_at_start()
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")  # to look for them, all packages are read
    # No product here is large, and threads that wait for one cost 0.2 s of processor time at the start.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        app()
    except NafirError as exc:
        from rich.console import Console
        from rich.markup import escape

        Console(stderr=True, soft_wrap=True).print(f"[bold red]error:[/] {escape(str(exc))}", highlight=False)
        sys.exit(2)


@app.command()
def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on. [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on; 0 picks one. [default: 8000]")] = None,
    bundle: Annotated[
        list[Path] | None,
        typer.Option(help="Scene bundle to serve as well, in place of a bundled scene of the same id; repeatable."),
    ] = None,
    clip: Annotated[list[Path] | None, typer.Option(help="Audio file to offer as a clip; repeatable.")] = None,
    hrtf: Annotated[
        list[Path] | None, typer.Option(help="SOFA file with a head to offer beside KEMAR; repeatable.")
    ] = None,
    processes: Annotated[
        int | None, typer.Option(help="Processes to serve with, each on an equal part of the cores. [default: 1]")
    ] = None,
) -> None:
    """Serve scenes over HTTP and WebSocket, and a page to walk through them.

    Every setting can also come from the environment: NAFIR_HOST, NAFIR_PORT, NAFIR_BUNDLES, ...
    """
    from server.api.listeners import bind, url_of
    from server.api.settings import checked_settings
    from server.runtime.logs import configure_logs
    from server.runtime.service_notices import ServiceNotices

    notices = ServiceNotices.take(os.environ)
    given = {"host": host, "port": port, "bundles": bundle, "clips": clip, "hrtfs": hrtf, "processes": processes}
    settings = checked_settings(given)
    configure_logs(settings.log_format, settings.log_level, lines_per_min=settings.log_lines_per_min)
    with contextlib.ExitStack() as opened:
        # Before the slow part, so that a port that cannot be bound is reported at once.
        listeners = [opened.enter_context(listener) for listener in bind(settings.host, settings.port)]
        url = url_of(listeners[0], settings.host)
        if settings.processes > 1:
            _serve_in_processes(settings, given, listeners, url, notices)
        from server.api.start import loaded_app
        from server.runtime.drain import Drain
        from server.runtime.memory import give_back_large_arrays

        give_back_large_arrays()
        drain = Drain(settings.drain_s)
        application, scenes = opened.enter_context(loaded_app(settings, drain))
        import uvicorn
        from rich.console import Console

        from server.api import serving

        announcement = serving.announcement(scenes, url)
        config = uvicorn.Config(application, **serving.uvicorn_options(settings))
        on_start = lambda: Console().print(announcement, highlight=False)  # noqa: E731
        serving.serve(serving.Server(config, drain, on_start=on_start, notices=notices), listeners)


def _serve_in_processes(
    settings: "Settings",
    given: Mapping[str, Any],
    listeners: "Sequence[socket.socket]",
    url: str,
    notices: "ServiceNotices",
) -> NoReturn:
    from server.api.processes import ProcessGroup, shares_of_cores

    if not hasattr(os, "sched_getaffinity"):
        raise NafirError("processes: this system cannot confine a process to cores: serve with one")
    shares = shares_of_cores(sorted(os.sched_getaffinity(0)), settings.processes)
    options = json.loads(json.dumps(given, default=str))
    group = ProcessGroup(listeners, shares, options, url=url, drain_s=settings.drain_s, notices=notices)
    sys.exit(group.run())


@app.command()
def ir(
    scene: Scene,
    listener: Annotated[str, typer.Option(help="x,y,z in metres.", metavar="X,Y,Z")],
    emitter: Annotated[str, typer.Option(help="x,y,z in metres.", metavar="X,Y,Z")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="File to write: .wav, .npy, .json or .sofa.", callback=writable_file),
    ],
    yaw_deg: Annotated[
        float | None,
        typer.Option(help="Heading of the head, counter-clockwise; 0 looks along +x. [default: 0]", metavar="DEGREES"),
    ] = None,
    pitch_deg: Annotated[
        float | None, typer.Option(help="Pitch of the head after its yaw, nose up. [default: 0]", metavar="DEGREES")
    ] = None,
    roll_deg: Annotated[
        float | None,
        typer.Option(help="Roll of the head after its pitch, right ear down. [default: 0]", metavar="DEGREES"),
    ] = None,
    orientation: Annotated[
        str | None,
        typer.Option(help="Quaternion of the head, in place of the three angles.", metavar="X,Y,Z,W"),
    ] = None,
    hrtf: Hrtf = None,
    binaural: Annotated[
        bool, typer.Option("--binaural", help="Two ears, where a scene was measured with one microphone.")
    ] = False,
    ambisonics: Ambisonics = False,
    order: Order = None,
    mono: Annotated[bool, typer.Option("--mono", help="One channel, without a head.")] = False,
    level: Level = None,
    door: Doors = None,
    as_json: AsJson = False,
) -> None:
    """Write the impulse response between two places: two ears, ambisonics or one channel."""
    from server.field.field import AcousticField
    from server.field.fields_by_level import require_level
    from server.responses.impulse_response import ImpulseResponse, IrQuery, parse_format
    from server.scene.bundle import Bundle, find_bundle

    name = parse_format(output.suffix.removeprefix("."))
    outputs = {"binaural": binaural, "ambisonics": ambisonics, "mono": mono}
    require_at_most_one({f"--{each}": is_given for each, is_given in outputs.items()})
    bundle = _with_doors(Bundle.load(find_bundle(scene)), door)
    field = AcousticField.load(bundle, level=None if level is None else require_level(bundle, level))
    query = IrQuery.of(
        field,
        listener,
        emitter,
        yaw_deg=yaw_deg,
        pitch_deg=pitch_deg,
        roll_deg=roll_deg,
        orientation=orientation,
        output=next((each for each, is_given in outputs.items() if is_given), None),
        order=order,
        hrtf=None if hrtf is None else hrtf.stem,
    )
    filters = None
    if hrtf is not None:
        from server.assets.hrtfs import HrtfLibrary

        filters = HrtfLibrary([hrtf], [field.sample_rate]).filters(hrtf.stem, field.sample_rate)
    started_s = time.perf_counter()
    response = ImpulseResponse.compute(field, query, filters)
    duration_ms = (time.perf_counter() - started_s) * 1000
    _write(output, response.encode(name))
    _report(
        as_json,
        f"{output}: {response.samples.shape[1] / response.sample_rate:.2f} s at {response.sample_rate} Hz, "
        f"computed in {duration_ms:.1f} ms",
        {
            "output": str(output),
            "scene": response.scene,
            "level": response.level,
            "sample_rate": response.sample_rate,
            "channels": list(response.channels),
            "samples": response.samples.shape[1],
            "duration_ms": round(duration_ms, 3),
        },
    )


@app.command()
def irs(
    scene: Scene,
    poses: Annotated[
        Path, typer.Argument(help="JSON: the body of POST /v1/scenes/{scene}/impulse-responses.", metavar="POSES")
    ],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="File to write: .npz, .zip of WAV or .sofa.", callback=writable_file),
    ],
    hrtf: Hrtf = None,
    as_json: AsJson = False,
) -> None:
    """Write the impulse responses of many pairs of places to one file."""
    from server.assets.hrtfs import HrtfLibrary
    from server.field.field import AcousticField
    from server.field.fields_by_level import require_level
    from server.responses.impulse_response import ImpulseResponse
    from server.responses.response_batch import BATCH_FORMATS, ResponseBatch
    from server.scene.bundle import Bundle, find_bundle
    from server.scene.door import read_openness

    name = output.suffix.removeprefix(".")
    if name not in BATCH_FORMATS:
        raise RequestError("unknown_format", f"{output}: its name ends in .{', .'.join(BATCH_FORMATS)}", field="output")
    require_readable(poses, "poses")
    batch = ResponseBatch.parse(poses.read_bytes())
    if batch.format not in {None, name}:
        raise NafirError(f"{poses}: format: is {batch.format}, and --output is {output}: leave the format out")
    bundle = Bundle.load(find_bundle(scene))
    bundle = bundle.with_doors(read_openness(bundle.doors, batch.doors or {}))
    field = AcousticField.load(bundle, level=None if batch.level is None else require_level(bundle, batch.level))
    batch = batch.model_copy(update={"format": name, "hrtf": hrtf.stem if hrtf and not batch.hrtf else batch.hrtf})
    queries = batch.queries(field)
    filters = HrtfLibrary([] if hrtf is None else [hrtf], [field.sample_rate]).filters(
        queries[0].hrtf, field.sample_rate
    )
    writer = batch.writer(queries)
    started_s = time.perf_counter()
    try:
        with output.open("wb") as file:
            for query in queries:
                file.write(writer.add(ImpulseResponse.compute(field, query, filters)))
            file.write(writer.end())
    except OSError as exc:
        raise NafirError(f"{output}: {exc.strerror}") from exc
    duration_s = time.perf_counter() - started_s
    _report(
        as_json,
        f"{output}: {len(queries)} responses, computed in {duration_s:.2f} s",
        {
            "output": str(output),
            "scene": bundle.id,
            "level": field.level.name,
            "sample_rate": field.sample_rate,
            "responses": len(queries),
            "duration_s": round(duration_s, 3),
        },
    )


@app.command()
def bundle_schema() -> None:
    """Print the JSON schema of scene.json, the manifest of a scene bundle."""
    from server.scene.manifest_schema import manifest_schema

    typer.echo(json.dumps(manifest_schema(), indent=2))


@app.command()
def sign_bundle(
    key: Annotated[Path, typer.Option(help="File of the secret key, as minisign writes it with -W.", metavar="FILE")],
    folder: Annotated[Path | None, typer.Argument(help="Folder of a scene bundle.", show_default=False)] = None,
    comment: Annotated[str, typer.Option(help="A line that is signed as well.")] = "",
    new_key: Annotated[bool, typer.Option(help="Make the key first, and FILE.pub with its public half.")] = False,
) -> None:
    """Sign a scene bundle, for servers that take signed ones alone (NAFIR_BUNDLE_KEYS)."""
    from server.scene.signatures import SigningKey, sign_bundle

    if folder is None and not new_key:
        raise NafirError("FOLDER: name the bundle to sign, or make a key with --new-key")
    if new_key:
        typer.echo(f"the public key is in {SigningKey.new().write(key)}")
    if folder is not None:
        typer.echo(f"signed: {sign_bundle(folder, SigningKey.read(key), comment)}")


@app.command()
def render(
    scene: Scene,
    emitter: Annotated[
        list[str], typer.Option(help="Clip name or audio file, and where it plays; repeatable.", metavar="CLIP@X,Y,Z")
    ],
    path: Annotated[
        Path,
        typer.Option(
            help="CSV: sample or time_s; x, y, z; qx, qy, qz, qw or yaw_deg; optionally reverberation_sample and level."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", help="WAV file to write, float32.", callback=writable_file)],
    block_size: Annotated[
        int, typer.Option(help=f"Samples per block, {BLOCK_SIZES}; poses take effect at its multiples.")
    ] = 256,
    sample_rate: Annotated[
        int | None,
        typer.Option(help="Render at this rate, as a stream may: 44100, 48000 or 96000. [default: the scene's]"),
    ] = None,
    level: Level = None,
    door: Doors = None,
    loop: Annotated[bool, typer.Option("--loop", help="Repeat the clips, as a stream does.")] = False,
    hrtf: Hrtf = None,
    effects: Annotated[
        str,
        typer.Option(
            help="all, plan (those that the walk calls for), or names separated by commas.", metavar="all|plan|NAME,..."
        ),
    ] = "plan",
    mono: Annotated[
        bool, typer.Option("--mono", help="Render one channel for one loudspeaker, without a head.")
    ] = False,
    ambisonics: WorldAmbisonics = False,
    order: Order = None,
    duration_s: Annotated[
        float | None, typer.Option(help="Length to render; by default until the reverberation has decayed.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Render to a file what a listener hears along a path."""
    import scipy.io.wavfile
    from rich.console import Console
    from rich.progress import Progress

    from server.assets.hrtfs import DEFAULT_HRTF, HrtfLibrary
    from server.field.fields_by_level import FieldsByLevel, require_level
    from server.offline.render import MAX_RENDER_S, planned_effects, read_path
    from server.offline.render import render as render_path
    from server.responses.direct_sound import DirectSound
    from server.responses.impulse_response import parse_order
    from server.scene.bundle import Bundle, find_bundle

    if not is_block_size(block_size):
        raise NafirError(f"--block-size: {block_size} is not {BLOCK_SIZES}")
    if output.suffix != ".wav":
        raise RequestError("unknown_format", f"{output}: only .wav can be written", field="output")
    require_at_most_one({"--mono": mono, "--ambisonics": ambisonics, "--hrtf": hrtf is not None})
    names = {name.strip() for name in effects.split(",")}
    require_at_most_one({"--mono": mono, "--ambisonics": ambisonics, f"--effects {effects}": "hrtf" in names})
    order = parse_order("ambisonics" if ambisonics else None, order)
    if hrtf is not None and not names & {"all", "plan", "hrtf"}:
        raise NafirError(
            f"--hrtf and --effects {effects} contradict each other: add hrtf to the effects, or leave one out"
        )
    bundle = _with_doors(Bundle.load(find_bundle(scene)), door)
    levels = FieldsByLevel.load(bundle).at_rate(sample_rate)
    if ambisonics:
        levels = levels.with_directions(level)
    field = levels.default if level is None else levels[require_level(bundle, level)]
    if duration_s is not None and not 1 / field.sample_rate <= duration_s <= MAX_RENDER_S:
        raise RequestError(
            "malformed_duration",
            f"duration-s: {duration_s:g} is not between one sample and {MAX_RENDER_S} s",
            field="duration_s",
        )
    emitters = [_read_emitter(text, field, loop=loop) for text in emitter]
    points = read_path(path, field.sample_rate, list(levels))
    if level is not None and points[0].level not in {None, level}:
        raise NafirError(
            f"--level {level} and --path contradict each other: the path begins at level {points[0].level}; "
            "leave --level out"
        )
    for number, point in enumerate(points, start=1):
        field.bundle.require_inside(point.pose.position, f"path point {number}")
    length = None if duration_s is None else round(duration_s * field.sample_rate)
    heads = HrtfLibrary([] if hrtf is None else [hrtf], {field.sample_rate, levels.own_rate})
    head = DEFAULT_HRTF if hrtf is None else hrtf.stem
    filters, field_filters = (heads.filters(head, rate) for rate in (field.sample_rate, levels.own_rate))
    heard: Output = "ambisonics" if ambisonics else "mono" if mono else "headphones"
    planned = planned_effects(effects, field, points[0].pose, output=heard, block_size=block_size)
    started_s = time.perf_counter()
    with Progress(transient=True, disable=as_json, console=Console(stderr=True)) as progress:
        task = progress.add_task("rendering", total=1.0)
        samples = render_path(
            field,
            DirectSound.of(field.bundle, filters, order=order, field_filters=field_filters),
            emitters,
            points,
            block_size=block_size,
            length=length,
            progress=lambda done: progress.update(task, completed=done),
            planned=planned,
            levels=levels,
        )
    elapsed_s = time.perf_counter() - started_s
    rendered_s = samples.shape[1] / field.sample_rate
    content = io.BytesIO()
    scipy.io.wavfile.write(content, field.sample_rate, samples.T)
    _write(output, content.getvalue())
    _report(
        as_json,
        f"{output}: {rendered_s:.2f} s at {field.sample_rate} Hz, rendered in {elapsed_s:.2f} s",
        {
            "output": str(output),
            "scene": field.bundle.id,
            "sample_rate": field.sample_rate,
            "samples": samples.shape[1],
            "rendered_s": rendered_s,
            "elapsed_s": round(elapsed_s, 3),
        },
    )


@app.command()
def plan(
    scene: Scene,
    listener: Annotated[
        str | None, typer.Option(help="x,y,z in metres. [default: where a visitor starts]", metavar="X,Y,Z")
    ] = None,
    emitter: Annotated[
        list[str] | None, typer.Option(help="x,y,z in metres; repeatable. [default: the visitor's]", metavar="X,Y,Z")
    ] = None,
    yaw_deg: Annotated[
        float, typer.Option(help="Heading of the head, counter-clockwise; 0 looks along +x.", metavar="DEGREES")
    ] = 0.0,
    still: Annotated[bool, typer.Option("--still", help="The listener neither walks nor turns the head.")] = False,
    moving: Annotated[bool, typer.Option("--moving", help="The emitters move.")] = False,
    mono: Annotated[bool, typer.Option("--mono", help="Plan for one loudspeaker instead of headphones.")] = False,
    ambisonics: Annotated[
        bool, typer.Option("--ambisonics", help="Plan for ambisonic channels instead of headphones.")
    ] = False,
    level: Level = None,
    door: Doors = None,
    effect: Annotated[
        list[str] | None, typer.Option(help="Switch an effect on or off; repeatable.", metavar="NAME=on|off")
    ] = None,
    figure: Annotated[
        Path | None, typer.Option(help="Also draw the plan to this file: .png or .svg.", callback=figure_file)
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show which effects a situation calls for, why, and what they cost on this host."""
    from server.field.field import AcousticField
    from server.field.fields_by_level import require_level
    from server.planning.plan_figure import draw
    from server.planning.plan_query import PlanDocument, PlanQuery, parse_effects, rounded
    from server.planning.plan_table import print_plan
    from server.responses.impulse_response import parse_position
    from server.scene.bundle import Bundle, find_bundle

    require_at_most_one({"--mono": mono, "--ambisonics": ambisonics})
    query = PlanQuery(
        listener=None if listener is None else parse_position(listener, "listener"),
        yaw_deg=yaw_deg,
        emitters=tuple(parse_position(text, "emitter") for text in emitter or ()),
        walks=not still,
        move=moving,
        output="ambisonics" if ambisonics else "mono" if mono else "headphones",
        effects=parse_effects(effect or ()),
    )
    bundle = _with_doors(Bundle.load(find_bundle(scene)), door)
    field = AcousticField.load(bundle, level=None if level is None else require_level(bundle, level))
    document = PlanDocument.of(field.bundle.id, query.plan(field))
    if figure is not None:
        draw(document, figure)
    if as_json:
        typer.echo(rounded(document))
    else:
        print_plan(document)


@app.command()
def protocol() -> None:
    """Print the AsyncAPI document of the live stream, which a server offers at /asyncapi.json."""
    from server.api.asyncapi import document

    typer.echo(document())


def _with_doors(bundle: "Bundle", door: list[str] | None) -> "Bundle":
    from server.responses.impulse_response import parse_doors
    from server.scene.door import read_openness

    return bundle.with_doors(read_openness(bundle.doors, parse_doors(door or ())))


def _read_emitter(text: str, field: "AcousticField", *, loop: bool) -> "RenderedEmitter":
    """Read `CLIP@x,y,z`. CLIP is the name of a bundled clip, or else an audio file."""
    from server.acoustics.geometry import Pose
    from server.assets.clips import ClipLibrary, decode
    from server.offline.render import RenderedEmitter
    from server.responses.impulse_response import parse_position

    clip, at, place = text.rpartition("@")
    if not at:
        raise RequestError("malformed_pose", f"emitter: {text!r} is not CLIP@x,y,z", field="emitter")
    position = parse_position(place, "emitter")
    field.bundle.require_inside(position, "emitter")
    clips = ClipLibrary(field.sample_rate)
    samples = clips.load(clip) if clip in clips.names else decode(Path(clip), field.sample_rate)
    return RenderedEmitter(samples, Pose(position), loop=loop)


def _write(output: Path, content: bytes) -> None:
    try:
        output.write_bytes(content)
    except OSError as exc:
        raise NafirError(f"{output}: {exc.strerror}") from exc


def _report(as_json: bool, sentence: str, document: dict[str, object]) -> None:
    if as_json:
        typer.echo(json.dumps(document))
    else:
        typer.echo(sentence)
