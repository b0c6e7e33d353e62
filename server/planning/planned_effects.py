"""The plan of a session's effects, and when the session asks for another.

Plans are made off the audio thread: `take_request` returns what to plan, and `accept` takes the finished plan. A
session asks at once when an emitter comes or goes, an override changes, or something starts to move or moves faster
than before. While poses change it asks at most twice a second, once a second for many emitters, and less often where
plans take more than their share of time. Clocks are in seconds of sound.
"""

import dataclasses
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

from server.acoustics.geometry import Pose
from server.acoustics.surroundings import Surroundings
from server.planning.catalogue import emitter_effects, shared_effects
from server.planning.cost import Costs
from server.planning.motion import Motion
from server.planning.plan import Plan, RenderingDecision
from server.planning.planner import make_plan
from server.planning.scene_acoustics import Emitter, Listener, Output, SceneAcoustics, Situation, turns_with_head
from server.responses.effect_flags import EmitterEffects, SharedEffects
from server.responses.emitter_state import EmitterState
from server.scene.effects import EffectName, Overrides

PERIOD_S = 0.5
_EMITTERS_PER_PERIOD, _MOST_PERIODS = 8, 2
"""Plans of more than 8 emitters take longer and are made less often, at the least every second period."""
_LONGEST_S = 2.0
"""The longest interval between plans while poses change, well within the `HORIZON_S` that each plan looks ahead."""
_GRID_M = 0.25
"""Poses that differ by less call for no new plan."""


@dataclass(frozen=True)
class PlanRequest:
    """A plan to make. `corrections` are effects that were off but turned out to be audible, each with the reason why it
    is on."""

    situation: Situation
    previous: Plan | None
    overrides: Overrides
    corrections: Mapping[EffectName, str]
    costs: Costs

    @property
    def is_first(self) -> bool:
        """Whether the situation has an emitter that is in no plan yet."""
        return self.previous is None or not self.situation.emitters.keys() <= self.previous.by_emitter.keys()

    def plan(self) -> Plan:
        """Make the plan, in milliseconds that grow with the number of emitters: not for the audio thread."""
        overrides = {**dict.fromkeys(self.corrections, True), **self.overrides}
        plan = make_plan(self.situation, previous=self.previous, overrides=overrides, costs=self.costs)
        return _explained(plan, {name: why for name, why in self.corrections.items() if name not in self.overrides})


class PlannedEffects:
    """The plans of one session in `place`. Overrides by the listener (`own`) take precedence over those by the scene's
    author (`scene`). `costs` returns what effects cost on this host at quality levels with a bus of the given order, or
    without one; nothing while that is unknown."""

    def __init__(
        self,
        place: SceneAcoustics,
        listener: Pose,
        *,
        output: Output = "headphones",
        scene: Overrides | None = None,
        own: Overrides | None = None,
        costs: Callable[[int | None], Costs] = lambda _: {},
    ) -> None:
        self.place = place
        self.output = output
        self._bus: int | None = None
        self.plan: Plan | None = None
        self.corrections: dict[EffectName, str] = {}
        self._scene = dict(scene or {})
        self._own = dict(own or {})
        self._costs = costs
        self._listener = Motion(listener, 0.0)
        self._emitters: dict[str, Motion] = {}
        self._is_stale = False
        self._in_flight = False
        self._next_look_s = 0.0
        self._interval_s = 0.0
        self._seen: object = None

    @property
    def wishes(self) -> dict[EffectName, bool]:
        """The overrides by the listener."""
        return dict(self._own)

    @property
    def overrides(self) -> dict[EffectName, bool]:
        return {**self._scene, **self._own}

    @property
    def shared(self) -> SharedEffects:
        """The shared effects; without a plan, the output decides whether there is a head."""
        if self.plan is None or not self.plan.shared:
            return SharedEffects(head=self.overrides.get(EffectName.HRTF, self.output == "headphones"))
        return shared_effects(self.plan)

    def move_to(self, surroundings: Surroundings) -> None:
        """Plan from now on for other surroundings: doors have moved."""
        self.place = dataclasses.replace(self.place, surroundings=surroundings)
        self._is_stale = True

    def wish(self, wishes: Mapping[EffectName, bool | None], output: Output | None) -> None:
        """Switch effects on or off by hand, or with None leave them to the plan or the scene; change the output if
        given."""
        for name, is_on in wishes.items():
            if is_on is None:
                self._own.pop(name, None)
            else:
                self._own[name] = is_on
        self.output = output or self.output
        self._is_stale = True

    def wish_as(self, other: "PlannedEffects") -> None:
        """Have the overrides by the listener, and the output, that `other` has by now."""
        self._own, self.output = dict(other._own), other.output
        self._is_stale = True

    def hear_by_bus(self, order: int | None) -> None:
        """Plan from now on for a quality level with a bus of this order, or for one without."""
        self._is_stale |= order != self._bus
        self._bus = order

    def correct(self, corrections: Mapping[EffectName, str]) -> None:
        """Keep effects on from now on, for the reasons given."""
        self.corrections.update(corrections)
        self._is_stale = True

    def follow_listener(self, pose: Pose, clock_s: float) -> None:
        turned = self._hears_turns(clock_s)
        self._follow(self._listener, pose, clock_s)
        self._is_stale |= turned != self._hears_turns(clock_s)

    def follow_emitter(self, name: str, pose: Pose, clock_s: float) -> None:
        """Note the pose of an emitter; a new emitter is at rest until it moves."""
        motion = self._emitters.get(name)
        if motion is None:
            self._emitters[name] = Motion(pose, clock_s)
            self._is_stale = True
            return
        self._follow(motion, pose, clock_s)

    def _follow(self, motion: Motion, pose: Pose, clock_s: float) -> None:
        """Note a pose. The plan becomes stale if the motion starts, ends or gets faster."""
        moved, speed_m_s = motion.moves(clock_s), motion.speed_m_s(clock_s)
        motion.follow(pose, clock_s)
        self._is_stale |= moved != motion.moves(clock_s) or motion.speed_m_s(clock_s) > speed_m_s

    def forget_emitter(self, name: str) -> None:
        self._emitters.pop(name, None)
        self._is_stale = True

    def space(self, interval_s: float) -> None:
        """Set the least interval between plans while poses change, limited to how long a plan stays valid."""
        self._interval_s = min(interval_s, _LONGEST_S)

    def take_request(self, listener: Pose, emitters: Mapping[str, EmitterState], clock_s: float) -> PlanRequest | None:
        """Return the plan to make, or None if an earlier request is unanswered or nothing has changed."""
        if self._in_flight or not emitters or not (self._is_stale or clock_s >= self._next_look_s):
            return None
        periods = min(max(1.0, len(emitters) / _EMITTERS_PER_PERIOD), _MOST_PERIODS)
        self._next_look_s = clock_s + max(PERIOD_S * periods, self._interval_s)
        motion = self._listener
        situation = Situation(
            self.place,
            Listener(listener, motion.speed_m_s(clock_s), motion.turns(clock_s), self.output, self._bus),
            {name: self._emitter(name, emitter, clock_s) for name, emitter in emitters.items()},
        )
        costs = self._costs(self._bus)
        seen = _coarse(situation), bool(costs)
        if not self._is_stale and seen == self._seen:
            return None
        self._is_stale, self._seen, self._in_flight = False, seen, True
        return PlanRequest(situation, self.plan, self.overrides, dict(self.corrections), costs)

    def accept(self, plan: Plan) -> bool:
        """Put the plan asked for last into effect. Return whether it switches anything, or is the first that includes
        costs."""
        self._in_flight = False
        before, self.plan = self.plan, plan
        if before is None or _switched_on(before) != _switched_on(plan):
            return True
        return before.cost_us + before.saved_us == 0 < plan.cost_us + plan.saved_us

    def give_up(self) -> None:
        """Note that the request brought no plan: the effects stay as they are."""
        self._in_flight = False

    def of_emitter(self, name: str, clock_s: float, *, lacking: Collection[EffectName]) -> EmitterEffects | None:
        """Return an emitter's effects without those that the scene is `lacking`; None if the emitter is not in the plan
        yet."""
        if self.plan is None or name not in self.plan.by_emitter:
            return None
        effects = emitter_effects(self.plan.on(name) - set(lacking))
        holds_still = self.overrides.get(EffectName.PROPAGATION_DELAY) is False
        # The emitter may have begun to move since the plan was asked for.
        follows = effects.propagation_delay or (self._is_under_way(name, clock_s) and not holds_still)
        return dataclasses.replace(effects, propagation_delay=follows, holds_still=holds_still)

    def _is_under_way(self, name: str, clock_s: float) -> bool:
        """Whether the direct sound of an emitter changes with poses."""
        return self._emitters[name].moves(clock_s) or self._listener.moves(clock_s) or self._hears_turns(clock_s)

    def _hears_turns(self, clock_s: float) -> bool:
        """Whether the direct sound changes because the head turns."""
        return self._listener.turns(clock_s) and turns_with_head(self.output)

    def _emitter(self, name: str, state: EmitterState, clock_s: float) -> Emitter:
        motion = self._emitters[name]
        return Emitter(
            state.pose,
            state.pattern,
            gain_db=state.gain_db,
            speed_m_s=motion.speed_m_s(clock_s),
            turns=motion.turns(clock_s),
        )


def _coarse(situation: Situation) -> object:
    """Return the inputs of a plan, rounded so that differences which do not matter compare equal."""

    def cell(pose: Pose) -> tuple[int, ...]:
        return tuple(round(coordinate / _GRID_M) for coordinate in pose.position)

    listener = situation.listener
    emitters = tuple(
        (name, cell(emitter.pose), emitter.speed_m_s, emitter.turns, emitter.gain_db)
        for name, emitter in situation.emitters.items()
    )
    return cell(listener.pose), listener.speed_m_s, listener.hears_turns, emitters


def _switched_on(plan: Plan) -> frozenset[tuple[str | None, EffectName, bool, bool]]:
    return frozenset((each.emitter, each.name, each.called_for, each.overridden) for each in plan.decisions)


def _explained(plan: Plan, reasons: Mapping[EffectName, str]) -> Plan:
    """The plan, with `reasons` for the effects named there: a correction forced them on, no user did, so they do not
    count as overridden."""

    def explain(decisions: Mapping[EffectName, RenderingDecision]) -> dict[EffectName, RenderingDecision]:
        return {
            name: dataclasses.replace(each, reason=reasons[name], overridden=False)
            if name in reasons and each.overridden
            else each
            for name, each in decisions.items()
        }

    return Plan(explain(plan.shared), {name: explain(each) for name, each in plan.by_emitter.items()})
