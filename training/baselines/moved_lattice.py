"""Fields with moved lattices. Held-out poses are at the probes of the simulation, and might coincide with nodes, where
a level that reuses responses has no extra error. Moving the lattice avoids this bias."""

import copy
import math

import numpy as np

from server.acoustics.sound_path import SoundPathFinder
from server.field.field import AcousticField
from server.field.lattice import Lattice

_MOST_OFFSET_M = 0.25


def with_moved_lattice(field: AcousticField, rng: np.random.Generator) -> AcousticField:
    """The field with its nodes moved by up to 25 cm or half a cell, and headings rotated by any angle. Responses stay
    in the same room as their nodes. A field without a lattice is returned unchanged."""
    reuse, nodes = field.level.reuse, field.nodes
    if reuse is None or nodes is None:
        return field
    most = min(_MOST_OFFSET_M, reuse.spacing_m / 2)
    x, y, z = map(float, rng.uniform(-most, most, 3))
    turned = rng.uniform(-math.pi, math.pi)
    paths = SoundPathFinder(field.bundle.floor_plan, field.bundle.manifest.speed_of_sound)
    moved = copy.copy(field)
    moved.nodes = copy.copy(nodes)
    moved.nodes.lattice = Lattice(field.bundle, reuse, paths, (x, y, z), turned)
    return moved
