"""Laws that every kind of quality level obeys, on levels of each that are worth measuring."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from server.acoustics.geometry import Pose
from server.field.field import AcousticField
from server.field.kinds.catalogue import KINDS, kind_of
from server.field.kinds.every_pose import EveryPose
from server.field.lattice import delay_response
from server.scene.manifest import QualityLevel

RNG = np.random.default_rng(3)
PLACES = [tuple(map(float, place)) for place in RNG.uniform((0.4, 0.4, 0.6), (7.6, 4.6, 2.2), (12, 3))]
POSES = list(zip(PLACES[:6], PLACES[6:], map(float, RNG.uniform(-3, 3, 6)), strict=True))


def levels_of(kind):
    tried = list(kind.candidates("arithmetic"))
    return [*tried[:1], *tried[1:][-1:]]


LEVELS = [QualityLevel(name="anew", field="arithmetic"), *(level for kind in KINDS for level in levels_of(kind))]


@pytest.fixture(params=LEVELS, ids=lambda level: level.name)
def at_level(request, bundle, field):
    return AcousticField(bundle, request.param, field.graph)


def test_kinds_that_reuse_responses_have_levels_to_try():
    assert {type(kind_of(level)) for level in LEVELS} == set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_a_level_that_a_kind_has_tried_is_of_that_kind_alone(kind):
    for level in kind.candidates("arithmetic"):
        assert type(kind_of(level)) is kind
        assert [other for other in KINDS if other is not EveryPose and other.matches(level)] == [kind]
        assert kind_of(level).title[0].isupper()


def test_a_pose_has_the_response_of_what_stands_for_it(at_level, field):
    for listener, emitter, yaw in POSES:
        response = at_level.impulse_responses([listener], [emitter], [yaw])[0]
        assert_array_equal(response, at_level.source.response(at_level.snap(listener, emitter, yaw)))
        node, later = at_level.snap(listener, emitter, yaw)
        exact = field.impulse_responses([node.listener], [node.emitter], [node.yaw])[0]
        assert_array_equal(response, delay_response(exact, later))


def test_where_a_listener_is_sure_to_have_the_same_it_has(at_level):
    for listener, emitter, yaw in POSES:
        snapped, around = at_level.find(listener, emitter, yaw)
        assert snapped == at_level.snap(listener, emitter, yaw)
        for off_m, turned in ((0.0, 0.0), (0.0, 2.0), (0.002, 0.0), (0.02, 0.1), (0.2, 0.4)):
            pose = Pose.from_yaw((listener[0] + off_m, listener[1], listener[2]), yaw + turned)
            if around.holds(pose):
                assert at_level.snap(pose.position, emitter, pose.yaw) == snapped


def test_energies_are_those_of_what_stands_for_poses(at_level, field):
    listeners, emitters, yaws = (np.array(part) for part in zip(*POSES, strict=True))
    stand_ins = at_level.source.computed_for(listeners, emitters, yaws)
    assert_array_equal(at_level.energy(listeners, emitters, yaws), field.energy(*stand_ins))


def test_moved_responses_are_of_elsewhere_if_poses_share_any(at_level):
    moved = at_level.source.moved(np.random.default_rng(1))
    before = [at_level.snap(*pose) for pose in POSES]
    after = [moved.snap(*pose) for pose in POSES]
    assert [at_level.snap(*pose) for pose in POSES] == before
    if at_level.kind.reuses_responses:
        assert all(one.node != other.node for one, other in zip(before, after, strict=True))
    else:
        assert before == after


@pytest.mark.parametrize("level", LEVELS, ids=lambda level: level.name)
def test_whole_responses_are_shared_only_where_the_field_is(level):
    kind = kind_of(level)
    assert kind.shares_whole_responses(has_reflections=False) == kind.reuses_responses
    assert kind.shares_whole_responses(has_reflections=True) == (kind.reuses_responses and kind.shares_reflections)


def test_what_emitters_share_is_asked_of_every_kind():
    for level in LEVELS:
        shared = level.model_copy(update={"shared_tail": True})
        assert kind_of(shared).shares_tail
        assert not kind_of(level).shares_tail
        assert "shared late reverberation" in kind_of(shared).title.lower()


def test_poses_that_are_computed_anew_stand_for_themselves(bundle, field):
    anew = AcousticField(bundle, LEVELS[0], field.graph)
    (node, later), around = anew.find(*POSES[0])
    assert (tuple(node), later) == (POSES[0], 0)
    assert not around.holds(Pose.from_yaw(POSES[0][0], POSES[0][2]))
