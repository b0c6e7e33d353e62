"""Nodes away from where they are kept: held-out poses are where a simulation has them and look where it did, and might
be nodes, where a level that reuses responses errs no more than one that makes each anew."""

import copy

import numpy as np

from server.field.field import AcousticField


def with_moved_nodes(field: AcousticField, rng: np.random.Generator) -> AcousticField:
    """The field with its nodes elsewhere; both keep their responses in the same cache. The field itself where every
    pose has a response of its own."""
    if not field.kind.reuses_responses:
        return field
    moved = copy.copy(field)
    moved.source = field.source.moved(rng)
    return moved
