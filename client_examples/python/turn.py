"""Turn the head without the server, and store what the ears hear.

    pip install numpy soundfile websockets
    python turn.py --url ws://127.0.0.1:8000/v1/stream --scene SCENE -o heard.wav

Connects to a Nafir server for an ambisonic stream, and plays a clip where the scene suggests. The listener stands still
and looks around, once in a circle. The server hears nothing of that: every block is turned here, by the orientation
that the head has at that moment, and decoded to two ears with the head's filters, which the server gives over HTTP.

The scene has to know from where sound arrives. Those that do have `directional_levels` in GET /v1/scenes.
"""

import argparse
import asyncio
import io
import json
import math
import struct
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path

import numpy as np
import soundfile
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus, WebSocketException

BLOCK = struct.Struct("<BBHIQIII")  # kind 1, flags, channels, sequence, sample clock, pose ids, frames
PROTOCOL = 3
BLOCK_SIZE = 256
SAMPLED = np.random.default_rng(0).standard_normal((64, 3))
SAMPLED /= np.linalg.norm(SAMPLED, axis=1, keepdims=True)


def harmonics(directions: np.ndarray, order: int) -> np.ndarray:
    """(n, (order + 1)**2) gains of the channels for plane waves from unit vectors (n, 3): ACN order, SN3D norm."""
    x, y, z = directions.T
    r, s, t, u = math.sqrt(3), math.sqrt(5 / 8), math.sqrt(3 / 8), math.sqrt(15)
    first = [np.ones_like(x), y, z, x]
    second = [r * x * y, r * y * z, (3 * z * z - 1) / 2, r * x * z, r * (x * x - y * y) / 2]
    third = [
        s * y * (3 * x * x - y * y),
        u * x * y * z,
        t * y * (5 * z * z - 1),
        z * (5 * z * z - 3) / 2,
        t * x * (5 * z * z - 1),
        u * z * (x * x - y * y) / 2,
        s * x * (x * x - 3 * y * y),
    ]
    return np.stack([*first, *second, *third][: (order + 1) ** 2], axis=1)


def rotation(orientation: tuple[float, float, float, float], order: int) -> np.ndarray:
    """The matrix from channels in the axes of the scene to those in the axes of a head with this orientation.

    A rotation makes each channel of the head a sum of the scene's. What the channels are for a few directions, in both
    axes, says which sum.
    """
    x, y, z, w = orientation
    ahead = [1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)]
    left = [2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)]
    up = [2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)]
    in_head = SAMPLED @ np.array([ahead, left, up]).T
    return np.linalg.lstsq(harmonics(SAMPLED, order), harmonics(in_head, order), rcond=None)[0].T


class Ears:
    """Two ears that hear ambisonic blocks through `filters` (ear, channel, tap)."""

    def __init__(self, filters: np.ndarray, order: int) -> None:
        self._filters = filters
        self._order = order
        self._matrix = rotation((0.0, 0.0, 0.0, 1.0), order)
        self._before = np.zeros((filters.shape[1], filters.shape[2] - 1))
        """The samples of the channels that the filters still reach back to, in the axes of the head."""

    def hear(self, block: np.ndarray, orientation: tuple[float, float, float, float]) -> np.ndarray:
        """(frame, 2) what is heard of a block (frame, channel) while the head turns from its last orientation to this
        one."""
        matrix = rotation(orientation, self._order)
        share = (np.arange(len(block)) + 1) / len(block)  # in steps, since a jump would click
        turned = (1 - share) * (self._matrix @ block.T) + share * (matrix @ block.T)
        self._matrix = matrix
        reached = np.concatenate([self._before, turned], axis=1)
        self._before = reached[:, len(block) :]
        ears = [
            sum(np.convolve(channel, taps, "valid") for channel, taps in zip(reached, ear, strict=True))
            for ear in self._filters
        ]
        return np.stack(ears, axis=1).astype(np.float32)


def fetch_filters(stream_url: str, head: str, order: int, sample_rate: int) -> np.ndarray:
    """(ear, channel, tap) the filters by which a head hears ambisonic channels."""
    scheme, rest = stream_url.split("://", 1)
    base = {"ws": "http", "wss": "https"}[scheme] + "://" + rest.removesuffix("/stream")
    query = urllib.parse.urlencode({"order": order, "sample_rate": sample_rate, "format": "npy"})
    try:
        with urllib.request.urlopen(f"{base}/hrtfs/{urllib.parse.quote(head, safe='')}/decoder?{query}") as answer:
            return np.load(io.BytesIO(answer.read()), allow_pickle=False)
    except urllib.error.HTTPError as exc:
        problem = json.load(exc)
        raise SystemExit(f"{problem['code']}: {problem['detail']}") from exc


def orientation_at(time_s: float, duration_s: float, start_yaw: float) -> tuple[float, float, float, float]:
    """A head that turns once to the left, counter-clockwise, while it nods by ten degrees."""
    yaw, pitch = start_yaw + 2 * math.pi * time_s / duration_s, math.radians(10) * math.sin(2 * math.pi * time_s / 2)
    about_z, about_y = (math.sin(yaw / 2), math.cos(yaw / 2)), (-math.sin(pitch / 2), math.cos(pitch / 2))
    # The product of both quaternions: first the pitch, then the yaw.
    return (
        -about_z[0] * about_y[0],
        about_z[1] * about_y[0],
        about_z[0] * about_y[1],
        about_z[1] * about_y[1],
    )


async def listen(arguments: argparse.Namespace) -> None:
    # Without compression, which takes time and does not make audio smaller.
    async with connect(arguments.url, compression=None, max_size=None) as socket:
        hello = {"protocol": PROTOCOL, "scene": arguments.scene, "block_size": BLOCK_SIZE, "encoding": "f32"}
        wishes = {"output": "ambisonics", "order": arguments.order}
        await socket.send(json.dumps({"type": "hello", **hello, **wishes}))
        welcome = json.loads(await socket.recv())
        if welcome["type"] == "error":
            raise SystemExit(f"{welcome['code']}: {welcome['message']}")
        rate, order, scene = welcome["sample_rate"], welcome["order"], welcome["scene"]
        ears = Ears(await asyncio.to_thread(fetch_filters, arguments.url, arguments.head, order, rate), order)
        emitter = {"id": "clip", "clip": arguments.clip, "position": scene["emitter"]["position"]}
        await socket.send(json.dumps({"type": "add_emitter", **emitter}))

        start, next_clock = None, 0
        received: list[np.ndarray] = []
        heard: list[np.ndarray] = []
        while len(heard) * BLOCK_SIZE < arguments.seconds * rate:
            message = await socket.recv()
            if isinstance(message, bytes):
                if message[:1] != b"\x01":
                    continue  # not a block, but a kind of message from a newer server
                _, _, channels, sequence, clock, _, _, frames = BLOCK.unpack_from(message)
                if sequence % 4 == 3:
                    await socket.send(json.dumps({"type": "acknowledge", "sequence": sequence}))
                if start is None or clock < start:
                    continue
                block = np.frombuffer(message, "<f4", offset=BLOCK.size).reshape(frames, channels)
                skipped = (clock - max(next_clock, start)) // frames
                for each in [np.zeros_like(block)] * skipped + [block]:
                    time_s = (len(heard) + 1) * BLOCK_SIZE / rate
                    head = orientation_at(time_s, arguments.seconds, scene["listener"]["yaw"])
                    heard.append(ears.hear(each, head))
                    received.append(each)
                next_clock = clock + frames
                continue
            event = json.loads(message)
            if event["type"] == "emitter_added":
                start = event["sample_clock"]
            elif event["type"] == "error":
                raise SystemExit(f"{event['code']}: {event['message']}")

    soundfile.write(arguments.output, np.concatenate(heard), rate, subtype="FLOAT")
    print(f"{arguments.output}: {len(heard) * BLOCK_SIZE / rate:.2f} s through the head {arguments.head}")
    if arguments.received:
        soundfile.write(arguments.received, np.concatenate(received), rate, subtype="FLOAT")
        print(f"{arguments.received}: ambisonics of order {order}, in the axes of the scene")


def main() -> None:
    parser = argparse.ArgumentParser(description="Turn the head without the server, and store what the ears hear.")
    parser.add_argument("--url", default="ws://127.0.0.1:8000/v1/stream")
    parser.add_argument("--scene", default="open-field", help="one that knows directions")
    parser.add_argument("--clip", default="woman-reading", help="one of GET /v1/clips")
    parser.add_argument("--head", default="kemar", help="one of GET /v1/hrtfs")
    parser.add_argument("--order", type=int, default=1, choices=(1, 2, 3), help="of the ambisonics")
    parser.add_argument("--seconds", type=float, default=8.0, help="how long the turn takes")
    parser.add_argument("-o", "--output", type=Path, default=Path("heard.wav"))
    parser.add_argument("--received", type=Path, help="file for the ambisonics as they arrived (AmbiX)")
    arguments = parser.parse_args()
    try:
        asyncio.run(listen(arguments))
    except InvalidStatus as exc:
        if exc.response.status_code != 503:
            raise SystemExit(f"{arguments.url}: {exc}") from exc
        # The server has no room for another stream, and says when it is worth to come back.
        raise SystemExit(f"{arguments.url}: {json.loads(exc.response.body or b'{}').get('detail', exc)}") from exc
    except (OSError, WebSocketException) as exc:
        raise SystemExit(f"{arguments.url}: {exc}") from exc


if __name__ == "__main__":
    main()
