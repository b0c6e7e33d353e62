"""Which effects a situation calls for.

An effect is on from a change of one just-noticeable difference, and stays on down to 0.7 of one, so that nothing
flutters about a threshold. Each alone may be inaudible and all that is left out together not: then the largest of
them is on.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from server.planning.listening import SHARED, without_delay
from server.planning.prediction import UNCHANGED, Change, Off, Prediction, worst
from server.planning.reasons import reason
from server.planning.scene_acoustics import Emitter, Situation
from server.scene.effects import CATALOGUE, OF_DIRECT_SOUND, OF_RESPONSES, EffectName, Overrides
from server.scene.plan import Decision, Plan

ENTER_JND = 1.0
LEAVE_JND = 0.7

_OF_ENERGY = (
    EffectName.DIRECT_PATH,
    EffectName.DISTANCE_ATTENUATION,
    EffectName.AIR_ABSORPTION,
    EffectName.OCCLUSION,
    EffectName.DIRECTIVITY,
    EffectName.EARLY_REFLECTIONS,
    EffectName.LATE_REVERBERATION,
    EffectName.DIFFRACTION,
)
_OF_EACH = tuple(name for name, effect in CATALOGUE.items() if not effect.is_shared)


@dataclass(frozen=True)
class Cost:
    """Of one emitter, where an effect is on: microseconds per block and bytes; `moving_us` more while it or the
    listener moves, or `turning_us` while only the head turns. What it costs that there is any such emitter, all share:
    `first_us` and so on."""

    us: float
    memory_bytes: int
    moving_us: float = 0.0
    turning_us: float = 0.0
    first_us: float = 0.0
    moving_first_us: float = 0.0
    turning_first_us: float = 0.0


Costs = Mapping[EffectName, Cost]
"""As measured on this host; what is not in it was not."""


def make_plan(
    situation: Situation,
    *,
    previous: Plan | None = None,
    overrides: Overrides | None = None,
    costs: Costs | None = None,
) -> Plan:
    """The same for the same arguments. `previous` is the plan now in effect, whose decisions last a little longer than
    they would be made anew."""
    return _Planner(situation, previous, overrides or {}, costs or {}).plan()


class _Planner:
    def __init__(self, situation: Situation, previous: Plan | None, overrides: Overrides, costs: Costs) -> None:
        self._situation = situation
        self._previous = previous
        self._overrides = overrides
        self._costs = costs
        self._prediction = Prediction(situation) if situation.emitters else None
        self._without: dict[Off, list[Change]] = {}
        """Changes of all emitters without several effects at once: most emitters are without the same."""

    def plan(self) -> Plan:
        if self._prediction is None:
            return Plan({}, {})
        asked = [name for name in _OF_ENERGY if self._may_change(name)]
        changes = worst(self._prediction.changes([frozenset({name}) for name in asked]))
        by_emitter = {}
        for number, emitter in enumerate(self._situation.emitters):
            alone = {name: of_all[number] for name, of_all in zip(asked, changes, strict=True)}
            alone[EffectName.PROPAGATION_DELAY] = without_delay(self._prediction, number)
            by_emitter[emitter] = self._of_emitter(emitter, number, alone)
        shared = {}
        convolves = any(
            decisions[name].called_for
            for decisions in by_emitter.values()
            for name in (EffectName.EARLY_REFLECTIONS, EffectName.LATE_REVERBERATION)
        )
        for name, change_of in SHARED.items():
            change = change_of(self._prediction)
            means_nothing = name in OF_RESPONSES and not convolves
            shared[name] = self._decide(
                name, None, change, means_nothing="nothing is convolved" if means_nothing else ""
            )
        return Plan(shared, by_emitter)

    def _may_change(self, name: EffectName) -> bool:
        """Whether it can be asked at all; most situations have no corners and nobody who beams."""
        place = self._situation.place
        match name:
            case EffectName.OCCLUSION | EffectName.DIFFRACTION:
                return place.paths is not None
            case EffectName.DIRECTIVITY:
                return any(not emitter.is_omnidirectional for emitter in self._situation.emitters.values())
            case EffectName.EARLY_REFLECTIONS:
                return place.reflections is not None
            case _:
                return True

    def _of_emitter(self, emitter: str, number: int, alone: Mapping[EffectName, Change]) -> dict[EffectName, Decision]:
        direct = self._decide(EffectName.DIRECT_PATH, emitter, alone.get(EffectName.DIRECT_PATH, UNCHANGED))
        decisions = {EffectName.DIRECT_PATH: direct}
        for name in _OF_EACH:
            if name != EffectName.DIRECT_PATH:
                missing = "" if direct.called_for or name not in OF_DIRECT_SOUND else "there is no direct sound"
                decisions[name] = self._decide(name, emitter, alone.get(name, UNCHANGED), means_nothing=missing)
        self._allow_for_sum(emitter, number, decisions)
        return decisions

    def _allow_for_sum(self, emitter: str, number: int, decisions: dict[EffectName, Decision]) -> None:
        """Switch on what is inaudible alone while all that is off is audible together."""
        assert self._prediction is not None
        while True:
            off = [name for name in _OF_ENERGY if not decisions[name].called_for and decisions[name].change_jnd > 0]
            candidates = [name for name in off if name not in self._overrides]
            if len(off) < 2 or not candidates:
                return
            without = frozenset(off)
            if without not in self._without:
                (self._without[without],) = worst(self._prediction.changes([without]))
            together = self._without[without][number]
            if together.jnd < ENTER_JND:
                return
            largest = max(candidates, key=lambda name: decisions[name].change_jnd)
            others = [name for name in off if name != largest]
            decisions[largest] = self._decide(largest, emitter, together, together_with=others)

    def _decide(
        self,
        name: EffectName,
        emitter: str | None,
        change: Change,
        *,
        means_nothing: str = "",
        together_with: list[EffectName] | None = None,
    ) -> Decision:
        wanted = self._overrides.get(name)
        if means_nothing:
            change = UNCHANGED
        is_predicted = change.jnd >= (LEAVE_JND if self._was_on(name, emitter) else ENTER_JND)
        called_for = is_predicted if wanted is None else wanted and not means_nothing
        cost = self._costs.get(name)
        concerned = self._situation.emitters if emitter is None else {emitter: self._situation.emitters[emitter]}
        return Decision(
            name=name,
            emitter=emitter,
            called_for=called_for,
            change_jnd=change.jnd,
            parameter=change.parameter,
            cost_us=None if cost is None else sum(self._cost_us(cost, each) for each in concerned.values()),
            memory_bytes=None if cost is None else cost.memory_bytes * len(concerned),
            reason=means_nothing
            or reason(self._situation, name, emitter, change, is_predicted, wanted, together_with or []),
            overridden=wanted is not None,
        )

    def _cost_us(self, cost: Cost, emitter: Emitter) -> float:
        listener, share = self._situation.listener, 1 / len(self._situation.emitters)
        us = cost.us + share * cost.first_us
        if emitter.speed_m_s or listener.speed_m_s:
            return us + cost.moving_us + share * cost.moving_first_us
        return us + cost.turning_us + share * cost.turning_first_us if listener.turns else us

    def _was_on(self, name: EffectName, emitter: str | None) -> bool:
        if self._previous is None:
            return False
        before = self._previous.shared if emitter is None else self._previous.by_emitter.get(emitter, {})
        return name in before and before[name].called_for
