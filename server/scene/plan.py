"""What the planner decided: which effects a situation calls for, why, and what that costs and saves."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from server.scene.effects import EffectName


@dataclass(frozen=True)
class Decision:
    """On or off of one effect, of `emitter` or, with None, of all that the listener hears.

    `change_jnd` is what leaving it out changes, in just-noticeable differences of the `parameter` that changes most.
    `cost_us` per block and `memory_bytes` are what it costs where it is on, and saves where it is off; None where
    nothing was measured.
    """

    name: EffectName
    emitter: str | None
    called_for: bool
    change_jnd: float
    parameter: str
    cost_us: float | None
    memory_bytes: int | None
    reason: str
    overridden: bool = False


@dataclass(frozen=True)
class Plan:
    """`shared` are decisions about all that a listener hears, `by_emitter` those about one emitter."""

    shared: Mapping[EffectName, Decision]
    by_emitter: Mapping[str, Mapping[EffectName, Decision]]

    def is_on(self, name: EffectName, emitter: str | None = None) -> bool:
        """Of an effect decided for each emitter, without one of them: whether it is on for any."""
        return any(each.called_for for each in self.about(name, emitter))

    def about(self, name: EffectName, emitter: str | None = None) -> tuple[Decision, ...]:
        """The decisions about one effect; those of one emitter, or of all."""
        if name in self.shared:
            return (self.shared[name],)
        chosen = self.by_emitter.values() if emitter is None else (self.by_emitter[emitter],)
        return tuple(decisions[name] for decisions in chosen)

    @property
    def decisions(self) -> Iterator[Decision]:
        yield from self.shared.values()
        for of_one in self.by_emitter.values():
            yield from of_one.values()

    @property
    def cost_us(self) -> float:
        """Per block, of what is on, as far as it was measured."""
        return sum(each.cost_us or 0.0 for each in self.decisions if each.called_for)

    @property
    def saved_us(self) -> float:
        """Per block, of what is off."""
        return sum(each.cost_us or 0.0 for each in self.decisions if not each.called_for)

    def to_json(self) -> dict[str, Any]:
        return {
            "cost_us": self.cost_us,
            "saved_us": self.saved_us,
            "decisions": [asdict(each) for each in self.decisions],
        }
