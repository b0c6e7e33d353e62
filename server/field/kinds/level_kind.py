"""The interface of a kind of quality level."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import ClassVar

from server.acoustics.sound_path import SoundPathFinder
from server.field.node_responses import NodeCache
from server.field.response_source import Compute, ResponseSource
from server.rendering.convolver import Sharing
from server.scene.bundle import Bundle
from server.scene.manifest import QualityLevel


class LevelKind(ABC):
    """One quality level. A subclass says which poses share a response, and what this means for the rest of the server;
    limits that apply to levels of every kind are in this class."""

    reuses_responses: ClassVar[bool]
    """Whether poses share the field's responses. The server then caches them, and most poses of a walk cost almost
    nothing."""
    shares_reflections: ClassVar[bool] = False
    """Whether poses that share a response also share its first reflections from geometry, or each pose has its own."""

    def __init__(self, level: QualityLevel) -> None:
        self.level = level

    @classmethod
    @abstractmethod
    def matches(cls, level: QualityLevel) -> bool:
        """Whether a level of the manifest is of this kind."""

    @abstractmethod
    def open(self, bundle: Bundle, paths: SoundPathFinder, compute: Compute, cache: NodeCache) -> ResponseSource:
        """Open the level's source of responses in a scene. Responses that it keeps go into `cache`, which all levels of
        the scene share."""

    @property
    def shares_tail(self) -> bool:
        """Whether all emitters of a listener share one late tail. Under load, such levels are used last."""
        return self.level.shared_tail

    @property
    def sharing(self) -> Sharing:
        """What the emitters of a listener share."""
        return Sharing.TAIL if self.shares_tail else Sharing.NOTHING

    def shares_whole_responses(self, *, has_reflections: bool) -> bool:
        """Whether poses share everything after the direct sound, in a scene that `has_reflections` from geometry."""
        return self.reuses_responses and (self.shares_reflections or not has_reflections)

    @property
    def title(self) -> str:
        """A title for people, which says what the level leaves out."""
        parts = [self._title] if self._title else []
        if self.shares_tail:
            parts.append("shared late reverberation")
        if self.level.frames is not None:
            parts.append("shortened reverberation")
        if self.level.bus is not None:
            parts.append(f"turned as ambisonics of order {self.level.bus}")
        if self.level.ir_rate_hz is not None:
            parts.append(f"at most {self.level.ir_rate_hz:g} responses a second")
        title = ", ".join(parts) or "full"
        return title[0].upper() + title[1:]

    @property
    def _title(self) -> str:
        """What poses share, beginning with a lower-case letter; empty if they share nothing."""
        return ""

    @property
    def detail(self) -> str:
        """What distinguishes two levels with the same title, as far as the kind knows."""
        return ""

    @classmethod
    def candidates(cls, field: str) -> Iterator[QualityLevel]:  # noqa: ARG003  none, unless a kind has some
        """Levels of this kind for a field that are worth measuring; their names begin with the field's name."""
        return iter(())
