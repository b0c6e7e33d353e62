"""Few requests for impulse responses are unanswered at a time, of the newest poses, and all streams get as many."""

from collections import Counter

import numpy as np
import pytest

from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose, RemoveEmitter
from server.streaming.audio_engine import AudioEngine
from tests.engine_stage import BLOCK_S, Patient, Stage, open_stream

STREAMS = 6
REQUESTS = 2
"""Of one worker: what it computes, and the next."""


class Crowd:
    """Streams with an emitter each, whose listeners move all the time, and one worker."""

    def __init__(self, stage):
        self.stage, self.pose_id = stage, 0
        self.streams = [stage.open(lead=8, window=100_000)[0] for _ in range(STREAMS)]
        for stream in self.streams:
            stream.offer(AddEmitter(id="a", clip="tone", position=(1.0, 2.0, 1.0)))
        self.run()
        self.answer(STREAMS)
        self.run()

    def run(self, blocks=4):
        for _ in range(blocks):
            self.pose_id += 1
            for stream in self.streams:
                position = (2.0 + 0.01 * (self.pose_id % 50), 2.0, 1.5)
                stream.offer(ListenerPose(pose_id=self.pose_id, position=position))
            self.stage.run(BLOCK_S)

    @property
    def asked(self):
        """Requests that wait, first the oldest, with the session of each."""
        return [(session, request) for _, _, (_, request, session) in self.stage.workers.work]

    def answer(self, count=1):
        work = self.stage.workers.work
        for _ in range(count):
            future, function, arguments = work.pop(0)
            future.set_result(function(*arguments))


@pytest.fixture
def crowd(field, filters, monkeypatch):
    monkeypatch.setattr("tests.engine_stage.Patient.threads", 1)
    return Crowd(Stage(field, filters))


def test_no_more_requests_wait_than_keep_the_workers_busy(crowd):
    for _ in range(2 * STREAMS):
        assert len(crowd.asked) == REQUESTS
        crowd.answer()
        crowd.run()


def test_a_request_is_of_the_pose_that_is_newest_when_its_turn_comes(crowd):
    for _ in range(2 * STREAMS):
        crowd.answer()
        crowd.stage.thread.tick()
        assert crowd.asked[-1][1].pose_id == crowd.pose_id
        crowd.run()


def test_streams_get_as_many_as_each_other(crowd):
    served = Counter()
    for _ in range(10 * STREAMS):
        served[crowd.asked[0][0]] += 1
        crowd.answer()
        crowd.run(1)
    assert set(served.values()) == {10}


def test_an_emitter_that_is_not_heard_yet_waits_for_nobody(crowd):
    newcomer = next(stream for stream in crowd.streams if not stream.is_unanswered)
    newcomer.offer(AddEmitter(id="b", clip="tone", position=(1.0, 2.5, 1.0)))
    crowd.stage.thread.tick()
    assert [session for session, request in crowd.asked if request.is_first] == [newcomer.session]
    assert len(crowd.asked) == REQUESTS + 1


def test_who_wanted_responses_of_an_emitter_that_left_wants_them_no_more(crowd):
    """Neither does its ladder think that it waits, nor does it use up a turn."""
    stream = next(stream for stream in crowd.streams if not stream.is_unanswered)
    assert stream.wants_turn
    stream.offer(RemoveEmitter(id="a"))
    crowd.stage.run(2 * BLOCK_S)
    assert not stream.wants_turn
    assert stream.awaits_irs_since_s is None


def test_threads_with_streams_share_the_workers(field, filters, monkeypatch):
    monkeypatch.setattr("tests.engine_stage.Patient.threads", 5)
    engine = AudioEngine(lambda call: call(), Patient(), threads=3)
    hello = Hello(protocol=PROTOCOL, scene="flat")
    streams = [
        open_stream(hello, field, filters, lambda _: np.ones(64, np.float32), lead=8, deliver=lambda _: None)
        for _ in range(3)
    ]
    requests = []
    for stream in streams:
        engine.open(stream)
        requests.append([thread.turns.requests for thread in engine.threads if thread.turns.requests > 1])
    for stream in streams[1:]:
        engine.close(stream)
    assert requests == [[6], [4, 4], [3, 3, 3]]
    assert engine.threads[0].turns.requests == 6


def test_who_leaves_unanswered_takes_no_turn_along(crowd):
    sessions = [session for session, _ in crowd.asked]
    for stream in [stream for stream in crowd.streams if stream.session in sessions]:
        crowd.streams.remove(stream)
        crowd.stage.engine.close(stream)
    crowd.run()
    assert len(crowd.asked) == 2 * REQUESTS
    assert not {session for session, _ in crowd.asked[REQUESTS:]} & set(sessions)


def test_a_stream_waits_from_when_it_wants_responses_whether_or_not_it_could_ask(crowd, monkeypatch):
    """Its ladder has to know, but not while the stream begins: a step down would have all first responses made anew."""
    now_s = crowd.stage.clock.now_s
    crowd.run(20)
    assert all(stream.sample_load(now_s + 20 * BLOCK_S).ir_wait_s is None for stream in crowd.streams)
    monkeypatch.setattr("server.streaming.stream._MEASURED_AFTER_S", 20 * BLOCK_S)
    assert all(stream.sample_load(now_s + 20 * BLOCK_S).ir_wait_s > 19 * BLOCK_S for stream in crowd.streams)


def test_who_has_come_to_rest_and_is_up_to_date_waits_for_nothing(crowd):
    for _ in range(3 * STREAMS):
        if crowd.asked:
            crowd.answer()
        crowd.stage.run(4 * BLOCK_S)
    assert crowd.asked == []
    assert [stream.awaits_irs_since_s for stream in crowd.streams] == [None] * STREAMS


def test_nobody_is_woken_who_could_not_ask(crowd):
    """The thread would tick for every pose of every stream."""
    stream = next(stream for stream in crowd.streams if not stream.is_unanswered)
    woken = []
    stream.attach(wake=lambda: woken.append(True), time_s=crowd.stage.clock, turns=crowd.stage.thread.turns)
    stream.offer(ListenerPose(pose_id=crowd.pose_id + 1, position=(2.0, 2.5, 1.5)))
    assert not woken
    crowd.answer(REQUESTS)
    for _ in range(STREAMS):
        crowd.stage.run(BLOCK_S)
        crowd.answer(len(crowd.asked))
    crowd.stage.run(BLOCK_S)
    woken.clear()
    stream.offer(ListenerPose(pose_id=crowd.pose_id + 2, position=(2.0, 2.6, 1.5)))
    assert woken == [True]
