"""What an effect costs, and what it is told from: renderers with and without it (`server.planning.effect_costs`).

Microseconds of one core, per block; bytes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from server.responses.effect_flags import EmitterEffects, SharedEffects
from server.scene.bundle import Bundle
from server.scene.effects import EffectName


@dataclass(frozen=True)
class Cost:
    """Of one emitter, where an effect is on: microseconds per block and bytes; `moving_us` more while it or the
    listener moves, or `turning_us` while only the head turns. What it costs that there is any such emitter, all share:
    `first_us` and so on."""

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
"""As measured on this host; what is not in it was not."""


@dataclass(frozen=True)
class Variant:
    """A renderer to measure: what it makes, whether paths change with every block (`moves`), and whether responses are
    exchanged as often as those of somebody who walks."""

    effects: EmitterEffects = field(default_factory=EmitterEffects)
    shared: SharedEffects = field(default_factory=SharedEffects)
    moves: bool = False
    exchanges: bool = False

    def without_responses(self) -> "Variant":
        """The same in a scene without a field."""
        own_tails = replace(self.shared, own_tails=True)
        return replace(self, effects=replace(self.effects, late=False), shared=own_tails, exchanges=False)


STILL = Variant()
MOVING = Variant(moves=True)
EXCHANGING = Variant(exchanges=True)

PerPose = Callable[[Bundle, int], Callable[[], object]]
"""Of a scene and a number of emitters: work that is done for all of them whenever a pose changes."""


@dataclass(frozen=True)
class Measured:
    """Of renderers of one emitter and of `emitters`, by variant. `per_pose_us` of one emitter, by effect. `late_us` and
    `early_us` are what the two parts of a response take before it is made ready, `responses_per_block` of an emitter
    that moves. Without a field there are no responses of it."""

    emitters: int
    us: Mapping[tuple[Variant, int], float]
    memory_bytes: Mapping[Variant, int]
    per_pose_us: Mapping[EffectName, float]
    late_us: float
    early_us: float
    responses_per_block: float
    has_field: bool

    def between(self, more: Variant, less: Variant) -> tuple[float, float]:
        """Of each emitter, and of there being any."""
        more, less = self._here(more), self._here(less)
        one, all_ = (self.us[more, count] - self.us[less, count] for count in (1, self.emitters))
        each = max(0.0, (all_ - one) / (self.emitters - 1))
        return each, max(0.0, one - each)

    def standing(self, more: Variant, less: Variant) -> Cost:
        """Of what one variant makes and another does not, whether or not anything moves."""
        each, first = self.between(more, less)
        most, least = (self.memory_bytes[self._here(variant)] for variant in (more, less))
        return Cost(each, max(0, most - least) // self.emitters, first_us=first)

    def while_moving(self, more: Variant, less: Variant) -> Cost:
        each, first = self.between(more, less)
        return Cost(moving_us=each, moving_first_us=first)

    @property
    def response_us(self) -> tuple[float, float]:
        """Of responses anew of an emitter that moves, what the field holds, and of there being any exchanged."""
        if not self.has_field:
            return 0.0, 0.0
        exchange_us, first_us = self.between(EXCHANGING, STILL)
        return self.late_us * self.responses_per_block + exchange_us, first_us

    def _here(self, variant: Variant) -> Variant:
        return variant if self.has_field else variant.without_responses()


def variants_of(pairs: Sequence[tuple[Variant, Variant]], *, has_field: bool) -> list[Variant]:
    """All to measure, each once."""
    needed = dict.fromkeys([STILL, EXCHANGING, *(variant for pair in pairs for variant in pair)])
    return list(needed) if has_field else list(dict.fromkeys(variant.without_responses() for variant in needed))
