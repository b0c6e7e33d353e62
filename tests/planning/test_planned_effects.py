"""When plans of effects are asked for, apart from any session."""

import numpy as np
import pytest

from server.acoustics.geometry import Pose
from server.planning.cost import Cost
from server.planning.places import place_of_field
from server.planning.planned_effects import PlannedEffects
from server.planning.reach import HORIZON_S
from server.responses.emitter_state import EmitterState
from server.scene.effects import EffectName

HERE, THERE = (2.0, 2.0, 1.5), (6.0, 3.0, 1.5)


@pytest.mark.parametrize("who", ["listener", "emitter"])
def test_what_moves_faster_than_it_did_is_planned_for_at_once(mirrored_field, who):
    planned = PlannedEffects(place_of_field(mirrored_field), Pose(HERE))
    emitters = {str(number): EmitterState(Pose(THERE)) for number in range(16)}
    for name, emitter in emitters.items():
        planned.follow_emitter(name, emitter.pose, 0.0)

    def asks(clock_s, way_m):
        if who == "listener":
            pose = Pose((HERE[0] + way_m, *HERE[1:]))
            planned.follow_listener(pose, clock_s)
        else:
            pose = Pose(HERE)
            emitters["0"] = EmitterState(Pose((THERE[0] - way_m, *THERE[1:])))
            planned.follow_emitter("0", emitters["0"].pose, clock_s)
        request = planned.take_request(pose, emitters, clock_s)
        if request is not None:
            planned.accept(request.plan())
        return request is not None

    assert asks(0.0, 0.0)
    assert asks(0.1, 0.1)  # it moves
    assert not any(asks(0.1 * step, 0.1 * step) for step in range(2, 8))  # as fast as before
    assert asks(0.8, 1.7)
    walks = [asks(0.8 + 0.1 * step, 1.7 + 0.03 * step) for step in range(1, 40)]
    assert 3 <= sum(walks) <= 5  # once a second, of so many


def test_a_plan_is_a_first_one_where_an_emitter_is_in_none_yet(mirrored_field):
    planned = PlannedEffects(place_of_field(mirrored_field), Pose(HERE))
    emitters = {}
    for number, (clock_s, is_first) in enumerate([(0.0, True), (10.0, False), (20.0, True)]):
        if is_first:
            emitters[str(number)] = EmitterState(Pose(THERE))
        pose = Pose((HERE[0] + 0.5 * number, *HERE[1:]))
        for name, emitter in emitters.items():
            planned.follow_emitter(name, emitter.pose, clock_s)
        planned.follow_listener(pose, clock_s)
        request = planned.take_request(pose, emitters, clock_s)
        assert request.is_first is is_first
        planned.accept(request.plan())


def test_plans_are_made_less_often_under_load_but_before_they_are_outdated(mirrored_field):
    planned = PlannedEffects(place_of_field(mirrored_field), Pose(HERE))
    emitters = {"one": EmitterState(Pose(THERE))}
    planned.follow_emitter("one", emitters["one"].pose, 0.0)

    def plans_of_a_walk(began_s):
        plans = []
        for step in range(60):
            clock_s = began_s + 0.1 * step
            pose = Pose((HERE[0] + 0.06 * step, *HERE[1:]))
            planned.follow_listener(pose, clock_s)
            if (request := planned.take_request(pose, emitters, clock_s)) is not None:
                planned.accept(request.plan())
                plans.append(clock_s)
        return np.array(plans[1:])  # the first is for a motion that is new

    assert np.diff(plans_of_a_walk(0.0)).max() == pytest.approx(0.6, abs=0.11)
    planned.space(1.2)
    assert np.diff(plans_of_a_walk(100.0)) == pytest.approx(1.2, abs=0.11)
    planned.space(60.0)
    assert np.diff(plans_of_a_walk(200.0)).max() < HORIZON_S - 0.8
    planned.wish({EffectName.AIR_ABSORPTION: False}, None)
    assert planned.take_request(Pose(HERE), emitters, 206.0) is not None  # whoever wishes does not wait


@pytest.mark.parametrize(("output", "asks"), [("headphones", True), ("ambisonics", False), ("mono", False)])
def test_a_head_that_begins_to_turn_asks_for_a_plan_only_where_it_is_heard(mirrored_field, output, asks):
    planned = PlannedEffects(place_of_field(mirrored_field), Pose(HERE), output=output)
    emitters = {"one": EmitterState(Pose(THERE))}
    planned.follow_emitter("one", emitters["one"].pose, 0.0)
    planned.accept(planned.take_request(Pose(HERE), emitters, 0.0).plan())
    for step in range(1, 50):
        clock_s = 0.1 * step
        pose = Pose.from_yaw(HERE, 0.1 * step)
        planned.follow_listener(pose, clock_s)
        assert (planned.take_request(pose, emitters, clock_s) is not None) is (asks and step == 1)
        if asks and step == 1:
            planned.give_up()


def test_another_bus_is_planned_for_at_once_and_at_its_costs(mirrored_field):
    costs = {None: {EffectName.HRTF: Cost(1.0)}, 1: {EffectName.HRTF: Cost(2.0)}}
    planned = PlannedEffects(place_of_field(mirrored_field), Pose(HERE), costs=lambda bus: costs[bus])
    emitters = {"one": EmitterState(Pose(THERE))}
    planned.follow_emitter("one", emitters["one"].pose, 0.0)

    def cost_us():
        request = planned.take_request(Pose(HERE), emitters, 0.1)
        if request is None:
            return None
        planned.accept(request.plan())
        return planned.plan.about(EffectName.HRTF)[0].cost_us

    assert cost_us() == 1.0
    planned.hear_by_bus(None)
    assert cost_us() is None
    planned.hear_by_bus(1)
    assert cost_us() == 2.0
