"""Which effects a situation calls for.

An effect switches on at a change of one just-noticeable difference and stays on down to 0.7 of one, so that it does not
flutter about the threshold. Effects that are inaudible one by one may be audible if all are left out; then the one with
the largest change is on.
"""

from collections.abc import Collection, Mapping, Sequence

from server.planning.catalogue import CATALOGUE, ENERGY_EFFECTS, MOTION_EFFECTS, SHARED_EFFECTS
from server.planning.change import UNCHANGED, Change
from server.planning.cost import Cost, Costs
from server.planning.decision import Threshold
from server.planning.effect import DIRECT_SOUND, Effect, EnergyEffect
from server.planning.plan import Plan, RenderingDecision
from server.planning.prediction import Off, Prediction, worst
from server.planning.reasons import HOLDS_DIRECT_SOUND, reason
from server.planning.scene_acoustics import Emitter, Situation
from server.scene.effects import EffectName, Overrides

THRESHOLD = Threshold(enter_jnd=1.0, leave_jnd=0.7)

_OF_EMITTERS = [effect for effect in CATALOGUE.values() if not effect.is_shared]
_BY_NEED = sorted(_OF_EMITTERS, key=lambda effect: effect.needs is not None)
"""The effects in the order of their decisions: those that others need come first."""


def make_plan(
    situation: Situation,
    *,
    previous: Plan | None = None,
    overrides: Overrides | None = None,
    costs: Costs | None = None,
) -> Plan:
    """Make a plan, which is the same for the same arguments. `previous` is the plan now in effect: its effects stay on
    down to the lower threshold."""
    return _Planner(situation, previous, overrides or {}, costs or {}).plan()


class _Planner:
    def __init__(self, situation: Situation, previous: Plan | None, overrides: Overrides, costs: Costs) -> None:
        self._situation = situation
        self._previous = previous
        self._overrides = overrides
        self._costs = costs
        self._without: dict[Off, list[Change]] = {}
        """Changes of all emitters by set of effects left out together; most emitters have the same set."""

    def plan(self) -> Plan:
        if not self._situation.emitters:
            return Plan({}, {})
        prediction = Prediction(self._situation, ENERGY_EFFECTS)
        asked = [effect.name for effect in ENERGY_EFFECTS if effect.may_act is None or effect.may_act(self._situation)]
        changes = worst(prediction.changes([frozenset({name}) for name in asked]))
        by_emitter = {}
        for number, emitter in enumerate(self._situation.emitters):
            alone = {name: of_all[number] for name, of_all in zip(asked, changes, strict=True)}
            alone |= {effect.name: effect.change(prediction, number) for effect in MOTION_EFFECTS}
            made: dict[EffectName, RenderingDecision] = {}
            for effect in _BY_NEED:
                made[effect.name] = self._decide(effect, emitter, alone.get(effect.name, UNCHANGED), beside=[made])
            self._allow_for_sum(prediction, emitter, number, made)
            by_emitter[emitter] = {effect.name: made[effect.name] for effect in _OF_EMITTERS}
        of_all = by_emitter.values()
        shared = {
            effect.name: self._decide(effect, None, effect.change(prediction), beside=of_all)
            for effect in SHARED_EFFECTS
        }
        return Plan(shared, by_emitter)

    def _allow_for_sum(
        self, prediction: Prediction, emitter: str, number: int, decisions: dict[EffectName, RenderingDecision]
    ) -> None:
        """Switch on effects that are inaudible alone, as long as leaving out all that are off is audible."""
        while True:
            made = [(effect, decisions[effect.name]) for effect in ENERGY_EFFECTS]
            off = [(effect, one) for effect, one in made if not one.called_for and one.change_jnd > 0]
            candidates = [(effect, one) for effect, one in off if effect.name not in self._overrides]
            if len(off) < 2 or not candidates:
                return
            without = frozenset(effect.name for effect, _ in off)
            if without not in self._without:
                (self._without[without],) = worst(prediction.changes([without]))
            together = self._without[without][number]
            if together.jnd < THRESHOLD.enter_jnd:
                return
            largest, _ = max(candidates, key=lambda each: each[1].change_jnd)
            others = [effect for effect, _ in off if effect is not largest]
            decisions[largest.name] = self._decide(largest, emitter, together, together_with=others)

    def _decide(
        self,
        effect: Effect,
        emitter: str | None,
        change: Change,
        *,
        beside: Collection[Mapping[EffectName, RenderingDecision]] = (),
        together_with: Sequence[EnergyEffect] = (),
    ) -> RenderingDecision:
        """Decide about one effect. `beside` are decisions, of this emitter or of all, among which an effect that it
        needs may be on."""
        wanted = self._overrides.get(effect.name)
        means_nothing = self._lacks(effect, beside)
        if means_nothing:
            change = UNCHANGED
        was_on = self._was_on(effect.name, emitter)
        cost = self._costs.get(effect.name)
        concerned = self._situation.emitters if emitter is None else {emitter: self._situation.emitters[emitter]}
        return RenderingDecision(
            name=effect.name,
            called_for=not means_nothing and THRESHOLD.decides(change.jnd, wanted, was_on=was_on),
            change_jnd=change.jnd,
            parameter=change.parameter,
            reason=means_nothing
            or reason(
                change,
                is_predicted=THRESHOLD.is_reached(change.jnd, was_on=was_on),
                wanted=wanted,
                absence=self._absence(effect, emitter),
                together_with=[other.title for other in together_with],
            ),
            overridden=wanted is not None,
            emitter=emitter,
            cost_us=None if cost is None else sum(self._cost_us(cost, each) for each in concerned.values()),
            memory_bytes=None if cost is None else cost.memory_bytes * len(concerned),
        )

    @staticmethod
    def _lacks(effect: Effect, beside: Collection[Mapping[EffectName, RenderingDecision]]) -> str:
        """Return why the effect is meaningless, since none of those it needs is on; else an empty string."""
        need = effect.needs
        if need is None or not beside or any(each[name].called_for for each in beside for name in need.any_of):
            return ""
        return need.absence

    def _absence(self, effect: Effect, emitter: str | None) -> str:
        if effect.needs is DIRECT_SOUND and self._situation.place.holds_direct_sound:
            return HOLDS_DIRECT_SOUND
        if effect.absence is None:
            return ""
        return effect.absence(self._situation, None if emitter is None else self._situation.emitters[emitter])

    def _cost_us(self, cost: Cost, emitter: Emitter) -> float:
        listener, share = self._situation.listener, 1 / len(self._situation.emitters)
        us = cost.us + share * cost.first_us
        if emitter.speed_m_s or listener.speed_m_s:
            return us + cost.moving_us + share * cost.moving_first_us
        return us + cost.turning_us + share * cost.turning_first_us if listener.hears_turns else us

    def _was_on(self, name: EffectName, emitter: str | None) -> bool:
        if self._previous is None:
            return False
        before = self._previous.shared if emitter is None else self._previous.by_emitter.get(emitter, {})
        return name in before and before[name].called_for
