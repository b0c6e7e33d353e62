"""Reads the triangles and nodes of glTF 2.0 (.gltf, .glb).

Nothing that the file claims is believed before it is checked: sizes, offsets, indices, and addresses of other files,
which are read only from the level's own folder and below it. Textures, skins, animations, cameras and lights are left
out, and said to be. Specification: Khronos Group, glTF 2.0 (ISO/IEC 12113:2022).
"""

import base64
import binascii
import json
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from training.data.levels.level_source import (
    MOST_FILE_BYTES,
    MOST_NODES,
    LevelError,
    LevelSource,
    Node,
    Part,
    require_few,
)

_Floats = npt.NDArray[np.float64]
_Json = dict[str, Any]

_MAGIC, _JSON_CHUNK, _BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_INDEX_TYPES = (5121, 5123, 5125)
_FLOAT = 5126
_WIDTHS = {"SCALAR": 1, "VEC3": 3}
_TRIANGLES, _STRIP, _FAN = 4, 5, 6

GEOMETRY_EXTENSIONS = {
    "KHR_draco_mesh_compression": "is Draco compression: export without it",
    "EXT_meshopt_compression": "is meshopt compression: export without it",
    "KHR_meshopt_compression": "is meshopt compression: export without it",
    "KHR_mesh_quantization": "has positions as integers: export floats",
    "EXT_mesh_gpu_instancing": "places copies where no node says: make them nodes",
}
"""Extensions that change where triangles are, and so are refused by name."""
_HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_audio", "KHR_animation", "KHR_xmp")
"""Beginnings of the names of extensions that a file may require although nothing here reads them."""
_LEFT_OUT = {
    "textures": "textures",
    "skins": "skins (the mesh stays as it was bound)",
    "animations": "animations",
    "cameras": "cameras",
}


def read_gltf(path: Path, scene: str | None = None) -> LevelSource:
    """The nodes and triangles of one scene of a file: the one named `scene` (or of that number), else the default.
    Raises LevelError, also where a file has several scenes and no default, and none is named."""
    document, binary = _open(path)
    return _Reader(path, document, binary).level(scene)


def _open(path: Path) -> tuple[_Json, bytes | None]:
    _require_size(path, path.stat().st_size)
    data = path.read_bytes()
    binary = None
    if data[:4] == struct.pack("<I", _MAGIC):
        chunks = list(_chunks(path, data))
        if not chunks or chunks[0][0] != _JSON_CHUNK:
            raise LevelError(path, "glb", "its first chunk is no JSON: the file is damaged")
        text = chunks[0][1]
        binary = next((body for kind, body in chunks[1:] if kind == _BINARY_CHUNK), None)
    else:
        text = data
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as exc:
        raise LevelError(path, "file", f"is neither GLB nor the JSON of glTF ({exc})") from exc
    version = document.get("asset", {}).get("version") if _is_mapping(document, "asset") else None
    if not isinstance(version, str) or not version.startswith("2."):
        raise LevelError(path, "asset.version", f"must be 2.0, not {version!r}: export glTF 2.0")
    return document, binary


def _is_mapping(document: object, key: str) -> bool:
    return isinstance(document, dict) and isinstance(document.get(key, {}), dict)


def _chunks(path: Path, data: bytes) -> Iterator[tuple[int, bytes]]:
    if len(data) < 12:
        raise LevelError(path, "glb", "ends within its header")
    _, version, length = struct.unpack_from("<III", data)
    if version != 2:
        raise LevelError(path, "glb", f"is of version {version}, and must be of 2: export glTF 2.0")
    if length > len(data):
        raise LevelError(path, "glb", f"says that it has {length:,} bytes, and has {len(data):,}: it was cut short")
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > length:
            raise LevelError(path, "glb", "a chunk ends beyond the file: it was cut short")
        yield kind, data[at + 8 : at + 8 + size]
        at += 8 + size


def _require_size(path: Path, size: int) -> None:
    if size > MOST_FILE_BYTES:
        raise LevelError(path, "file", f"{size:,} bytes, and at most {MOST_FILE_BYTES:,}: export a simpler level")


@dataclass
class _Reader:
    """Reads one document. Faults are told with the place in the JSON, such as `accessors.3`."""

    path: Path
    document: _Json
    binary: bytes | None
    _buffers: dict[int, bytes] = field(default_factory=dict)
    _bytes_read: int = 0

    def level(self, asked: str | None) -> LevelSource:
        self._refuse_extensions()
        scene, notes = self._scene(asked)
        nodes: list[Node] = []
        uses: list[tuple[int, int]] = []
        self._walk(scene, nodes, uses)
        notes += [f"left out: {words}" for key, words in _LEFT_OUT.items() if self.document.get(key)]
        meshes: dict[int, list[tuple[_Floats, npt.NDArray[np.int64], str]]] = {}
        total, parts = 0, []
        for _, mesh in uses:
            if mesh not in meshes:
                meshes[mesh] = list(self._primitives(mesh, notes))
            total += sum(len(triangles) for _, triangles, _ in meshes[mesh])
            require_few(self.path, total)
        for node, mesh in uses:
            place = nodes[node].to_file
            parts += [
                Part(node, points @ place[:3, :3].T + place[:3, 3], _facing(triangles, place), material)
                for points, triangles, material in meshes[mesh]
            ]
        return LevelSource("glTF", tuple(nodes), tuple(parts), tuple(dict.fromkeys(notes)))

    def _fault(self, place: str, problem: str) -> LevelError:
        return LevelError(self.path, place, problem)

    def _refuse_extensions(self) -> None:
        required, used = (self._list(self.document, key, "") for key in ("extensionsRequired", "extensionsUsed"))
        for name in [*map(str, required), *map(str, used)]:
            if name in GEOMETRY_EXTENSIONS:
                raise self._fault("extensions", f"{name} {GEOMETRY_EXTENSIONS[name]}")
        for name in map(str, required):
            if not name.startswith(_HARMLESS):
                raise self._fault("extensionsRequired", f"{name} is not known here: export without it")

    def _scene(self, asked: str | None) -> tuple[list[int], list[str]]:
        """Indices of the root nodes, and notes."""
        scenes = self._list(self.document, "scenes", "")
        names = [str(each.get("name", index)) if isinstance(each, dict) else "" for index, each in enumerate(scenes)]
        if not scenes:
            raise self._fault("scenes", "there is none: export a scene, not a library of meshes")
        if asked is not None:
            chosen = [index for index, name in enumerate(names) if asked in (name, str(index))]
            if len(chosen) != 1:
                raise self._fault("--scene", f"{asked!r} is {'no' if not chosen else 'more than one'} scene of {names}")
            number = chosen[0]
        elif len(scenes) > 1 and "scene" not in self.document:
            raise self._fault("scenes", f"there are several, and none is the default: name one by --scene: {names}")
        else:
            number = self._index(self.document.get("scene", 0), len(scenes), "scene")
        notes = []
        if len(scenes) > 1:
            others = [name for index, name in enumerate(names) if index != number]
            notes.append(f"read: the scene {names[number]!r}; left out: the scenes {others}, which --scene would name")
        return self._list(scenes[number], "nodes", f"scenes.{number}"), notes

    def _walk(self, roots: Sequence[Any], nodes: list[Node], uses: list[tuple[int, int]]) -> None:
        """Append the nodes below `roots`, parents first, and (node, mesh) for each node that has a mesh."""
        given = self._list(self.document, "nodes", "")
        meshes = self._list(self.document, "meshes", "")
        if len(given) > MOST_NODES:
            raise self._fault("nodes", f"{len(given):,}, and at most {MOST_NODES:,}: join what stands still")
        seen: set[int] = set()
        waiting = [(self._index(root, len(given), "scenes"), -1) for root in reversed(roots)]
        while waiting:
            number, parent = waiting.pop()
            place = f"nodes.{number}"
            if number in seen:
                raise self._fault(place, "is the child of two nodes, or of itself: nodes must form a tree")
            seen.add(number)
            node = given[number]
            if not isinstance(node, dict):
                raise self._fault(place, "is no object")
            above = np.eye(4) if parent < 0 else nodes[parent].to_file
            with np.errstate(over="ignore", invalid="ignore"):
                to_file = above @ self._transform(node, place)
            if not np.isfinite(to_file).all():
                raise self._fault(place, "its place and those above it multiply to no finite numbers")
            extras = node.get("extras")
            nodes.append(
                Node(
                    str(node.get("name", "")),
                    to_file,
                    parent,
                    extras if isinstance(extras, dict) else {},
                )
            )
            if "mesh" in node:
                uses.append((len(nodes) - 1, self._index(node["mesh"], len(meshes), f"{place}.mesh")))
            children = self._list(node, "children", place)
            waiting += [(self._index(each, len(given), f"{place}.children"), len(nodes) - 1) for each in children[::-1]]

    def _transform(self, node: _Json, place: str) -> _Floats:
        if "matrix" in node:
            matrix = self._numbers(node["matrix"], 16, f"{place}.matrix").reshape(4, 4).T
        else:
            matrix = np.eye(4)
            turn = self._numbers(node.get("rotation", (0, 0, 0, 1)), 4, f"{place}.rotation")
            if not np.linalg.norm(turn) > 1e-6:
                raise self._fault(f"{place}.rotation", "is a quaternion without length")
            scale = self._numbers(node.get("scale", (1, 1, 1)), 3, f"{place}.scale")
            matrix[:3, :3] = Rotation.from_quat(turn).as_matrix() * scale
            matrix[:3, 3] = self._numbers(node.get("translation", (0, 0, 0)), 3, f"{place}.translation")
        return np.asarray(matrix, dtype=np.float64)

    def _primitives(self, mesh: int, notes: list[str]) -> Iterator[tuple[_Floats, npt.NDArray[np.int64], str]]:
        place = f"meshes.{mesh}"
        described = self.document["meshes"][mesh]
        if not isinstance(described, dict):
            raise self._fault(place, "is no object")
        for number, primitive in enumerate(self._list(described, "primitives", place)):
            at = f"{place}.primitives.{number}"
            attributes = primitive.get("attributes") if isinstance(primitive, dict) else None
            if not isinstance(attributes, dict):
                raise self._fault(at, "has no attributes")
            extensions = primitive.get("extensions", {})
            if not isinstance(extensions, dict):
                raise self._fault(f"{at}.extensions", "is no object")
            for name in extensions:
                if name in GEOMETRY_EXTENSIONS:
                    raise self._fault(at, f"{name} {GEOMETRY_EXTENSIONS[name]}")
            if primitive.get("targets"):
                notes.append("left out: morph targets")
            mode = primitive.get("mode", _TRIANGLES)
            if mode not in (_TRIANGLES, _STRIP, _FAN):
                notes.append("left out: points and lines")
                continue
            if "POSITION" not in attributes:
                notes.append("left out: primitives without positions")
                continue
            points = self._accessor(attributes["POSITION"], "VEC3", (_FLOAT,), f"{at}.attributes.POSITION")
            if "indices" in primitive:
                flat = self._accessor(primitive["indices"], "SCALAR", _INDEX_TYPES, f"{at}.indices").ravel()
            else:
                flat = np.arange(len(points))
            if len(flat) and flat.max() >= len(points):
                raise self._fault(f"{at}.indices", f"{flat.max()} is beyond the {len(points):,} vertices")
            triangles = _triangles(flat.astype(np.int64), mode)
            require_few(self.path, len(triangles))
            # Every use of a mesh has vertices of its own, so what no triangle has could fill the memory.
            used, corners = np.unique(triangles, return_inverse=True)
            yield points[used].astype(np.float64), corners.reshape(-1, 3), self._material(primitive, at)

    def _material(self, primitive: _Json, place: str) -> str:
        if "material" not in primitive:
            return ""
        materials = self._list(self.document, "materials", "")
        number = self._index(primitive["material"], len(materials), f"{place}.material")
        named = materials[number].get("name") if isinstance(materials[number], dict) else None
        return str(named) if named else f"material {number}"

    def _accessor(self, number: Any, kind: str, types: Sequence[int], place: str) -> npt.NDArray[Any]:
        """(count, width)"""
        accessors = self._list(self.document, "accessors", "")
        index = self._index(number, len(accessors), place)
        at, accessor = f"accessors.{index}", accessors[index]
        if not isinstance(accessor, dict):
            raise self._fault(at, "is no object")
        if accessor.get("type") != kind or accessor.get("componentType") not in types:
            raise self._fault(at, f"must be {kind} of the component types {list(types)}, as {place} needs")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise self._fault(at, "is sparse or has no data: export plain arrays")
        views = self._list(self.document, "bufferViews", "")
        view_at = f"bufferViews.{self._index(accessor['bufferView'], len(views), at)}"
        view = views[accessor["bufferView"]]
        if not isinstance(view, dict):
            raise self._fault(view_at, "is no object")
        count, start = self._size(accessor.get("count"), f"{at}.count"), self._size(accessor.get("byteOffset", 0), at)
        offset = self._size(view.get("byteOffset", 0), f"{view_at}.byteOffset")
        length = self._size(view.get("byteLength"), f"{view_at}.byteLength")
        data = self._buffer(view.get("buffer"), view_at)
        if offset + length > len(data):
            raise self._fault(view_at, f"ends at byte {offset + length:,} of a buffer of {len(data):,}")
        dtype = np.dtype(_COMPONENTS[accessor["componentType"]])
        row = dtype.itemsize * _WIDTHS[kind]
        stride = self._size(view.get("byteStride", row), f"{view_at}.byteStride")
        if stride < row or (count and start + (count - 1) * stride + row > length):
            raise self._fault(at, f"{count:,} elements do not fit into {view_at} of {length:,} bytes")
        if not count:
            return np.zeros((0, _WIDTHS[kind]), dtype)
        shape, strides = (count, _WIDTHS[kind]), (stride, dtype.itemsize)
        return np.ndarray(shape, dtype, data, offset + start, strides).copy()

    def _buffer(self, number: Any, place: str) -> bytes:
        buffers = self._list(self.document, "buffers", "")
        index = self._index(number, len(buffers), f"{place}.buffer")
        if index not in self._buffers:
            described = buffers[index] if isinstance(buffers[index], dict) else {}
            data = self._bytes_of(described.get("uri"), index)
            size = self._size(described.get("byteLength"), f"buffers.{index}.byteLength")
            if len(data) < size:
                raise self._fault(f"buffers.{index}", f"has {len(data):,} bytes, and should have {size:,}")
            self._bytes_read += len(data)
            _require_size(self.path, self._bytes_read)
            self._buffers[index] = data[:size]
        return self._buffers[index]

    def _bytes_of(self, uri: Any, index: int) -> bytes:
        place = f"buffers.{index}.uri"
        if uri is None:
            if index != 0 or self.binary is None:
                raise self._fault(place, "is missing, and the file has no binary chunk for it")
            return self.binary
        if not isinstance(uri, str):
            raise self._fault(place, "is no text")
        if uri.startswith("data:"):
            head, comma, body = uri.partition(",")
            if not comma or not head.endswith(";base64"):
                raise self._fault(place, "is a data URI that is not base64")
            try:
                return base64.b64decode(body, validate=True)
            except (binascii.Error, ValueError) as exc:
                raise self._fault(place, f"is no base64 ({exc})") from exc
        return self._file_beside(uri, place)

    def _file_beside(self, uri: str, place: str) -> bytes:
        """Bytes of a file in the level's folder or below it. Addresses are judged before any file is touched, and again
        where links lead."""
        name = unquote(uri)
        parts = PurePosixPath(name).parts
        if (
            ":" in name
            or "\\" in name
            or "\0" in name
            or PurePosixPath(name).is_absolute()
            or ".." in parts
            or not parts
        ):
            raise self._fault(place, f"{uri!r} leads out of the level's folder: put the file beside the level")
        folder = self.path.resolve().parent
        try:
            file = (folder / name).resolve()
            is_there = file.is_file()
        except OSError as exc:
            raise self._fault(place, f"the file {uri[:80]!r} cannot be looked for ({exc.strerror})") from exc
        if not file.is_relative_to(folder):
            raise self._fault(place, f"{uri!r} is a link out of the level's folder: put the file itself there")
        if not is_there:
            raise self._fault(place, f"there is no file {uri!r} beside the level")
        _require_size(file, self._bytes_read + file.stat().st_size)
        return file.read_bytes()

    def _list(self, holder: Any, key: str, place: str) -> list[Any]:
        given = holder.get(key, []) if isinstance(holder, dict) else None
        if not isinstance(given, list):
            raise self._fault(f"{place}.{key}".lstrip("."), "is no list")
        return given

    def _index(self, given: Any, count: int, place: str) -> int:
        if not isinstance(given, int) or isinstance(given, bool) or not 0 <= given < count:
            raise self._fault(place, f"{given!r} is none of the {count:,} there are")
        return given

    def _size(self, given: Any, place: str) -> int:
        if not isinstance(given, int) or isinstance(given, bool) or not 0 <= given <= MOST_FILE_BYTES:
            raise self._fault(place, f"{given!r} is no number of bytes or elements")
        return given

    def _numbers(self, given: Any, count: int, place: str) -> _Floats:
        try:
            numbers = np.array(given, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            numbers = np.zeros(0)
        if numbers.shape != (count,) or not np.isfinite(numbers).all():
            raise self._fault(place, f"must be {count} finite numbers")
        return numbers


def _triangles(flat: npt.NDArray[np.int64], mode: int) -> npt.NDArray[np.int64]:
    """(T, 3) from the indices of a list, strip or fan, all counter-clockwise. What a list has left over is dropped."""
    if mode == _TRIANGLES:
        return flat[: len(flat) // 3 * 3].reshape(-1, 3)
    if len(flat) < 3:
        return np.zeros((0, 3), np.int64)
    if mode == _FAN:
        return np.stack([flat[1:-1], flat[2:], np.full(len(flat) - 2, flat[0])], axis=1)
    strip = np.stack([flat[:-2], flat[1:-1], flat[2:]], axis=1)
    strip[1::2] = strip[1::2][:, [0, 2, 1]]
    return strip


def _facing(triangles: npt.NDArray[np.int64], place: _Floats) -> npt.NDArray[np.int64]:
    """The triangles, turned if the transform mirrors, so that their front stays in front (glTF 2.0, 3.7.4)."""
    return triangles[:, ::-1] if np.linalg.det(place[:3, :3]) < 0 else triangles
