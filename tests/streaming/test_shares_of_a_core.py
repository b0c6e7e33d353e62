"""What is prepared for sound takes no more of a core than its share, which the streams of an audio thread divide."""

import time

import pytest

from server.planning.plan import Plan
from server.protocol.client_messages import AddEmitter, ListenerPose
from server.streaming import audio_engine
from server.streaming.load_policy import decide
from server.streaming.load_thresholds import THRESHOLDS
from server.streaming.plan_audit import Regret
from tests.engine_stage import BLOCK_S, Stage


@pytest.fixture
def stage(field, filters):
    return Stage(field, filters)


@pytest.mark.parametrize(("busy", "share"), [(0.0, 0.25), (0.6, 0.15), (0.95, 0.25 / 3)])
def test_the_busier_a_thread_the_less_its_responses_may_take(stage, busy, share, monkeypatch):
    """Rendering takes `busy` of the time of a clock that stands still otherwise."""
    (stream, _), shares = stage.open(window=10_000), []
    follow_poses = stream.session.begin_block

    def take_time():
        follow_poses()
        stage.clock.now_s += busy * BLOCK_S * stage.thread._blocks_of(stream)

    def note(decided):
        shares.append(decided[1].ir_share)
        return decided

    stream.session.begin_block = take_time
    monkeypatch.setattr(audio_engine, "decide", lambda *given: note(decide(*given)))
    while len(shares) < 8:
        stage.thread.tick()
        stage.clock.now_s = max(stage.clock.now_s, stream.due_s)
    assert shares[2:] == pytest.approx([share] * 6, abs=0.02)


class Check:
    """Of a plan, which finds nothing and takes a fifth of a second of CPU time."""

    level = "standard"

    def run(self, _field):
        return Regret({}, {}, cost_s=0.2)


@pytest.mark.parametrize(("streams", "checks"), [(1, 2), (8, 1)])
def test_the_more_streams_share_a_thread_the_less_often_each_is_checked(stage, streams, checks):
    """Alone, every 20 s of sound from 2 s on; of eight, every 80 s."""
    opened = [stage.open(window=10_000)[0] for _ in range(streams)]
    for stream in opened:
        stream.session.take_check = Check
    for _ in range(30):
        stage.run(1.0, step_s=BLOCK_S / 2)
        stage.workers.run()
    assert [stream.regrets.checks for stream in opened] == [checks] * streams


class SlowPlan:
    """A request for one, which takes a few milliseconds of CPU time."""

    is_first = False

    def plan(self):
        until_s = time.thread_time() + 0.004
        while time.thread_time() < until_s:
            pass
        return Plan({}, {})


def test_the_more_streams_share_a_thread_the_less_often_plans_are_made(stage):
    opened = [stage.open(window=10_000)[0] for _ in range(5)]
    intervals_s = []
    for stream in opened:
        requests = [SlowPlan()]
        stream.session.take_plan_request = lambda requests=requests: requests.pop() if requests else None
        stream.session.adopt = lambda _plan: []
    opened[-1].session.space_plans = intervals_s.append
    stage.run(0.6)
    stage.workers.run()
    stage.run(1.0)
    assert intervals_s[0] == 0.0  # nobody knows yet what they take
    assert 0.004 * 5 / THRESHOLDS.plan_share <= intervals_s[-1] < 0.02 * 5 / THRESHOLDS.plan_share


def test_who_is_not_heard_yet_goes_before_who_is_to_be_heard_better(stage):
    stream, _ = stage.open(window=10_000)
    stream.offer(AddEmitter(id="a", clip="tone", position=(1.0, 2.0, 1.0)))
    stage.run(BLOCK_S)
    assert len(stage.workers.urgent) == 1
    stage.workers.run()
    stage.run(BLOCK_S)
    stream.offer(ListenerPose(pose_id=1, position=(2.0, 1.5, 1.5), yaw=0.0))
    stage.run(BLOCK_S)
    assert (len(stage.workers.work), len(stage.workers.urgent)) == (1, 1)
    stage.workers.run()
    stage.run(BLOCK_S)
    stream.offer(AddEmitter(id="b", clip="tone", position=(1.0, 2.0, 1.0)))
    stage.run(BLOCK_S)
    assert len(stage.workers.urgent) == 2
