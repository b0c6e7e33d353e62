"""Fields with moved nodes. Held-out poses are at the probes of the simulation, and might coincide with nodes, where a
level that reuses responses has no extra error. Moving the nodes avoids this bias."""

import copy

import numpy as np

from server.field.field import AcousticField


def with_moved_nodes(field: AcousticField, rng: np.random.Generator) -> AcousticField:
    """A copy of the field whose nodes are moved at random. Field and copy keep their responses in the same cache. A
    field that reuses no responses is returned unchanged."""
    if not field.kind.reuses_responses:
        return field
    moved = copy.copy(field)
    moved.source = field.source.moved(rng)
    return moved
