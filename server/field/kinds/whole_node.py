"""Levels that take the whole response, with first reflections, from the nearest node of a lattice."""

from server.field.kinds.lattice_reverberation import LatticeReverberation


class WholeNode(LatticeReverberation):
    shares_reflections = True
    _first_reflections = "node"
    _suffix = "-whole"
    _renewed = "all reflections"
