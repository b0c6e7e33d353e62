"""Send live sound to a scene, and store the sound that comes back.

    pip install numpy soundfile soxr websockets
    python live.py --input voice.wav --url ws://127.0.0.1:8000/v1/stream -o wet.wav

Connects to a Nafir server, adds a live emitter where the scene suggests, and sends it a recording block by block, as a
microphone would (claps, if there is no recording). The sound that comes back is the recording as heard from the scene's
starting place. It is written to a file.
"""

import argparse
import asyncio
import json
import struct
from pathlib import Path

import numpy as np
import soundfile
import soxr
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus, WebSocketException

DRY = struct.Struct("<BBHII")  # kind 3, encoding 0 (f32), bytes of the id, sequence, frames; then id and frames
WET = struct.Struct("<BBHIQIII")  # kind 1, flags, channels, sequence, sample clock, pose ids, frames
PROTOCOL = 3
BLOCK_SIZE = 256
EMITTER = "microphone"


def dry_block(sequence: int, samples: np.ndarray) -> bytes:
    identifier = EMITTER.encode()
    padding = bytes(-len(identifier) % 4)
    header = DRY.pack(3, 0, len(identifier), sequence, len(samples))
    return header + identifier + padding + samples.astype("<f4").tobytes()


def effect(text: str) -> tuple[str, bool]:
    name, _, state = text.partition("=")
    if state not in ("on", "off"):
        raise argparse.ArgumentTypeError(f"{text!r} is neither NAME=on nor NAME=off")
    return name, state == "on"


def read(path: Path | None, sample_rate: int) -> np.ndarray:
    """(n,) samples at `sample_rate`: a recording, or two seconds of claps."""
    if path is None:
        claps = np.random.default_rng(0).standard_normal((4, sample_rate // 2)) / 8
        return (claps * np.exp(-np.arange(sample_rate // 2) / (0.01 * sample_rate))).ravel().astype(np.float32)
    try:
        samples, rate = soundfile.read(path, dtype="float32", always_2d=True)
    except soundfile.LibsndfileError as exc:
        raise SystemExit(f"{path}: {exc.error_string}") from exc
    mono = samples.mean(axis=1)
    energy = np.sum(samples**2, axis=0)
    if samples.shape[1] * np.sum(mono**2) < 0.4 * energy.mean():  # channels of opposite phase would cancel
        mono = samples[:, np.argmax(energy)]
    return soxr.resample(mono, rate, sample_rate)


def say(change: dict, sample_rate: int) -> None:
    """Prints a `level_changed`."""
    at_s, rate_hz = change["sample_clock"] / sample_rate, change["ir_rate_hz"]
    pace = "with every pose" if rate_hz is None else f"at most {rate_hz:g} times a second"
    why = {"chosen": "as chosen", "load": "the server is under load", "recovered": "the server has recovered"}
    print(f"{at_s:.2f} s: level {change['level']}, responses {pace}: {why.get(change['reason'], change['reason'])}")


async def perform(arguments: argparse.Namespace) -> None:
    # Without compression, which takes time and does not make audio smaller.
    async with connect(arguments.url, compression=None, max_size=None) as socket:
        hello = {"protocol": PROTOCOL, "scene": arguments.scene, "block_size": BLOCK_SIZE, "encoding": "f32"}
        wishes = {"level": arguments.level, "effects": dict(arguments.effect)}
        await socket.send(json.dumps({"type": "hello", **hello, **wishes}))
        welcome = json.loads(await socket.recv())
        if welcome["type"] == "error":
            raise SystemExit(f"{welcome['code']}: {welcome['message']}")
        print(f"level {welcome['level']}")
        rate = welcome["sample_rate"]
        dry = read(arguments.input, rate)
        dry = np.pad(dry, (0, -len(dry) % BLOCK_SIZE)).reshape(-1, BLOCK_SIZE)
        emitter = {"id": EMITTER, "live": True, "position": welcome["scene"]["emitter"]["position"]}
        await socket.send(json.dumps({"type": "add_emitter", **emitter}))

        # Runs until the end of the recording has been played and has decayed.
        length = dry.size + arguments.ahead * BLOCK_SIZE + welcome["ir_samples"] + rate // 2
        wet: dict[int, np.ndarray] = {}
        start, sent, state = None, 0, None
        while start is None or max(wet, default=0) < start + length:
            message = await socket.recv()
            if isinstance(message, bytes):
                if message[:1] != b"\x01":
                    continue  # not a block, but a kind of message from a newer server
                _, _, channels, sequence, clock, _, _, frames = WET.unpack_from(message)
                if sequence % 4 == 3:
                    await socket.send(json.dumps({"type": "acknowledge", "sequence": sequence}))
                if start is None:
                    continue
                wet[clock] = np.frombuffer(message, "<f4", offset=WET.size).reshape(frames, channels)
                # Sends one block for each that it receives, because the server's clock counts.
                due = (clock - start) // BLOCK_SIZE + 1 + arguments.ahead
                for block in dry[sent:due]:
                    await socket.send(dry_block(sent, block))
                    sent += 1
                continue
            event = json.loads(message)
            if event["type"] == "emitter_added":
                start = event["sample_clock"]
            elif event["type"] == "status":
                state = event["live"] and event["live"][0]
            elif event["type"] == "level_changed":
                say(event, rate)
            elif event["type"] == "error":
                raise SystemExit(f"{event['code']}: {event['message']}")

    samples = np.zeros((length, 2), np.float32)
    for clock, block in wet.items():
        at = clock - start
        samples[at : at + len(block)] = block[: max(0, length - at)]
    soundfile.write(arguments.output, samples, rate, subtype="FLOAT")
    print(f"{arguments.output}: {length / rate:.2f} s, {dry.size / rate:.2f} s of them sent")
    if state:
        # The end of the recording is one more.
        print(f"{max(0, state['underruns'] - 1)} underruns, {state['samples_dropped']} samples dropped")


def main() -> None:
    parser = argparse.ArgumentParser(description="Send live sound to a scene, and store the sound that comes back.")
    parser.add_argument("--url", default="ws://127.0.0.1:8000/v1/stream")
    parser.add_argument("--scene", default="apartment")
    parser.add_argument("--level", default="auto", help="a quality level of GET /v1/scenes/SCENE/frontier")
    parser.add_argument(
        "--effect",
        type=effect,
        action="append",
        default=[],
        metavar="NAME=on|off",
        help="an effect to have or to leave out, whatever the server's plan says; repeatable",
    )
    parser.add_argument("--input", type=Path, help="audio file to send (default: claps)")
    parser.add_argument(
        "--ahead", type=int, default=4, help="blocks sent ahead: more for a worse network, fewer to hear them sooner"
    )
    parser.add_argument("-o", "--output", type=Path, default=Path("wet.wav"))
    arguments = parser.parse_args()
    try:
        asyncio.run(perform(arguments))
    except InvalidStatus as exc:
        if exc.response.status_code != 503:
            raise SystemExit(f"{arguments.url}: {exc}") from exc
        # The server has no room for another stream, and says when it is worth to come back.
        raise SystemExit(f"{arguments.url}: {json.loads(exc.response.body or b'{}').get('detail', exc)}") from exc
    except (OSError, WebSocketException) as exc:
        raise SystemExit(f"{arguments.url}: {exc}") from exc


if __name__ == "__main__":
    main()
