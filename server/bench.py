"""`nafir bench`: what things cost on this host. Medians of several rounds; run it on an idle machine."""

import asyncio
import json
import math
import statistics
import time
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from server.errors import NafirError

if TYPE_CHECKING:
    from server.acoustics.geometry import Vector3
    from server.protocol import AddEmitter, ListenerPose, Welcome

app = typer.Typer(help="Measure what things cost on this host.", no_args_is_help=True)

Scene = Annotated[str, typer.Argument(help="Id of a bundled scene, or the folder of any scene bundle.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]

_TURN_S = 12.0
_ACKNOWLEDGE_EVERY = 4


@app.command()
def field(
    scene: Scene = "apartment",
    rounds: Annotated[int, typer.Option(min=1, help="Rounds, of which the median counts.")] = 20,
    poses: Annotated[int, typer.Option(min=1, help="Random poses per round.")] = 20,
    as_json: AsJson = False,
) -> None:
    """Time from a pose to a binaural impulse response, one at a time on one core."""
    from server.field.field import AcousticField
    from server.scene.bundle import Bundle, find_bundle

    acoustic_field = AcousticField.load(Bundle.load(find_bundle(scene)), threads=1)
    bounds = acoustic_field.bundle.manifest.bounds
    rng = np.random.default_rng(0)
    places = rng.uniform(bounds.minimum, bounds.maximum, (10 * poses, 3))
    places = places[acoustic_field.bundle.floor_plan.contains(places)]
    times_ms: list[list[float]] = []
    for _ in range(rounds + 1):
        times_ms.append([])
        for _ in range(poses):
            listener, emitter = rng.choice(places, 2)
            started_s = time.perf_counter()
            acoustic_field.impulse_responses([listener], [emitter], [rng.uniform(-math.pi, math.pi)])
            times_ms[-1].append((time.perf_counter() - started_s) * 1000)
    measured = times_ms[1:]  # the first round warms up
    _report(
        as_json,
        f"One impulse response of scene {acoustic_field.bundle.id}",
        {
            "ir_s": acoustic_field.ir_samples / acoustic_field.sample_rate,
            "rounds": rounds,
            "poses": poses,
            "median_ms": statistics.median(statistics.median(times) for times in measured),
            "p99_ms": float(np.percentile(np.concatenate(measured), 99)),
        },
    )


@app.command()
def stream(
    url: Annotated[str, typer.Option(help="The server's stream.")] = "ws://127.0.0.1:8000/v1/stream",
    scene: Annotated[str, typer.Option(help="Id of a scene it serves.")] = "apartment",
    emitters: Annotated[int, typer.Option(min=1, help="Emitters that sound.")] = 2,
    duration_s: Annotated[float, typer.Option(min=1, help="How long to listen.")] = 60.0,
    poses_per_second: Annotated[float, typer.Option(min=0.1, help="How often the listener moves.")] = 30.0,
    as_json: AsJson = False,
) -> None:
    """Listen to a running server while walking in circles: late blocks, and the time from a pose to its sound."""
    from websockets.exceptions import WebSocketException

    try:
        measured = asyncio.run(_listen(url, scene, emitters, duration_s, poses_per_second))
    except (OSError, WebSocketException) as exc:
        raise NafirError(f"{url}: {exc}") from exc
    _report(as_json, f"One stream of {url}", measured)


async def _listen(url: str, scene: str, emitters: int, duration_s: float, poses_per_second: float) -> dict[str, Any]:
    from websockets.asyncio.client import connect

    from server.protocol import (
        PROTOCOL,
        Acknowledge,
        AudioBlock,
        Error,
        Hello,
        Welcome,
        parse_server_message,
    )

    async with connect(url, compression=None) as socket:
        await socket.send(Hello(protocol=PROTOCOL, scene=scene).serialize())
        answer = parse_server_message(str(await socket.recv()))
        if not isinstance(answer, Welcome):
            raise NafirError(f"{url} does not serve {scene}: {answer.serialize()}")
        for emitter in _sounding(answer, emitters):
            await socket.send(emitter.serialize())
        blocks = blocks_skipped = exchanges = pose_id = next_clock = 0
        late_at_s: list[float] = []
        sent_s: dict[int, float] = {}
        waits_ms: list[float] = []
        errors: list[str] = []
        started_s = now_s = time.monotonic()
        while now_s - started_s < duration_s:
            message = await socket.recv()
            now_s = time.monotonic()
            if isinstance(message, str):
                event = parse_server_message(message)
                errors += [event.code] if isinstance(event, Error) else []
                continue
            block = AudioBlock.parse(message, answer.encoding)
            blocks += 1
            blocks_skipped += (block.sample_clock - next_clock) // answer.block_size
            next_clock = block.sample_clock + answer.block_size
            late_at_s += [round(now_s - started_s, 1)] if block.is_late else []
            exchanges += block.is_exchange
            heard = [number for number in sent_s if number <= block.pose_id]
            waits_ms += [(now_s - sent_s.pop(number)) * 1000 for number in heard]
            if blocks % _ACKNOWLEDGE_EVERY == 0:
                await socket.send(Acknowledge(sequence=block.sequence).serialize())
            if now_s - started_s > pose_id / poses_per_second:
                pose_id += 1
                sent_s[pose_id] = now_s
                await socket.send(
                    _walking(pose_id, answer.scene.listener.position, now_s - started_s).serialize_binary()
                )
    return {
        "emitters": emitters,
        "duration_s": round(now_s - started_s, 1),
        "blocks": blocks,
        "blocks_skipped": blocks_skipped,
        "blocks_late": len(late_at_s),
        "late_at_s": late_at_s,
        "ir_exchanges": exchanges,
        "poses": pose_id,
        "pose_to_block_median_ms": statistics.median(waits_ms) if waits_ms else None,
        "pose_to_block_p99_ms": float(np.percentile(waits_ms, 99)) if waits_ms else None,
        "errors": errors,
    }


def _sounding(welcome: "Welcome", count: int) -> "list[AddEmitter]":
    """Clips in turn, and in turn where the scene's own emitter is and where a visitor starts: two differ in both."""
    from server.clips import ClipLibrary
    from server.protocol import AddEmitter

    clips = ClipLibrary(welcome.sample_rate).names
    places = welcome.scene.emitter.position, welcome.scene.listener.position
    return [
        AddEmitter(id=str(number), clip=clips[number % len(clips)], position=places[number % len(places)])
        for number in range(count)
    ]


def _walking(pose_id: int, centre: "Vector3", time_s: float) -> "ListenerPose":
    """A circle of half a metre around where a visitor starts, looking about."""
    from server.protocol import ListenerPose

    angle = 2 * math.pi * time_s / _TURN_S
    position = (centre[0] + 0.5 * math.cos(angle), centre[1] + 0.5 * math.sin(angle), centre[2])
    return ListenerPose(pose_id=pose_id, position=position, yaw=math.remainder(angle, 2 * math.pi))


def _report(as_json: bool, title: str, measured: dict[str, Any]) -> None:
    if as_json:
        typer.echo(json.dumps(measured))
        return
    table = Table("measure", "value", title=title)
    for name, value in measured.items():
        table.add_row(name.replace("_", " "), f"{value:.3g}" if isinstance(value, float) else str(value))
    Console().print(table)
