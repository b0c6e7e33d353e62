"""Budgets fill steadily and are never exceeded for long; poses are superseded only where nobody could tell."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.api.inflow import POSES_PER_S, USUAL, Allowance, Budget, message_cost, supersedes
from server.protocol.blocks import DryBlock, DryPackets
from server.protocol.client_messages import Acknowledge, ListenerPose, MoveEmitter, Ping


@given(
    st.lists(st.tuples(st.floats(0, 2), st.floats(0, 500), st.integers(0, 200_000)), min_size=1, max_size=60),
    st.floats(0, 1e6),
)
def test_who_waits_as_told_gets_no_more_than_the_rate_and_one_burst(spells, began_s):
    allowance = Allowance(messages_per_s=1_000, bytes_per_s=100_000)
    budget, now_s = Budget(allowance, began_s), began_s
    messages = nbytes = most_messages = most_bytes = 0
    for idle_s, count, size in spells:
        now_s += idle_s + budget.wait_s
        budget.spend(count, size, now_s)
        messages, nbytes = messages + count, nbytes + size
        most_messages, most_bytes = max(most_messages, count), max(most_bytes, size)
    now_s += budget.wait_s
    lasted_s = now_s - began_s + 0.25
    assert messages <= 1_000 * lasted_s + 1e-3
    assert nbytes <= 100_000 * lasted_s + 1e-3


def test_who_stays_below_the_rate_never_waits():
    budget = Budget(Allowance(messages_per_s=1_000, bytes_per_s=100_000), 0.0)
    for number in range(5_000):
        budget.spend(1, 100, number * 0.001)
        assert budget.wait_s == 0


def test_a_burst_is_not_held_up_and_the_next_one_waits_for_its_share():
    budget = Budget(Allowance(messages_per_s=1_000, bytes_per_s=1e9), 0.0)
    budget.spend(250, 0, 0.0)
    assert budget.wait_s == 0
    budget.spend(250, 0, 0.0)
    assert budget.wait_s == pytest.approx(0.25)
    budget.spend(0, 0, 0.25)
    assert budget.wait_s == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("sample_rate", [24_000, 48_000])
def test_the_most_talkative_player_there_can_be_never_waits(sample_rate):
    """Live blocks of 128 samples of 16 emitters, a pose every millisecond, an acknowledgement of every block."""
    budget = Budget(Allowance.of(emitters=16, sample_rate=sample_rate), 0.0)
    block_s = 128 / sample_rate
    live = DryBlock("emitter-12", 1, np.zeros(128, np.float32)).serialize("f32")
    pose = ListenerPose(pose_id=123_456, position=(1.25, 2.5, 1.5), orientation=(0.0, 0.0, 0.6, 0.8)).serialize()
    acknowledgement = Acknowledge(sequence=123_456).serialize()
    due = [(number * block_s, live, False) for number in range(int(2 / block_s)) for _ in range(16)]
    due += [(number * block_s, acknowledgement.encode(), True) for number in range(int(2 / block_s))]
    due += [(number * 0.001, pose.encode(), True) for number in range(2_000)]
    for now_s, message, is_text in sorted(due, key=lambda each: each[0]):
        budget.spend(message_cost(message, is_text=is_text), len(message) + 8, now_s)
        assert budget.wait_s == 0


@pytest.mark.parametrize("frame_ms", [5, 10, 20, 60])
@pytest.mark.parametrize("sample_rate", [24_000, 48_000])
def test_microphones_in_opus_never_wait(sample_rate, frame_ms):
    budget = Budget(Allowance.of(emitters=16, sample_rate=sample_rate), 0.0)
    frames = sample_rate * frame_ms // 1000
    live = DryPackets("emitter-12", 1, frames, (bytes(2 * frame_ms * 8),)).serialize()
    for number in range(3_000 // frame_ms):
        for _ in range(16):
            budget.spend(message_cost(live, is_text=False), len(live) + 8, number * frame_ms / 1000)
        assert budget.wait_s == 0


def test_a_block_in_opus_costs_by_how_long_it_says_it_lasts_and_never_without_end():
    costs = [
        message_cost(DryPackets("a", 1, frames, (b"x",)).serialize(), is_text=False)
        for frames in (120, 480, 2_880, 2**32 - 1)
    ]
    assert costs == [1.0, 2.5, 12.5, 12.5]


def text(pose_id, **more):
    return ListenerPose(pose_id=pose_id, position=(1.0, 2.0, 1.5), **more).serialize().encode()


def binary(pose_id):
    return ListenerPose(pose_id=pose_id, position=(1.0, 2.0, 1.5)).serialize_binary()


@pytest.mark.parametrize("pose", [text, binary, lambda pose_id: text(pose_id, yaw=0.5)])
def test_a_pose_gives_way_to_a_newer_one_alone(pose):
    assert supersedes(pose(300), pose(299))
    assert not supersedes(pose(299), pose(299))
    assert not supersedes(pose(256), pose(257))


def test_poses_that_others_write_are_seen_too():
    spaced = b'{"type": "listener", "pose_id": 12, "position": [1, 2, 1.5]}'
    compact = b'{"type":"listener","position":[1,2,1.5],"pose_id":13}'
    assert supersedes(compact, spaced)


@pytest.mark.parametrize(
    "other",
    [
        Ping(id=1).serialize().encode(),
        Acknowledge(sequence=1).serialize().encode(),
        MoveEmitter(id="listener", position=(1.0, 2.0, 1.5), pose_id=1).serialize().encode(),
        DryBlock("a", 0, np.zeros(4, np.float32)).serialize("f32"),
        binary(1)[:-1],
        b"",
        b'{"type":"listener","pose_id":1,"position":[1,2,1],"type":"ping","id":3}',
        b'{"type":"listener","pose_id":1,"pose_id":7,"position":[1,2,1]}',
        b'{"type":"listener","pose_id":"1","position":[1,2,1]}',
        b'{"type":"move_emitter","id":"\\"type\\":\\"listener\\",","pose_id":1,"position":[1,2,1]}',
        b'{"type":"listener","pose_id":1.5,"position":[1,2,1]}',
    ],
)
def test_nothing_else_gives_way_or_makes_others_give_way(other):
    for pose in (text(9), binary(9)):
        assert not supersedes(pose, other)
        assert not supersedes(other, pose)


def test_the_usual_allowance_is_that_of_sixteen_live_emitters():
    """375 blocks a second: half of 6,000 for live ones, 1,000 poses, 375 acknowledgements, 1,920 moves."""
    assert USUAL.messages_per_s == 6_295


def test_every_listener_may_walk_and_acknowledge():
    one, three = (Allowance.of(emitters=2, sample_rate=24_000, listeners=count) for count in (1, 3))
    more = three.messages_per_s - one.messages_per_s
    assert more == pytest.approx(2 * (POSES_PER_S + 24_000 / 128))
    assert three.bytes_per_s > one.bytes_per_s
