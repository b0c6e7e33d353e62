"""Write vectors.json: what the engines' clients have to compute, from the server's own code.

    python client_examples/vectors/make.py

`poses` are poses in Nafir's axes and the same poses in an engine's. The latter follow from where the pose's own axes
(ahead, left, up) point and from how the engine calls those directions, by rotation matrices; the clients use products
of quaternions. `messages` are binary messages of the stream. Every client's tests read this table.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from server.acoustics.geometry import Pose, Quaternion, axes_of
from server.protocol.blocks import AudioBlock, DryBlock
from server.protocol.client_messages import ListenerPose

HERE = Path(__file__).parent
_ANGLES_DEG = [(0, 0, 0), (90, 0, 0), (-90, 0, 0), (180, 0, 0), (0, 90, 0), (0, 0, 90), (45, 0, 0), (0, -30, 0)]
"""Yaw, pitch and roll of poses that can be followed in one's head; those after them are at random."""
_RANDOM_POSES = 16


@dataclass(frozen=True)
class Engine:
    """Axes of an engine. `to_world` (3, 3) has its x, y and z axes as columns, unit vectors of Nafir's world; a pose
    looks along `ahead` and has its right ear along `right` and its crown along `up`, in the engine's axes."""

    to_world: npt.NDArray[np.float64]
    ahead: tuple[int, int, int]
    right: tuple[int, int, int]
    up: tuple[int, int, int]
    units_per_m: float = 1.0

    def pose(self, pose: Pose) -> dict[str, list[float]]:
        to_engine = self.to_world.T
        ahead, left, up = axes_of(pose.orientation)
        # A rotation turns the engine's own directions to where the pose's point.
        own = np.stack([self.ahead, self.right, self.up], axis=1)
        turned = to_engine @ np.stack([ahead, -left, up], axis=1)
        rotation = Rotation.from_matrix(turned @ own.T).as_quat(canonical=True)
        position = self.units_per_m * (to_engine @ pose.position)
        return {"position": _rounded(position), "rotation": _rounded(rotation)}


EAST, NORTH, UP = np.eye(3)
_RIGHT_HANDED_Y_UP = Engine(np.stack([EAST, UP, -NORTH], axis=1), ahead=(0, 0, -1), right=(1, 0, 0), up=(0, 1, 0))
ENGINES = {
    "unity": Engine(np.stack([EAST, UP, NORTH], axis=1), ahead=(0, 0, 1), right=(1, 0, 0), up=(0, 1, 0)),
    "godot": _RIGHT_HANDED_Y_UP,
    "three": _RIGHT_HANDED_Y_UP,
    "unreal": Engine(
        np.stack([EAST, -NORTH, UP], axis=1), ahead=(1, 0, 0), right=(0, 1, 0), up=(0, 0, 1), units_per_m=100.0
    ),
}


def _rounded(values: npt.ArrayLike) -> list[float]:
    return [round(float(value), 9) + 0.0 for value in np.ravel(np.asarray(values))]


def poses() -> list[dict[str, object]]:
    random = np.random.default_rng(36)
    angles = [np.radians(each) for each in _ANGLES_DEG]
    angles += list(random.uniform(-np.pi, np.pi, (_RANDOM_POSES, 3)))
    table = []
    for yaw, pitch, roll in angles:
        pose = Pose(tuple(np.round(random.uniform(-20, 20, 3), 3)), Quaternion.from_angles(yaw, pitch, roll))
        ahead, left, up = axes_of(pose.orientation)
        own = {"position": _rounded(pose.position), "orientation": _rounded(pose.orientation)}
        directions = {"ahead": _rounded(ahead), "left": _rounded(left), "up": _rounded(up)}
        table.append({"nafir": own | directions} | {name: engine.pose(pose) for name, engine in ENGINES.items()})
    return table


def messages() -> dict[str, object]:
    random = np.random.default_rng(3)
    pose = ListenerPose(pose_id=70_000, position=(2.5, -1.25, 1.5), orientation=(0.0, 0.0, 0.6, 0.8))
    listener = {
        "pose_id": pose.pose_id,
        "position": list(pose.pose.position),
        "orientation": list(pose.pose.orientation),
        "hex": pose.serialize_binary().hex(),
    }
    dry, wet = [], []
    for encoding in ("f32", "s16"):
        # Of values that both encodings have: 32767 is full scale.
        samples = np.float32(random.integers(-32_767, 32_768, 5)) / np.float32(32_767)
        block = DryBlock("npc-ä", 9, samples)
        own = {"encoding": encoding, "id": block.id, "sequence": block.sequence}
        dry.append(own | {"samples": samples.tolist(), "hex": block.serialize(encoding).hex()})
        for channels in (1, 2, 4):
            frames = np.float32(random.integers(-32_767, 32_768, (channels, 3))) / np.float32(32_767)
            wet_block = AudioBlock(4_000_000_000, 2**40 + 5, 17, 12, frames, is_late=channels == 2)
            header = {
                "encoding": encoding,
                "sequence": wet_block.sequence,
                "sample_clock": wet_block.sample_clock,
                "pose_id": wet_block.pose_id,
                "reverberation_pose_id": wet_block.reverberation_pose_id,
                "flags": 2 if channels == 2 else 0,
            }
            wet.append(header | {"channels": frames.tolist(), "hex": wet_block.serialize(encoding).hex()})
    return {"listener": listener, "dry_blocks": dry, "audio_blocks": wet}


def table() -> str:
    """The text of vectors.json: one pose or message a line."""
    parts = messages()
    pose_lines = ",\n    ".join(json.dumps(each) for each in poses())
    lines = {
        "listener": json.dumps(parts["listener"]),
        **{
            name: "[\n    " + ",\n    ".join(json.dumps(each) for each in parts[name]) + "\n  ]"
            for name in ("dry_blocks", "audio_blocks")
        },
    }
    body = ",\n  ".join(f'"{name}": {text}' for name, text in lines.items())
    return f'{{\n  "poses": [\n    {pose_lines}\n  ],\n  {body}\n}}\n'


if __name__ == "__main__":
    (HERE / "vectors.json").write_text(table())
