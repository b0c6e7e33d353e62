"""What a stream notes of an emitter when its state changes."""

from dataclasses import FrozenInstanceError, replace

import pytest

from server.acoustics.directivity import CARDIOID, OMNIDIRECTIONAL
from server.acoustics.geometry import Pose
from server.protocol.client_messages import AddEmitter, DirectivityPattern, MoveEmitter
from server.protocol.snapshot import KeptEmitter
from server.responses.effect_flags import ALL_ON
from server.responses.emitter_state import EmitterState
from server.streaming.emitters import Stage, StreamedEmitter

HERE, THERE = (2.0, 2.0, 1.5), (6.0, 3.0, 1.5)
STANDS_STILL = replace(ALL_ON, propagation_delay=False)


@pytest.fixture
def emitter():
    found = StreamedEmitter(0, EmitterState(Pose(HERE)))
    found.is_outdated = found.is_displaced = False
    return found


def test_a_state_is_never_changed_but_replaced(emitter):
    before = emitter.state
    with pytest.raises(FrozenInstanceError):
        before.pose = Pose(THERE)
    emitter.set_gain(-6.0)
    emitter.move(MoveEmitter(id="a", pose_id=1, position=THERE))
    assert before == EmitterState(Pose(HERE))
    assert emitter.state == EmitterState(Pose(THERE), gain_db=-6.0)


def test_directivity_is_heard_only_where_its_effect_is_on():
    state = EmitterState(Pose(HERE), CARDIOID)
    assert state.directivity == CARDIOID
    assert replace(state, effects=replace(ALL_ON, directivity=False)).directivity == OMNIDIRECTIONAL


@pytest.mark.parametrize(("position", "is_outdated"), [(HERE, False), (THERE, True)])
def test_a_turn_on_the_spot_outdates_the_direct_path_alone(emitter, position, is_outdated):
    emitter.move(MoveEmitter(id="a", pose_id=1, position=position, yaw=1.0))
    assert (emitter.is_displaced, emitter.is_outdated) == (True, is_outdated)
    turned = emitter.state.pose.orientation
    emitter.move(MoveEmitter(id="a", pose_id=2, position=position))
    assert emitter.state.pose.orientation == turned


def test_it_goes_through_all_stages_once_and_is_announced_once():
    message = AddEmitter(id="a", clip="noise", position=HERE)
    emitter = StreamedEmitter.added_by(message, 0, None, Stage.UNDECIDED)
    assert not emitter.is_decided
    emitter.decide()
    assert emitter.stage is Stage.DECIDED
    assert [emitter.announce(clock) for clock in (256, 512)] == [True, False]
    assert emitter.since == 256
    emitter.decide()
    assert emitter.stage is Stage.ANNOUNCED


def test_direct_sound_is_baked_into_a_response_that_is_up_to_date_and_lacks_it(emitter):
    assert not emitter.wants_baking
    emitter.set_effects(STANDS_STILL)
    assert not emitter.wants_baking, "there is no response yet"
    emitter.heard.without_direct = object()  # any will do
    assert emitter.wants_baking
    emitter.is_outdated = True
    assert not emitter.wants_baking, "another response comes first"
    emitter.is_outdated, emitter.heard.bakes_direct = False, True
    assert not emitter.wants_baking, "it is baked already"


def test_a_response_that_is_discarded_is_no_poses(emitter):
    emitter.heard.identity = "node"
    emitter.discard_response()
    assert emitter.is_outdated
    assert emitter.heard.identity is None


def test_an_emitter_that_was_heard_in_the_lost_stream_is_not_announced_again():
    message = AddEmitter(id="a", clip="noise", position=HERE)
    emitter = StreamedEmitter.added_by(message, 0, None, since=256)
    assert not emitter.announce(1_024)
    assert emitter.since == 256


def test_what_is_kept_of_an_emitter_adds_it_where_it_is_now():
    message = AddEmitter(
        id="a", clip="noise", loop=False, position=HERE, yaw=1.0, directivity=DirectivityPattern(pattern="cardioid")
    )
    emitter = StreamedEmitter.added_by(message, 0, None)
    emitter.move(MoveEmitter(id="a", pose_id=1, position=(3.0, 1.0, 1.2)))
    emitter.set_gain(-3.0)
    emitter.announce(512)
    kept = KeptEmitter.model_validate_json(emitter.kept().model_dump_json())
    assert kept.since == 512
    again = StreamedEmitter.added_by(kept.emitter, 1, None, since=kept.since)
    assert again.state == emitter.state
    assert (kept.emitter.clip, kept.emitter.loop) == ("noise", False)
