"""The questions that a kind of quality level answers."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import ClassVar

from server.acoustics.sound_path import SoundPathFinder
from server.field.node_responses import NodeCache
from server.field.response_source import Compute, ResponseSource
from server.scene.bundle import Bundle
from server.scene.manifest import QualityLevel


class LevelKind(ABC):
    """One quality level. A subclass says which poses share a response, and what follows from that for the rest of the
    server; limits that a level of any kind may have are here."""

    reuses_responses: ClassVar[bool]
    """Whether poses share what the field holds. It is kept for them then, and most poses of a walk cost next to
    nothing."""
    shares_reflections: ClassVar[bool] = False
    """Whether poses that share a response share the first reflections from geometry too, or each pose has its own."""

    def __init__(self, level: QualityLevel) -> None:
        self.level = level

    @classmethod
    @abstractmethod
    def matches(cls, level: QualityLevel) -> bool:
        """Whether a level of the manifest is of this kind."""

    @abstractmethod
    def open(self, bundle: Bundle, paths: SoundPathFinder, compute: Compute, cache: NodeCache) -> ResponseSource:
        """Where the level takes responses from in a scene. What it keeps of them goes into `cache`, which all levels of
        the scene share."""

    @property
    def shares_tail(self) -> bool:
        """Whether all emitters of a listener share one late tail. Such levels are the last to step down to."""
        return self.level.shared_tail

    def shares_whole_responses(self, *, has_reflections: bool) -> bool:
        """Whether poses share all that follows the direct sound, in a scene that `has_reflections` from geometry."""
        return self.reuses_responses and (self.shares_reflections or not has_reflections)

    @property
    def title(self) -> str:
        """What the level leaves out, in words for people."""
        parts = [self._title] if self._title else []
        if self.shares_tail:
            parts.append("shared late reverberation")
        if self.level.frames is not None:
            parts.append("shortened reverberation")
        if self.level.ir_rate_hz is not None:
            parts.append(f"at most {self.level.ir_rate_hz:g} responses a second")
        title = ", ".join(parts) or "full"
        return title[0].upper() + title[1:]

    @property
    def _title(self) -> str:
        """What poses share, without a capital; empty where they share nothing."""
        return ""

    @property
    def detail(self) -> str:
        """What tells two levels of one title apart, as far as the kind knows."""
        return ""

    @classmethod
    def candidates(cls, field: str) -> Iterator[QualityLevel]:  # noqa: ARG003  none, unless a kind has some
        """Levels of this kind that are worth measuring, of a field; the field's name begins theirs."""
        return iter(())
