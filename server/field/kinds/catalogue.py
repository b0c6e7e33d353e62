"""A list of all kinds of quality level."""

from typing import Final

from server.field.kinds.every_pose import EveryPose
from server.field.kinds.lattice_reverberation import LatticeReverberation
from server.field.kinds.level_kind import LevelKind
from server.field.kinds.whole_node import WholeNode
from server.scene.manifest import QualityLevel

KINDS: Final[tuple[type[LevelKind], ...]] = (LatticeReverberation, WholeNode, EveryPose)
"""A level is of the first kind that matches it. The last kind matches all levels."""


def kind_of(level: QualityLevel) -> LevelKind:
    """The level as an object of its kind."""
    return next(kind(level) for kind in KINDS if kind.matches(level))
