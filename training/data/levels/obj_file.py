"""Reads the triangles of Wavefront OBJ.

Names of materials are those of `usemtl`. The .mtl file is not opened: it says how surfaces look, and its name may lead
anywhere. Polygons become fans of triangles. Objects (`o`) and groups (`g`) become nodes.
"""

from array import array
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

from training.data.levels.level_source import (
    MOST_FILE_BYTES,
    MOST_NODES,
    LevelError,
    LevelSource,
    Node,
    Part,
    require_few,
)

_IGNORED = {"vt": "textures", "mtllib": "the looks of materials (.mtl)", "l": "lines", "p": "points"}
_CURVES = ("curv", "curv2", "surf", "cstype")


def read_obj(path: Path) -> LevelSource:
    """The nodes and triangles of a file. Raises LevelError with the line at fault."""
    if path.stat().st_size > MOST_FILE_BYTES:
        raise LevelError(path, "file", f"has more than {MOST_FILE_BYTES:,} bytes: export a simpler level")
    vertices = array("d")
    faces: dict[tuple[str, str], array[int]] = {}
    name, material, notes, count = "", "", [], 0
    with path.open(encoding="utf-8", errors="replace") as lines:
        for number, line in enumerate(lines, start=1):
            word, _, rest = line.strip().partition(" ")
            try:
                if word == "v":
                    vertices.extend(map(float, rest.split()[:3]))
                    if len(vertices) % 3:
                        raise ValueError("a vertex has three coordinates")
                elif word == "f":
                    corners = [_corner(text, len(vertices) // 3) for text in rest.split()]
                    if len(corners) < 3:
                        raise ValueError("a face has three corners at least")
                    count += len(corners) - 2
                    require_few(path, count)
                    held = faces.setdefault((name, material), array("q"))
                    for second, third in pairwise(corners[1:]):
                        held.extend((corners[0], second, third))
                elif word in ("o", "g"):
                    name = rest.strip()
                elif word == "usemtl":
                    material = rest.strip()
                elif word in _IGNORED:
                    notes.append(f"left out: {_IGNORED[word]}")
                elif word in _CURVES:
                    raise ValueError("curves and free-form surfaces are not read: export triangles")
            except ValueError as exc:
                raise LevelError(path, f"line {number}", str(exc)) from exc
            if len(notes) > len(_IGNORED):
                notes = list(dict.fromkeys(notes))
    names = list(dict.fromkeys(name for name, _ in faces))
    if len(names) > MOST_NODES:
        raise LevelError(path, "objects", f"{len(names):,}, and at most {MOST_NODES:,}: join what stands still")
    places = np.frombuffer(vertices, dtype=np.float64).reshape(-1, 3) if vertices else np.zeros((0, 3))
    numbers = {name: number for number, name in enumerate(names)}
    parts = []
    lowest, highest = np.full((2, len(names), 3), np.inf) * np.array([1, -1])[:, None, None]
    for (name, material), held in faces.items():
        used, triangles = np.unique(np.frombuffer(held, dtype=np.int64), return_inverse=True)
        part = Part(numbers[name], places[used], triangles.reshape(-1, 3), material)
        lowest[part.node] = np.minimum(lowest[part.node], part.vertices.min(axis=0))
        highest[part.node] = np.maximum(highest[part.node], part.vertices.max(axis=0))
        parts.append(part)
    nodes = tuple(map(Node, names, map(_placed_at, lowest / 2 + highest / 2)))
    return LevelSource("OBJ", nodes, tuple(parts), tuple(dict.fromkeys(notes)))


def _placed_at(point: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(4, 4) placement of a node. An object of an OBJ file has none, so it is in the middle of its vertices."""
    placement = np.eye(4)
    placement[:3, 3] = point
    return placement


def _corner(text: str, known: int) -> int:
    """The index of a corner's vertex, from 0. Negative numbers count back from the newest vertex."""
    number = int(text.partition("/")[0])
    index = number - 1 if number > 0 else known + number
    if number == 0 or not 0 <= index < known:
        raise ValueError(f"vertex {number} is none of the {known:,} so far")
    return index
