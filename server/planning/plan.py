"""A plan of effects: which effects a situation calls for, why, and what they cost and save."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from server.planning.decision import Decision
from server.scene.effects import EffectName


@dataclass(frozen=True)
class RenderingDecision(Decision[EffectName]):
    """A decision about an effect of `emitter` or, with None, about an effect on all that the listener hears. `cost_us`
    per block and `memory_bytes` are what the effect costs where it is on, and saves where it is off; None if not
    measured."""

    emitter: str | None = None
    cost_us: float | None = None
    memory_bytes: int | None = None


@dataclass(frozen=True)
class Plan:
    """All decisions of a plan: those shared by all emitters (`shared`), and those about each emitter (`by_emitter`)."""

    shared: Mapping[EffectName, RenderingDecision]
    by_emitter: Mapping[str, Mapping[EffectName, RenderingDecision]]

    def is_on(self, name: EffectName, emitter: str | None = None) -> bool:
        """Return whether an effect is on. For an effect decided per emitter, without a given `emitter`: whether it is
        on for any."""
        return any(each.called_for for each in self.about(name, emitter))

    def about(self, name: EffectName, emitter: str | None = None) -> tuple[RenderingDecision, ...]:
        """Return the decisions about one effect, of one emitter or of all."""
        if name in self.shared:
            return (self.shared[name],)
        chosen = self.by_emitter.values() if emitter is None else (self.by_emitter[emitter],)
        return tuple(decisions[name] for decisions in chosen)

    def on(self, emitter: str) -> set[EffectName]:
        """Return the effects of one emitter that are on."""
        return {name for name, decision in self.by_emitter[emitter].items() if decision.called_for}

    @property
    def decisions(self) -> Iterator[RenderingDecision]:
        yield from self.shared.values()
        for of_one in self.by_emitter.values():
            yield from of_one.values()

    @property
    def cost_us(self) -> float:
        """Cost per block of the effects that are on, as far as it was measured."""
        return sum(each.cost_us or 0.0 for each in self.decisions if each.called_for)

    @property
    def saved_us(self) -> float:
        """Cost per block that the effects which are off would have."""
        return sum(each.cost_us or 0.0 for each in self.decisions if not each.called_for)

    def to_json(self) -> dict[str, Any]:
        return {
            "cost_us": self.cost_us,
            "saved_us": self.saved_us,
            "decisions": [asdict(each) for each in self.decisions],
        }
