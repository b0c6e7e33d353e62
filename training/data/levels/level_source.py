"""What a level's file holds, before anything is made of it: triangles by node and material, in the file's own axes."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from server.acoustics.mesh import MOST_TRIANGLES
from server.core.errors import NafirError

_Floats = npt.NDArray[np.float64]
_Integers = npt.NDArray[np.int64]

MOST_FILE_BYTES = 512 * 1024 * 1024
"""The largest level file, and the most that it and the files it refers to may hold together."""
MOST_NODES = 100_000


class LevelError(NafirError):
    """A level that cannot be imported. The message names the file, what is at fault in it, and what to do."""

    def __init__(self, path: object, field: str, problem: str) -> None:
        super().__init__(f"{path}: {field}: {problem}")


@dataclass(frozen=True)
class Node:
    """A named node. `to_file` (4, 4) takes its own coordinates to the file's; `parent` is an index among the nodes, or
    -1. `extras` are the custom properties that its author gave it."""

    name: str
    to_file: _Floats
    parent: int = -1
    extras: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Part:
    """The triangles of one node with one material. `vertices` (V, 3) are in the file's axes and units, `triangles`
    (T, 3) counter-clockwise as seen from their front. `material` is the name in the file, or empty."""

    node: int
    vertices: _Floats
    triangles: _Integers
    material: str


@dataclass(frozen=True)
class LevelSource:
    """`kind` is `glTF` or `OBJ`; `notes` say what of the file was left out."""

    kind: str
    nodes: tuple[Node, ...]
    parts: tuple[Part, ...]
    notes: tuple[str, ...] = ()

    @property
    def digest(self) -> str:
        """SHA-256 of its nodes and triangles. Textures and whatever else of the file is left out do not change it."""
        digest = hashlib.sha256()
        for node in self.nodes:
            digest.update(json.dumps([node.name, node.parent, dict(node.extras)], sort_keys=True).encode())
            digest.update(node.to_file.tobytes())
        for part in self.parts:
            digest.update(json.dumps([part.node, part.material, len(part.vertices), len(part.triangles)]).encode())
            digest.update(part.vertices.tobytes())
            digest.update(part.triangles.tobytes())
        return digest.hexdigest()


def require_few(path: object, triangles: int) -> None:
    """Raises LevelError for more triangles than a mesh may have."""
    if triangles > MOST_TRIANGLES:
        raise LevelError(
            path,
            "triangles",
            f"{triangles:,}, and at most {MOST_TRIANGLES:,}: export a simpler level, such as its colliders",
        )
