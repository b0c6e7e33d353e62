"""Levels that take reverberation from the nearest node of a lattice, and compute the first reflections for each
pose."""

from collections.abc import Iterator
from typing import ClassVar, Final, Literal

from server.acoustics.sound_path import SoundPathFinder
from server.field.kinds.level_kind import LevelKind
from server.field.lattice import Lattice
from server.field.node_responses import NodeCache, NodeResponses
from server.field.response_source import Compute, ResponseSource
from server.scene.bundle import Bundle
from server.scene.manifest import QualityLevel, Reuse

_LATTICES: Final = (
    (0.1, 15),
    (0.25, 15),
    (0.25, 30),
    (0.5, 30),
    (0.5, 60),
    (1.0, 30),
    (1.0, 60),
    (1.0, 120),
    (2.0, 60),
    (2.0, 120),
    (2.0, 360),
    (5.0, 120),
    (5.0, 360),
)
"""Spacing in metres and step of the heading in degrees: from spacings of centimetres up to one node per room."""


class LatticeReverberation(LevelKind):
    reuses_responses = True
    _first_reflections: ClassVar[Literal["pose", "node"]] = "pose"
    """The value in the manifest."""
    _suffix: ClassVar[str] = ""
    _renewed: ClassVar[str] = "reverberation"

    @classmethod
    def matches(cls, level: QualityLevel) -> bool:
        return level.reuse is not None and level.reuse.first_reflections == cls._first_reflections

    @property
    def reuse(self) -> Reuse:
        assert self.level.reuse is not None
        return self.level.reuse

    def open(self, bundle: Bundle, paths: SoundPathFinder, compute: Compute, cache: NodeCache) -> ResponseSource:
        return NodeResponses(self.level, Lattice(bundle, self.reuse, paths), compute, cache)

    @property
    def _title(self) -> str:
        return f"{self._renewed} renewed every {self.reuse.spacing_m:g} m"

    @property
    def detail(self) -> str:
        return f"{self.reuse.turn_deg:g}°"

    @classmethod
    def candidates(cls, field: str) -> Iterator[QualityLevel]:
        for spacing_m, turn_deg in _LATTICES:
            reuse = Reuse(spacing_m=spacing_m, turn_deg=turn_deg, first_reflections=cls._first_reflections)
            name = f"{field}-{100 * spacing_m:.0f}cm-{turn_deg:.0f}deg{cls._suffix}"
            yield QualityLevel(name=name, field=field, reuse=reuse)
