"""What waits for an audio thread: nothing is lost but poses that newer ones overtake, and outcomes come as they are."""

from concurrent.futures import Future

import pytest

from server.protocol.client_messages import AddEmitter, ListenerPose, MoveEmitter
from server.streaming.inbox import MAX_WAITING_MESSAGES, Inbox
from server.streaming.pending_work import PendingWork

HERE = (2.0, 2.0, 1.5)


def pose(number):
    return ListenerPose(pose_id=number, position=HERE)


def move(number):
    return MoveEmitter(id="a", pose_id=number, position=HERE)


@pytest.mark.parametrize(
    ("put", "left"),
    [
        ([pose(1), pose(2), pose(3)], [3]),
        ([pose(1), move(2), pose(3), pose(4)], [1, 2, 4]),
        ([pose(5), pose(4)], [5, 4]),
        ([move(1), move(2)], [1, 2]),
    ],
)
def test_a_newer_pose_takes_the_place_of_the_one_directly_before_it(put, left):
    inbox = Inbox()
    assert all(inbox.put_message(message, float(number)) for number, message in enumerate(put))
    assert [message.pose_id for _, message in inbox.take_messages()] == left
    assert not inbox.has_messages


def test_a_pose_that_overtakes_another_counts_from_the_others_arrival():
    inbox = Inbox()
    inbox.put_message(pose(1), 1.0)
    inbox.put_message(pose(2), 2.0)
    assert list(inbox.take_messages()) == [(1.0, pose(2))]


def test_too_many_are_refused_but_not_what_takes_the_place_of_another():
    inbox = Inbox()
    for number in range(MAX_WAITING_MESSAGES - 1):
        assert inbox.put_message(move(number), 0.0)
    assert inbox.put_message(pose(1), 0.0)
    assert not inbox.put_message(move(999), 0.0)
    assert inbox.put_message(pose(2), 0.0)
    assert len(list(inbox.take_messages())) == MAX_WAITING_MESSAGES


def test_an_emitter_that_comes_is_known_before_it_is_taken_in():
    inbox = Inbox()
    inbox.put_message(move(1), 0.0)
    assert not inbox.brings_emitter
    inbox.put_message(AddEmitter(id="a", clip="noise", position=HERE), 0.0)
    assert inbox.brings_emitter


def test_what_comes_of_work_is_kept_be_it_a_failure_and_nothing_of_what_was_called_off():
    pending, kept = PendingWork(), []
    done, failed, waiting = Future(), Future(), Future()
    for future in (done, failed, waiting):
        pending.keep_outcome(future, kept.append)
    failure = ValueError("no response")
    done.set_result(1)
    failed.set_exception(failure)
    pending.cancel()
    assert kept == [1, failure]
    assert waiting.cancelled()
