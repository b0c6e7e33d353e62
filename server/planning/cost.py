"""The cost of an effect, derived from renderers with and without it (`server.planning.effect_costs`).

Times are microseconds of one core per block; memory is in bytes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from server.responses.effect_flags import EmitterEffects, SharedEffects
from server.scene.bundle import Bundle
from server.scene.effects import EffectName


@dataclass(frozen=True)
class Cost:
    """The cost of an effect that is on, for one emitter: microseconds per block and bytes. `moving_us` comes on top
    while the emitter or the listener moves, or `turning_us` while only the head turns. `first_us`, `moving_first_us`
    and `turning_first_us` are fixed costs that all emitters share."""

    us: float = 0.0
    memory_bytes: int = 0
    moving_us: float = 0.0
    turning_us: float = 0.0
    first_us: float = 0.0
    moving_first_us: float = 0.0
    turning_first_us: float = 0.0

    def __add__(self, other: "Cost") -> "Cost":
        return Cost(**{name: value + getattr(other, name) for name, value in vars(self).items()})


NOTHING = Cost()

Costs = Mapping[EffectName, Cost]
"""Costs measured on this host; effects that were not measured are missing."""


@dataclass(frozen=True)
class Variant:
    """A renderer to measure: its effects, whether paths change with every block (`moves`), and whether responses are
    exchanged as often as for a walking listener (`exchanges`)."""

    effects: EmitterEffects = field(default_factory=EmitterEffects)
    shared: SharedEffects = field(default_factory=SharedEffects)
    moves: bool = False
    exchanges: bool = False

    def without_responses(self) -> "Variant":
        """Return the same variant for a scene without a field."""
        own_tails = replace(self.shared, own_tails=True)
        return replace(self, effects=replace(self.effects, late=False), shared=own_tails, exchanges=False)


STILL = Variant()
MOVING = Variant(moves=True)
EXCHANGING = Variant(exchanges=True)

PerPose = Callable[[Bundle, int], Callable[[], object]]
"""Returns, for a scene and a number of emitters, the work that is done for all of them whenever a pose changes."""


@dataclass(frozen=True)
class Measured:
    """Measurements of renderers with one emitter and with `emitters`, by variant. `per_pose_us` is for one emitter, by
    effect. `late_us` and `early_us` are the times to compute the field's part and the first reflections of a response,
    and `responses_per_block` is the rate for an emitter that moves. Without a field no responses are computed. With
    `has_bus`, responses are those of a bus, which turns with the head without new ones."""

    emitters: int
    us: Mapping[tuple[Variant, int], float]
    memory_bytes: Mapping[Variant, int]
    per_pose_us: Mapping[EffectName, float]
    late_us: float
    early_us: float
    responses_per_block: float
    has_field: bool
    has_bus: bool = False

    def between(self, more: Variant, less: Variant) -> tuple[float, float]:
        """Return the difference in time per emitter, and the fixed part that all emitters share."""
        more, less = self._here(more), self._here(less)
        one, all_ = (self.us[more, count] - self.us[less, count] for count in (1, self.emitters))
        each = max(0.0, (all_ - one) / (self.emitters - 1))
        return each, max(0.0, one - each)

    def standing(self, more: Variant, less: Variant) -> Cost:
        """Return the cost of what one variant renders and the other does not, whether or not anything moves."""
        each, first = self.between(more, less)
        most, least = (self.memory_bytes[self._here(variant)] for variant in (more, less))
        return Cost(each, max(0, most - least) // self.emitters, first_us=first)

    def while_moving(self, more: Variant, less: Variant) -> Cost:
        each, first = self.between(more, less)
        return Cost(moving_us=each, moving_first_us=first)

    @property
    def response_us(self) -> tuple[float, float]:
        """The time that new responses take for an emitter that moves, and the fixed part of exchanging any."""
        if not self.has_field:
            return 0.0, 0.0
        exchange_us, first_us = self.between(EXCHANGING, STILL)
        return self.late_us * self.responses_per_block + exchange_us, first_us

    def _here(self, variant: Variant) -> Variant:
        return variant if self.has_field else variant.without_responses()


def variants_of(pairs: Sequence[tuple[Variant, Variant]], *, has_field: bool) -> list[Variant]:
    """Return all variants to measure, each once."""
    needed = dict.fromkeys([STILL, EXCHANGING, *(variant for pair in pairs for variant in pair)])
    return list(needed) if has_field else list(dict.fromkeys(variant.without_responses() for variant in needed))
