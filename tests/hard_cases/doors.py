"""The doors by which bytes of a stranger's enter, and what may come of them: an answer, or a refusal that says why."""

import hashlib
import io
import json
from pathlib import Path

import numpy as np

from server.core.errors import BundleError, RequestError
from server.field.graph_file import GraphFile
from server.protocol.blocks import DryBlock
from server.protocol.client_messages import parse_client_message
from server.scene.bundle import BUNDLED, MANIFEST_FILE, Bundle
from server.scene.manifest import ARRAYS_FILE

MESSAGES = [
    '{"type": "hello", "protocol": 3, "scene": "flat", "block_size": 256, "encoding": "s16", "buffer_blocks": 8}',
    '{"type": "hello", "protocol": 3, "scene": "flat", "listener": {"position": [1, 2, 1.5], "yaw": 0.5}}',
    '{"type": "add_emitter", "id": "a", "clip": "noise", "position": [6, 3, 1.5], "gain_db": -6.0, "loop": true}',
    '{"type": "add_emitter", "id": "a", "live": true, "position": [6, 3, 1.5], "orientation": [0, 0, 0, 1],'
    ' "directivity": {"pattern": "cardioid", "order": 2.5}}',
    '{"type": "add_emitter", "id": "a", "live": true, "position": [6, 3, 1.5], "directivity": {"pattern": "measured",'
    ' "angles_deg": [0, 90, 180], "gains_db": [[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0],'
    " [0, -10, -20]]}}",
    '{"type": "move_emitter", "id": "a", "position": [1, 1, 1], "pose_id": 7}',
    '{"type": "set_gain", "id": "a", "gain_db": 3.5}',
    '{"type": "set_door", "door": "kitchen", "openness": 0.5}',
    '{"type": "set_level", "level": "auto"}',
    '{"type": "set_effects", "effects": {"directivity": true, "hrtf": null}}',
    '{"type": "stop_emitter", "id": "a", "stop_at": 4800, "fade_s": 0.5}',
    '{"type": "remove_emitter", "id": "a"}',
    '{"type": "add_listener", "id": "p2", "position": [3, 2, 1.5], "yaw": 0.5, "hrtf": "kemar"}',
    '{"type": "listener", "position": [2, 2, 1.5], "yaw": 1.0, "pose_id": 9}',
    '{"type": "listener", "position": [2, 2, 1.5], "orientation": [0, 0, 0, 1], "pose_id": 10, "listener": "p2"}',
    '{"type": "listener", "position": [2, 2, 1.5], "pose_id": 11, "index": 1}',
    '{"type": "remove_listener", "id": "p2"}',
    '{"type": "acknowledge", "sequence": 12}',
    '{"type": "acknowledge", "sequence": 12, "listener": "p2"}',
    '{"type": "resume", "protocol": 3, "token": "x", "snapshot": "y", "sequence": 7, "sample_clock": 256}',
    '{"type": "ping", "id": 5}',
]
"""One of each kind that a client sends as text."""
BLOCKS = [
    b"\x02\0\0\0\7\0\0\0" + np.array([2, 2, 1.5, 0, 0, 0, 1], "<f4").tobytes(),
    DryBlock("a", 3, np.ones(5, np.float32)).serialize("f32"),
    DryBlock("violin", 4, np.ones(6, np.float32)).serialize("s16"),
    b"\x02\1\0\0\7\0\0\0" + np.array([2, 2, 1.5, 0, 0, 0, 1], "<f4").tobytes(),
]
"""And as bytes."""


def receive(data: str | bytes) -> object | None:
    """What a message says; None for one that is refused. Anything else that is raised is a fault."""
    try:
        return parse_client_message(data)
    except RequestError as exc:
        refusal = exc
    assert refusal.code
    assert str(refusal)
    return None


def load(folder: Path) -> Bundle | None:
    """A bundle; None for one that is refused, which names its file and field."""
    try:
        return Bundle.load(folder)
    except BundleError as exc:
        refusal = exc
    assert refusal.field
    assert str(refusal.path).startswith(str(folder))
    return None


def look_into_a_graph(model: bytes) -> GraphFile | None:
    """What a graph says of itself; None for what is no protobuf, or too large."""
    try:
        return GraphFile.read(model)
    except ValueError as exc:
        refusal = exc
    assert str(refusal)
    return None


def write_bundle_without_fields(folder: Path) -> Path:
    """A bundle to damage: the manifest of one that is shipped, and hardly anything in the files that it lists."""
    folder.mkdir()
    document = json.loads((BUNDLED / "apartment" / MANIFEST_FILE).read_bytes())
    noise = io.BytesIO()
    np.savez(noise, frozen_noise=np.ones((2, document["codec"]["samples"]), np.float32))
    for name in document["files"]:
        data = noise.getvalue() if name == ARRAYS_FILE else name.encode()
        (folder / name).write_bytes(data)
        document["files"][name] = hashlib.sha256(data).hexdigest()
    (folder / MANIFEST_FILE).write_text(json.dumps(document))
    return folder


def write_manifest(folder: Path, text: bytes) -> None:
    (folder / MANIFEST_FILE).write_bytes(text)


def write_arrays(folder: Path, data: bytes) -> None:
    """With their hash in the manifest, so that they are looked at."""
    (folder / ARRAYS_FILE).write_bytes(data)
    document = json.loads((folder / MANIFEST_FILE).read_bytes())
    document["files"][ARRAYS_FILE] = hashlib.sha256(data).hexdigest()
    (folder / MANIFEST_FILE).write_text(json.dumps(document))
