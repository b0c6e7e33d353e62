"""Walk through a scene and store the sound.

    pip install numpy soundfile websockets
    python walk.py --url ws://127.0.0.1:8000/v1/stream -o heard.wav

Connects to a Nafir server, plays a clip where the scene suggests, and walks from the scene's starting place through its
openings towards the clip while looking around. It writes two files: the sound as it arrived, and the path as it was
heard. For each pose, the path has the sample from which on the direct sound was heard from it, the sample for the
reverberation, which follows later and skips poses, and the quality level. `nafir render` makes the same sound from that
path, to the sample.
"""

import argparse
import asyncio
import csv
import json
import math
import statistics
import struct
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import soundfile
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

POSE = struct.Struct("<BBHI7f")  # kind 2, two paddings, pose id, position, orientation
BLOCK = struct.Struct("<BBHIQIII")  # kind 1, flags, channels, sequence, sample clock, pose ids, frames
PROTOCOL = 3
POSES_PER_SECOND = 30
BLOCK_SIZE = 256
EFFECTS = [
    "direct_path",
    "distance_attenuation",
    "propagation_delay",
    "air_absorption",
    "occlusion",
    "directivity",
    "hrtf",
    "early_reflections",
    "late_reverberation",
    "diffraction",
    "per_source_tail",
    "head_rotation",
]
"""All effects are on, so that an offline render has the same samples; a game leaves them to the server's plan."""


def as_float32(numbers: tuple[float, ...]) -> tuple[float, ...]:
    """Rounds numbers as the wire format does, so that the path file has exactly what the server got."""
    return tuple(float(np.float32(number)) for number in numbers)


@dataclass(frozen=True)
class Pose:
    """A position in metres, and a unit quaternion (x, y, z, w); the identity looks along +x."""

    position: tuple[float, ...]
    orientation: tuple[float, ...]

    @classmethod
    def looking(cls, position: tuple[float, float, float], yaw: float) -> "Pose":
        return cls(as_float32(position), as_float32((0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))))

    def to_bytes(self, pose_id: int) -> bytes:
        return POSE.pack(2, 0, 0, pose_id, *self.position, *self.orientation)


class Walk:
    """A walk along straight lines between waypoints, at constant speed, which takes `duration_s`."""

    def __init__(self, waypoints: list[tuple[float, float, float]], duration_s: float) -> None:
        self.duration_s = duration_s
        self._points = np.array(waypoints)
        self._steps = np.linalg.norm(np.diff(self._points, axis=0), axis=1)

    @classmethod
    def through(cls, scene: dict, duration_s: float) -> "Walk":
        """From the scene's starting place through every opening, to a metre before the emitter."""
        start, goal = scene["listener"]["position"], np.array(scene["emitter"]["position"])
        doors = [
            [(opening["start"][axis] + opening["end"][axis]) / 2 for axis in (0, 1)] + [start[2]]
            for opening in scene["openings"]
        ]
        last = np.array(doors[-1] if doors else start)
        stop = goal + (last - goal) / max(1.0, float(np.linalg.norm(last - goal)))
        return cls([tuple(point) for point in (start, *doors, stop.tolist())], duration_s)

    def pose_at(self, time_s: float) -> Pose:
        """The listener looks ahead, and up to 40 degrees to either side, once every four seconds."""
        walked = np.clip(time_s / self.duration_s, 0, 1) * self._steps.sum()
        ends = np.cumsum(self._steps)
        leg = min(int(np.searchsorted(ends, walked)), len(ends) - 1)
        here, there = self._points[leg], self._points[leg + 1]
        share = 1 - (ends[leg] - walked) / max(self._steps[leg], 1e-9)
        heading = math.atan2(there[1] - here[1], there[0] - here[0])
        glance = math.radians(40) * math.sin(2 * math.pi * time_s / 4)
        return Pose.looking(tuple(here + share * (there - here)), heading + glance)


@dataclass
class Recording:
    """Blocks by sample clock, and the samples from which on each pose and each quality level was heard."""

    sample_rate: int
    levels: dict[int, str]
    """Quality level by its first sample."""
    start: int | None = None
    """The sample at which the clip begins."""
    blocks: list[tuple[int, np.ndarray]] = field(default_factory=list)
    direct: dict[int, int] = field(default_factory=dict)
    """First sample of the direct sound by pose id."""
    reverberation: dict[int, int] = field(default_factory=dict)
    """Pose id by the first sample of its reverberation."""
    late: int = 0

    @property
    def samples_heard(self) -> int:
        return 0 if self.start is None or not self.blocks else self.blocks[-1][0] + BLOCK_SIZE - self.start

    def add(self, data: bytes) -> tuple[int, int, int]:
        """Stores a block. Returns its sequence number, and the pose ids of its direct sound and its reverberation."""
        _, flags, channels, sequence, clock, pose, reverberation_pose, frames = BLOCK.unpack_from(data)
        self.blocks.append((clock, np.frombuffer(data, "<f4", offset=BLOCK.size).reshape(frames, channels)))
        self.late += bool(flags & 2)
        if self.start is not None:
            self.direct.setdefault(pose, clock)
            if reverberation_pose != next(reversed(self.reverberation.values()), None):
                self.reverberation[clock] = reverberation_pose
        return sequence, pose, reverberation_pose

    def samples(self) -> np.ndarray:
        """(frame, channel) samples from sample 0 on, with silence where the server skipped blocks."""
        last, block = self.blocks[-1]
        samples = np.zeros((last + len(block), block.shape[1]), np.float32)
        for sample, block in self.blocks:
            samples[sample : sample + len(block)] = block
        return samples

    def change_level(self, level: str, sample: int) -> None:
        """Records the level that is heard from a sample on."""
        if level != next(reversed(self.levels.values())):  # otherwise only the rate of responses has changed
            self.levels[sample] = level

    def path(self) -> list[tuple[int, int, int | str, str]]:
        """Pose id, sample of the direct sound, and sample and level of the reverberation (or empty), in rising order.

        A pose whose reverberation was heard at two levels has two rows.
        """
        heard: dict[int, list[tuple[int, str]]] = {}
        pose, level = None, ""
        for sample in sorted(self.reverberation.keys() | self.levels.keys()):
            pose, level = self.reverberation.get(sample, pose), self.levels.get(sample, level)
            if pose is not None:
                heard.setdefault(pose, []).append((sample, level))
        rows: list[tuple[int, int, int | str, str]] = []
        for pose in sorted(self.direct.keys() | heard.keys()):
            # A pose that a newer one replaced within a block was never heard directly. It gets the sample of the newer
            # one, whose row comes later and counts.
            sample = self.direct.get(pose, min(at for newer, at in self.direct.items() if newer >= pose))
            rows += [(pose, sample, *reverberation) for reverberation in heard.get(pose, [("", "")])]
        return rows


def say(change: dict, sample_rate: int) -> None:
    """Prints a `level_changed`."""
    at_s, rate_hz = change["sample_clock"] / sample_rate, change["ir_rate_hz"]
    pace = "with every pose" if rate_hz is None else f"at most {rate_hz:g} times a second"
    why = {"chosen": "as chosen", "load": "the server is under load", "recovered": "the server has recovered"}
    print(f"{at_s:.2f} s: level {change['level']}, responses {pace}: {why.get(change['reason'], change['reason'])}")


async def send_poses(socket: ClientConnection, walk: Walk, poses: dict[int, Pose], sent_s: dict[int, float]) -> None:
    started_s = time.monotonic()
    for step in range(1, round(walk.duration_s * POSES_PER_SECOND) + 1):
        time_s, pose_id = step / POSES_PER_SECOND, step + 1
        await asyncio.sleep(started_s + time_s - time.monotonic())
        poses[pose_id] = walk.pose_at(time_s)
        sent_s[pose_id] = time.monotonic()
        try:
            await socket.send(poses[pose_id].to_bytes(pose_id))
        except ConnectionClosed:
            return  # the receiving task sees this too, and reports it


async def listen(arguments: argparse.Namespace) -> None:
    # Without compression, which takes time and does not make audio smaller.
    async with connect(arguments.url, compression=None, max_size=None) as socket:
        hello = {
            "type": "hello",
            "protocol": PROTOCOL,
            "scene": arguments.scene,
            "block_size": BLOCK_SIZE,
            "encoding": "f32",
            "level": arguments.level,
            "effects": dict.fromkeys(EFFECTS, True),
        }
        await socket.send(json.dumps(hello))
        welcome = json.loads(await socket.recv())
        if welcome["type"] == "error":
            raise SystemExit(f"{welcome['code']}: {welcome['message']}")
        print(f"level {welcome['level']}")
        scene = welcome["scene"]
        walk = Walk.through(scene, arguments.seconds)
        recording = Recording(welcome["sample_rate"], {0: welcome["level"]})
        # The pose is sent before the clip is added, so that the clip begins with this pose and not with the scene's.
        poses = {1: walk.pose_at(0)}
        await socket.send(poses[1].to_bytes(1))
        emitter = {"id": "clip", "clip": arguments.clip, "position": scene["emitter"]["position"]}
        await socket.send(json.dumps({"type": "add_emitter", **emitter}))

        sent_s: dict[int, float] = {}
        direct_s: dict[int, float] = {}
        reverberation_s: dict[int, float] = {}
        walking = None
        while recording.samples_heard < arguments.seconds * recording.sample_rate:
            message = await socket.recv()
            if isinstance(message, bytes):
                if message[:1] != b"\x01":
                    continue  # not a block, but a kind of message from a newer server
                sequence, pose, reverberation_pose = recording.add(message)
                direct_s.setdefault(pose, time.monotonic())
                reverberation_s.setdefault(reverberation_pose, time.monotonic())
                if sequence % 4 == 3:
                    await socket.send(json.dumps({"type": "acknowledge", "sequence": sequence}))
                continue
            event = json.loads(message)
            if event["type"] == "emitter_added":
                recording.start = event["sample_clock"]
                walking = asyncio.create_task(send_poses(socket, walk, poses, sent_s))
            elif event["type"] == "level_changed":
                recording.change_level(event["level"], event["sample_clock"])
                say(event, recording.sample_rate)
            elif event["type"] == "error":
                raise SystemExit(f"{event['code']}: {event['message']}")
        if walking is not None:
            walking.cancel()

    write(arguments, recording, poses)
    x, y, z = scene["emitter"]["position"]
    for part, arrived_s in (("direct sound", direct_s), ("reverberation", reverberation_s)):
        delays_ms = [1000 * (arrived_s[pose] - sent_s[pose]) for pose in arrived_s.keys() & sent_s.keys()]
        if delays_ms:
            print(
                f"{part}: {len(delays_ms)} poses, each received {statistics.median(delays_ms):.0f} ms after it was sent"
            )
    print(f"{recording.late} blocks late")
    print(
        f"Render it again:\n  nafir render {arguments.scene} --effects all "
        f"--emitter {arguments.clip}@{x:g},{y:g},{z:g} --loop "
        f"--path {arguments.path} --duration-s {len(recording.samples()) / recording.sample_rate:.6f} -o again.wav"
    )


def write(arguments: argparse.Namespace, recording: Recording, poses: dict[int, Pose]) -> None:
    samples, path = recording.samples(), recording.path()
    soundfile.write(arguments.output, samples, recording.sample_rate, subtype="FLOAT")
    with arguments.path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["sample", "reverberation_sample", "level", "x", "y", "z", "qx", "qy", "qz", "qw"])
        for pose_id, *clocks in path:
            writer.writerow([*clocks, *poses[pose_id].position, *poses[pose_id].orientation])
    print(f"{arguments.output}: {len(samples) / recording.sample_rate:.2f} s; {arguments.path}: {len(path)} poses")


def main() -> None:
    parser = argparse.ArgumentParser(description="Walk through a scene and store the sound.")
    parser.add_argument("--url", default="ws://127.0.0.1:8000/v1/stream")
    parser.add_argument("--scene", default="apartment")
    parser.add_argument("--clip", default="woman-reading", help="one of GET /v1/clips")
    parser.add_argument("--level", default="auto", help="a quality level of GET /v1/scenes/SCENE/frontier")
    parser.add_argument("--seconds", type=float, default=12.0, help="how long the walk takes")
    parser.add_argument("-o", "--output", type=Path, default=Path("heard.wav"))
    parser.add_argument("--path", type=Path, help="CSV of the path as heard (default: path.csv beside the output)")
    arguments = parser.parse_args()
    arguments.path = arguments.path or arguments.output.with_name("path.csv")
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
