"""Writes triangles with named nodes and materials as binary glTF 2.0 (.glb): the same bytes for the same input."""

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

_FLOAT, _UNSIGNED = 5126, 5125
_ARRAY, _ELEMENTS = 34962, 34963


@dataclass(frozen=True)
class Piece:
    """Triangles of one material: `vertices` (V, 3), `triangles` (T, 3)."""

    vertices: npt.NDArray[np.float64]
    triangles: npt.NDArray[np.int64]
    material: str


@dataclass(frozen=True)
class WrittenNode:
    """A node at the top of the scene, or below another. `transform` has the keys of glTF: translation, rotation, scale
    or matrix."""

    name: str
    pieces: Sequence[Piece] = ()
    transform: Mapping[str, Any] = field(default_factory=dict)
    extras: Mapping[str, Any] = field(default_factory=dict)
    children: "Sequence[WrittenNode]" = ()


def write_glb(path: Path, nodes: Sequence[WrittenNode], copyright_notice: str = "") -> None:
    """Write one scene of these nodes. Coordinates are glTF's: metres, y up, right-handed."""
    document, body = gltf_of(nodes)
    if copyright_notice:
        document["asset"]["copyright"] = copyright_notice
    path.write_bytes(glb_bytes(document, body))


def gltf_of(nodes: Sequence[WrittenNode]) -> tuple[dict[str, Any], bytes]:
    """The JSON document, and the bytes of its buffer 0."""
    writer = _Writer()
    roots = [writer.add(node) for node in nodes]
    document = {
        "asset": {"version": "2.0", "generator": "nafir"},
        "scene": 0,
        "scenes": [{"nodes": roots}],
        "nodes": writer.nodes,
        "meshes": writer.meshes,
        "materials": [{"name": name} for name in writer.materials],
        "accessors": writer.accessors,
        "bufferViews": writer.views,
        "buffers": [{"byteLength": len(writer.body)}],
    }
    return {key: value for key, value in document.items() if value != []}, bytes(writer.body)


def glb_bytes(document: Mapping[str, Any], body: bytes) -> bytes:
    """A GLB file of a document and the binary buffer that it refers to."""
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    body += b"\0" * (-len(body) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(body), 0x004E4942) + body
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


@dataclass
class _Writer:
    nodes: list[dict[str, Any]] = field(default_factory=list)
    meshes: list[dict[str, Any]] = field(default_factory=list)
    materials: list[str] = field(default_factory=list)
    accessors: list[dict[str, Any]] = field(default_factory=list)
    views: list[dict[str, Any]] = field(default_factory=list)
    body: bytearray = field(default_factory=bytearray)

    def add(self, node: WrittenNode) -> int:
        written: dict[str, Any] = {"name": node.name, **node.transform}
        index = len(self.nodes)
        self.nodes.append(written)
        if node.extras:
            written["extras"] = dict(node.extras)
        if node.pieces:
            written["mesh"] = len(self.meshes)
            self.meshes.append({"name": node.name, "primitives": [self._primitive(piece) for piece in node.pieces]})
        if node.children:
            written["children"] = [self.add(child) for child in node.children]
        return index

    def _primitive(self, piece: Piece) -> dict[str, Any]:
        if piece.material not in self.materials:
            self.materials.append(piece.material)
        vertices = piece.vertices.astype("<f4")
        positions = self._accessor(vertices, _FLOAT, "VEC3", _ARRAY)
        if len(vertices):
            self.accessors[positions]["min"] = vertices.min(axis=0).tolist()
            self.accessors[positions]["max"] = vertices.max(axis=0).tolist()
        return {
            "attributes": {"POSITION": positions},
            "indices": self._accessor(piece.triangles.astype("<u4").ravel(), _UNSIGNED, "SCALAR", _ELEMENTS),
            "material": self.materials.index(piece.material),
        }

    def _accessor(self, array: npt.NDArray[Any], component: int, kind: str, target: int) -> int:
        data = array.tobytes()
        self.views.append({"buffer": 0, "byteOffset": len(self.body), "byteLength": len(data), "target": target})
        self.body += data
        view = len(self.views) - 1
        self.accessors.append({"bufferView": view, "componentType": component, "count": len(array), "type": kind})
        return len(self.accessors) - 1
