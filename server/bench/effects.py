"""What plans of effects save, and their errors, in six situations.

A session plays each situation three times: with the effects of its plan, with all effects on, and with all effects off.
The responses with the plan, and those without each single effect of the plan, are compared with those with all effects
on, in just-noticeable differences.

- `plan_us`, `all_us`, `none_us`: time of the rendering thread per block of 256 samples, as a median of rounds in which
  the three take turns. It includes impulse responses and plans where any are made.
- `sum_us`: the time with all effects off plus the cost of each effect that is on, measured on this host in each of the
  same rounds. `ratio` is the median over rounds of the plan's time over that sum.
- `error_jnd`: difference between the plan and all effects on, in the parameter where it is largest. `least_jnd`: of all
  effects that are on, the change without the one that matters least, in the parameter that it changes most.
"""

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from server.acoustics.difference import audible_difference
from server.acoustics.geometry import Pose, Vector3
from server.bench.rooms import FloatArray, noise
from server.bench.statistical_field import Room, StatisticalField, box
from server.field.field import AcousticField
from server.field.fields_by_level import FieldsByLevel
from server.planning.catalogue import CATALOGUE, MOTION_EFFECTS, emitter_effects, shared_effects
from server.planning.cost import Costs
from server.planning.effect_costs import measure_costs
from server.planning.places import place_of_field, reverberation_of
from server.planning.plan import Plan
from server.planning.planner import make_plan
from server.planning.scene_acoustics import Emitter, Listener, Output, Situation
from server.protocol.client_messages import (
    PROTOCOL,
    AddEmitter,
    BlockSize,
    Hello,
    ListenerPose,
    ListenerStart,
    MoveEmitter,
)
from server.rendering.convolver import Sharing
from server.rendering.hrtf import kemar
from server.rendering.ingest import DryAudio
from server.rendering.renderer import Renderer
from server.rendering.sources import ClipPlayer
from server.responses.direct_sound import DirectSound
from server.responses.emitter_state import EmitterState
from server.responses.ir_request import composed_irs, compute_irs
from server.scene.bundle import Bundle, find_bundle
from server.scene.effects import EffectName, Overrides
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session

BLOCK_SIZE: BlockSize = 256
_POSES_PER_S = 30.0
_ROUNDS = 9
_BLOCKS = 96
_SETTLE_S = 3.0


@dataclass(frozen=True)
class Scenario:
    """Positions and motion of a listener and emitters, in metres and in metres per second along x."""

    name: str
    field: Callable[[], AcousticField]
    listener: Vector3
    emitters: tuple[Vector3, ...]
    listener_m_s: float = 0.0
    emitter_m_s: float = 0.0
    turns: bool = False
    output: Output = "headphones"


@cache
def _open_field() -> AcousticField:
    return AcousticField.load(Bundle.load(find_bundle("open-field")))


@cache
def _room(name: str, size_m: tuple[float, float, float], absorption: float) -> AcousticField:
    return StatisticalField(name, (Room((0.0, 0.0), size_m, absorption),), box((0.0, 0.0), size_m))


@cache
def _two_rooms() -> AcousticField:
    """Return two rooms with a wall between them, 0.2 m thick, and a doorway of 0.9 m at one end of it."""
    rooms = Room((0.0, 0.0), (4.0, 4.0, 2.6), 0.3), Room((4.2, 0.0), (4.0, 4.0, 2.6), 0.3)
    corners = (
        *((0.0, 0.0), (4.0, 0.0), (4.0, 2.9), (4.2, 2.9), (4.2, 0.0)),
        *((8.2, 0.0), (8.2, 4.0), (4.2, 4.0), (4.2, 3.8), (4.0, 3.8), (4.0, 4.0), (0.0, 4.0)),
    )
    return StatisticalField("two-rooms", rooms, corners, doorway_m2=0.9 * 2.6)


_HALL = 20.0, 14.0, 7.0
SCENARIOS = (
    Scenario("open field", _open_field, (0.0, 0.0, 1.5), ((5.0, 2.0, 1.5),), turns=True),
    Scenario(
        "anechoic room",
        lambda: _room("anechoic", (5.0, 4.0, 3.0), 0.995),
        (1.5, 2.0, 1.5),
        ((3.2, 2.4, 1.5),),
        turns=True,
    ),
    Scenario(
        "small rectangular room, all at rest",
        lambda: _room("small", (4.0, 3.0, 2.5), 0.2),
        (1.0, 1.2, 1.5),
        ((2.9, 1.9, 1.5),),
    ),
    Scenario(
        "two rooms, a wall between", _two_rooms, (2.0, 1.5, 1.5), ((5.0, 3.2, 1.5),), listener_m_s=0.5, turns=True
    ),
    Scenario("an emitter passes by", _open_field, (0.0, 0.0, 1.5), ((-20.0, 4.0, 1.5),), emitter_m_s=10.0),
    Scenario(
        "sixteen emitters in a hall, a listener who sits still",
        lambda: _room("hall", _HALL, 0.15),
        (6.0, 7.0, 1.5),
        tuple((4.0 + 1.7 * (number % 8), 3.0 + 8.0 * (number // 8), 1.5) for number in range(16)),
    ),
)


def measure_effects(scenarios: Sequence[Scenario], advance: Callable[[str], None]) -> list[dict[str, Any]]:
    """Measure all scenarios, and return one row for each."""
    rows = []
    for scenario in scenarios:
        rows.append({"situation": scenario.name, **times_of(scenario), **errors_of(scenario, plan_of(scenario))})
        advance(scenario.name)
    return rows


def situation_of(scenario: Scenario) -> Situation:
    """Return the situation as a session would give it to the planner during the scenario's motion."""
    field = scenario.field()
    listener = Pose(scenario.listener)
    held: list[Any] = [None] * len(scenario.emitters)
    if field.bundle.manifest.fields:
        held = list(reverberation_of(field, listener, scenario.emitters))
    return Situation(
        place_of_field(field, BLOCK_SIZE),
        Listener(listener, scenario.listener_m_s, scenario.turns, scenario.output),
        {
            str(number): Emitter(Pose(place), speed_m_s=scenario.emitter_m_s, reverberation=rest)
            for number, (place, rest) in enumerate(zip(scenario.emitters, held, strict=True))
        },
    )


def plan_of(scenario: Scenario, overrides: Overrides | None = None, *, costs: Costs | None = None) -> Plan:
    return make_plan(situation_of(scenario), overrides=overrides, costs=costs)


def everything(*, is_on: bool = True) -> dict[EffectName, bool]:
    """Return overrides that switch all effects on or off."""
    return dict.fromkeys(EffectName, is_on)


def without(plan: Plan, name: EffectName) -> Plan:
    """Return the plan with one effect switched off; `plan` has everything on."""

    def switched(decisions: Mapping[EffectName, Any]) -> dict[EffectName, Any]:
        return {each: replace(made, called_for=made.called_for and each != name) for each, made in decisions.items()}

    return Plan(switched(plan.shared), {emitter: switched(made) for emitter, made in plan.by_emitter.items()})


def heard(scenario: Scenario, plan: Plan) -> FloatArray:
    """Return the full responses (emitter, 2, sample) with a plan, at the initial poses; a mono output is the same at
    both ears."""
    field = scenario.field()
    direct = _direct_sound(field)
    shared = shared_effects(plan)
    channels = shared.channels
    emitters = []
    for number, place in enumerate(scenario.emitters):
        # At the initial poses, a fixed delay equals one that follows.
        on = plan.on(str(number)) | {EffectName.PROPAGATION_DELAY}
        if not field.bundle.manifest.fields:
            on -= {EffectName.LATE_REVERBERATION}
        emitters.append(EmitterState(Pose(place), effects=emitter_effects(on)))
    listener = Pose(scenario.listener)
    looked_from = listener
    if not shared.head_rotation and scenario.turns:
        looked_from = Pose.from_yaw(scenario.listener, math.pi / 2)
    responses = composed_irs(field, direct, looked_from, emitters, channels)
    if not shared.own_tails and len(emitters) > 1:
        responses = _with_shared_tail(responses, field.sample_rate)
    rows = [row for row, each in enumerate(emitters) if each.effects.direct_path]
    whole = responses[rows]
    direct.add(whole, listener, [emitters[row] for row in rows])
    responses[rows] = whole
    return np.repeat(responses, 2, axis=1) if channels == 1 else responses


def errors_of(scenario: Scenario, plan: Plan) -> dict[str, Any]:
    """Return the error of a plan, and the change without the effect that matters least among those it has on."""
    whole = plan_of(scenario, everything())
    reference = heard(scenario, whole)
    by_parameter = _difference(scenario, reference, heard(scenario, plan))
    parameter = max(by_parameter, key=by_parameter.__getitem__)
    least, name = math.inf, None
    for each in EffectName:
        if plan.is_on(each):
            change = change_without(scenario, whole, each, reference)
            least, name = (change, each) if change < least else (least, name)
    return {
        "on": [CATALOGUE[each].title for each in EffectName if plan.is_on(each)],
        "error_jnd": by_parameter[parameter],
        "error_in": parameter,
        "errors_jnd": by_parameter,
        "least_jnd": least,
        "least_of": None if name is None else CATALOGUE[name].title,
    }


def change_without(scenario: Scenario, whole: Plan, name: EffectName, reference: FloatArray) -> float:
    """Return the change in JND without one effect, in the parameter that it changes most. For an effect that only
    motion shows it is the planner's prediction, since responses do not show it."""
    if CATALOGUE[name] in MOTION_EFFECTS:
        (decision, *_) = whole.about(name)
        return decision.change_jnd
    return max(_difference(scenario, reference, heard(scenario, without(whole, name))).values())


def _difference(scenario: Scenario, reference: FloatArray, other: FloatArray) -> dict[str, float]:
    """Return the largest difference over all emitters, by parameter."""
    field = scenario.field()
    onsets_s = field.onset_s([scenario.listener] * len(scenario.emitters), scenario.emitters)
    most: dict[str, float] = {}
    for before, after, onset_s in zip(reference, other, onsets_s, strict=True):
        for parameter, jnd in audible_difference(before, after, field.sample_rate, onset_s=float(onset_s)).items():
            most[parameter] = max(most.get(parameter, 0.0), jnd)
    return most


@cache
def _direct_sound(field: AcousticField) -> DirectSound:
    return DirectSound.of(field.bundle, kemar(field.sample_rate))


def _with_shared_tail(responses: FloatArray, sample_rate: int) -> FloatArray:
    """Return the responses as a renderer plays them if all emitters share one tail."""
    count, channels, samples = responses.shape
    blocks = -(-samples // BLOCK_SIZE)
    played = np.zeros((count, channels, blocks * BLOCK_SIZE), np.float32)
    for row in range(count):
        renderer = Renderer(
            block_size=BLOCK_SIZE,
            ir_samples=samples,
            sample_rate=sample_rate,
            filters=None,
            speed_of_sound=343.0,
            air_db_per_m=np.zeros(7),
            max_emitters=count,
            shared_tail=True,
            outputs=channels,
            has_head=channels == 2,
        )
        for other, response in enumerate(responses):
            clip = np.zeros(1, np.float32) if other != row else np.ones(1, np.float32)
            renderer.add_emitter(str(other), ClipPlayer(DryAudio(clip), loop=False))
            renderer.set_ir(str(other), response)
        for block in range(blocks):
            played[row, :, block * BLOCK_SIZE : (block + 1) * BLOCK_SIZE] = renderer.process()
    return played[..., :samples]


class _Player:
    """A session of a scenario whose requests are answered at once; moving objects go back and forth."""

    def __init__(self, scenario: Scenario, effects: Overrides) -> None:
        self._scenario = scenario
        self._field = field = scenario.field()
        self._levels = FieldsByLevel([field])
        clip = DryAudio(0.05 * noise(0, field.sample_rate))
        hello = Hello(
            protocol=PROTOCOL,
            scene=field.bundle.id,
            block_size=BLOCK_SIZE,
            listener=ListenerStart(position=scenario.listener),
            output=scenario.output,
            effects={name.value: is_on for name, is_on in effects.items()},
        )
        self._session = Session(
            hello,
            self._levels,
            kemar(field.sample_rate),
            lambda _: clip,
            quality=QualityStep(field.level.name, None, Sharing.NOTHING, 1.0),
            window=10_000_000,
            place=place_of_field(field, BLOCK_SIZE),
        )
        for number, place in enumerate(scenario.emitters):
            self._session.receive(AddEmitter(id=str(number), clip="noise", position=place))
        self._pose_id = self._block = 0
        self._blocks_per_pose = max(1, round(field.sample_rate / BLOCK_SIZE / _POSES_PER_S))
        self.play(round(_SETTLE_S * field.sample_rate / BLOCK_SIZE))

    def play(self, blocks: int = _BLOCKS) -> None:
        for _ in range(blocks):
            if self._block % self._blocks_per_pose == 0:
                self._move()
            self._block += 1
            if (asked := self._session.take_plan_request()) is not None:
                self._session.adopt(asked.plan())
            if (request := self._session.take_request()) is not None:
                self._session.accept(compute_irs(self._levels, request, self._session.renderer))
            self._session.render_block()

    def _move(self) -> None:
        scenario = self._scenario
        clock_s = self._session.sample_clock / self._field.sample_rate
        if scenario.turns or scenario.listener_m_s:
            self._pose_id += 1
            position = _along(scenario.listener, scenario.listener_m_s, clock_s)
            yaw = 0.5 * math.sin(clock_s) if scenario.turns else 0.0
            self._session.receive(ListenerPose(pose_id=self._pose_id, position=position, yaw=yaw))
        for number, place in enumerate(scenario.emitters):
            if scenario.emitter_m_s:
                self._pose_id += 1
                position = _along(place, scenario.emitter_m_s, clock_s)
                self._session.receive(MoveEmitter(pose_id=self._pose_id, id=str(number), position=position))


def _along(start: Vector3, speed_m_s: float, clock_s: float) -> Vector3:
    """Return a position that moves away along x for two seconds and back for two."""
    away_s = 2.0 - abs(clock_s % 4.0 - 2.0)
    return start[0] + speed_m_s * away_s, start[1], start[2]


def times_of(scenario: Scenario) -> dict[str, float]:
    """Measure the microseconds per block of all variants in turns, with the cost of effects measured in the same
    turns."""
    players = {
        "plan_us": _Player(scenario, {}),
        "all_us": _Player(scenario, everything()),
        "none_us": _Player(scenario, everything(is_on=False)),
    }
    rounds = []
    for _ in range(_ROUNDS):
        us = {name: _us_per_block(player) for name, player in players.items()}
        costs = measure_costs(scenario.field(), BLOCK_SIZE)
        us["sum_us"] = us["none_us"] + plan_of(scenario, costs=costs).cost_us
        rounds.append({**us, "ratio": us["plan_us"] / us["sum_us"]})
    return {name: statistics.median(each[name] for each in rounds) for name in rounds[0]}


def _us_per_block(player: _Player) -> float:
    started_s = time.thread_time()
    player.play()
    return 1e6 * (time.thread_time() - started_s) / _BLOCKS
