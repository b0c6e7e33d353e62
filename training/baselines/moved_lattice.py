"""Lattices away from where they are kept: held-out poses are where a simulation has them and look where it did, and
might be nodes, where a level that reuses responses errs no more than one that makes each anew."""

import copy
import math

import numpy as np

from server.acoustics.sound_path import SoundPathFinder
from server.field.field import AcousticField
from server.field.lattice import Lattice

_MOST_OFFSET_M = 0.25


def with_moved_lattice(field: AcousticField, rng: np.random.Generator) -> AcousticField:
    """The field with its nodes elsewhere, by up to 25 cm or half a cell, and headings turned by any angle; both keep
    their responses in the same room. The field itself where it has no lattice."""
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
