"""Small levels, in glTF's axes: metres, y up."""

import numpy as np
import pytest

from training.data.levels.gltf_writer import Piece, WrittenNode, write_glb

ROOM_M = (5.0, 2.6, 4.0)
_QUADS = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])


def box(low=(0.0, 0.0, 0.0), high=ROOM_M, *, inward=True, without=()):
    """Vertices and triangles of a box, seen from inside or outside. `without` are triangles left out, of twelve."""
    corners = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    triangles = np.concatenate([_QUADS[:, :3], _QUADS[:, [0, 2, 3]]])
    triangles = np.delete(triangles, list(without), axis=0)
    return corners, triangles[:, ::-1] if inward else triangles


def room(material="plaster", **options):
    """A node with a room of 5 x 4 x 2.6 m."""
    return WrittenNode("room", (Piece(*box(**options), material),))


def empty(name, at, extras=None):
    return WrittenNode(name, (), {"translation": list(at)}, extras or {})


@pytest.fixture
def glb(tmp_path):
    """Writes a level of nodes and gives its path."""

    def write(*nodes, name="level.glb"):
        path = tmp_path / name
        write_glb(path, nodes)
        return path

    return write
