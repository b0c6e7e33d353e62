"""The audio engine and the load policy together, with a clock that only a test moves."""

from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest

from server.field.fields_by_level import FieldsByLevel
from server.field.kinds.catalogue import kind_of
from server.protocol.client_messages import PROTOCOL, AddEmitter, Hello, ListenerPose, SetLevel
from server.protocol.server_messages import Error, LevelChanged, Status
from server.scene.manifest import QualityLevel
from server.streaming.audio_engine import AudioEngine
from server.streaming.load_policy import Ladder
from server.streaming.quality_steps import Offer
from server.streaming.session import Session
from server.streaming.stream import Stream, TimedBlock

BLOCK = 1024  # long ones, since many seconds are rendered here
BLOCK_S = BLOCK / 24_000
LEAD = 8


class Room:
    channels, sample_rate, ir_samples = 2, 24_000, 1_000

    def __init__(self, field, name):
        self.bundle, self.level = field.bundle, QualityLevel(name=name, field="arithmetic")
        self.kind = kind_of(self.level)

    def through(self, filters):  # noqa: ARG002  all heads hear the same
        return self

    def impulse_responses(self, listeners, *_, **__):
        return np.zeros((len(listeners), 2, self.ir_samples), np.float32)

    def first_samples(self, listeners, emitters, heads, samples):  # noqa: ARG002  all are silent
        return np.zeros((len(listeners), 2, samples), np.float32)


class Workers:
    """Answer each request `delay_s` after it was made."""

    threads = 1

    def __init__(self, clock):
        self.clock, self.delay_s, self.work, self.asked_at_s = clock, 0.0, [], []

    def submit(self, function, /, *arguments, kind, is_urgent=False):  # noqa: ARG002  all of it comes as late
        future = Future()
        self.work.append((self.clock.now_s + self.delay_s, future, function, arguments))
        self.asked_at_s.append(self.clock.now_s)
        return future

    def run(self):
        ready = [job for job in self.work if job[0] <= self.clock.now_s]
        self.work = [job for job in self.work if job[0] > self.clock.now_s]
        for _, future, function, arguments in ready:
            future.set_result(function(*arguments))


class Clock:
    now_s = 50.0

    def __call__(self):
        return self.now_s


class Stage:
    """An engine that is not running, one stream of two levels on it, and a listener who always turns its head."""

    def __init__(self, field, filters, level="auto"):
        self.clock = Clock()
        self.workers = Workers(self.clock)
        self.engine = AudioEngine(lambda call: call(), self.workers, time_s=self.clock)
        (self.thread,) = self.engine.threads
        levels = FieldsByLevel([Room(field, "fine"), Room(field, "quick")])
        offer = Offer((levels["quick"].level, levels["fine"].level), {"quick": 0.5, "fine": 1.0})
        ladder = Ladder(offer.steps(level, block_s=BLOCK_S))
        hello = Hello(protocol=PROTOCOL, scene="flat", block_size=BLOCK)
        clip = np.ones(64, np.float32)
        session = Session(hello, levels, filters, lambda _: clip, quality=ladder.step, window=100_000)
        self.delivered = []
        self.stream = Stream(
            session, levels, offer=offer, ladder=ladder, block_s=BLOCK_S, lead=LEAD, deliver=self.delivered.extend
        )
        self.engine.open(self.stream)
        self.stream.offer(AddEmitter(id="a", clip="any", position=(2.0, 3.0, 1.5)))
        self._pose_id = 0

    def run(self, duration_s):
        end_s = self.clock.now_s + duration_s
        while self.clock.now_s < end_s:
            self._pose_id += 1
            self.stream.offer(ListenerPose(pose_id=self._pose_id, position=(2.0, 2.0, 1.5), yaw=0.1 * self._pose_id))
            self.workers.run()
            while (wait_s := self.thread.tick()) is not None and wait_s <= 0:
                pass
            self.clock.now_s += BLOCK_S / 2

    @property
    def changes(self):
        return [(item.level, item.reason) for item in self.delivered if isinstance(item, LevelChanged)]


@pytest.fixture
def stage(field, filters):
    return Stage(field, filters)


def test_a_stream_at_ease_hears_the_best_level_and_nothing_of_the_others(stage):
    stage.run(6.0)
    assert stage.changes == []
    status = next(item for item in stage.delivered if isinstance(item, Status))
    assert (status.level, status.ir_rate_hz) == ("fine", None)
    assert sum(stage.engine.steps.values()) == 0


def test_slow_responses_lower_the_rate_then_the_level_and_quick_ones_raise_them_again(stage):
    stage.run(1.0)
    stage.workers.delay_s = 0.6
    stage.run(8.0)
    reasons = [reason for _, reason in stage.changes]
    assert set(reasons) == {"load"}
    assert stage.changes[0] == ("fine", "load")
    assert stage.changes[-1] == ("quick", "load")
    # Some steps follow before the one before is heard, and are told as one.
    assert stage.engine.steps["load"] == stage.stream.ladder.at >= len(stage.changes)
    # On the last step but one they may take as long; it is rendering that has to be saved before the last.
    assert stage.stream.ladder.at == len(stage.stream.ladder.steps) - 2
    stage.workers.delay_s = 0.001
    stage.run(30.0)
    assert stage.changes[-1] == ("fine", "recovered")
    assert stage.stream.session.quality.ir_rate_hz is None
    assert stage.engine.steps["recovered"] == stage.engine.steps["load"]


def test_requests_come_at_the_rate_of_the_step(stage):
    stage.run(1.0)
    stage.stream.ladder = replace(stage.stream.ladder, at=2)
    stage.stream.follow_ladder("load", stage.clock.now_s)
    stage.run(0.5)
    stage.workers.asked_at_s.clear()
    stage.run(3.0)
    gaps = np.diff(stage.workers.asked_at_s)
    assert gaps.min() >= 1 / stage.stream.ladder.step.ir_rate_hz - 2 * BLOCK_S


def test_a_level_is_chosen_kept_and_given_back_to_the_server(stage):
    stage.run(0.5)
    stage.stream.offer(SetLevel(level="quick"))
    stage.run(0.5)
    assert stage.changes == [("quick", "chosen")]
    stage.workers.delay_s = 0.9
    stage.run(6.0)
    assert {level for level, _ in stage.changes} == {"quick"}
    stage.workers.delay_s = 0.0
    stage.stream.offer(SetLevel(level="auto"))
    stage.run(0.5)
    assert stage.changes[-1] == ("fine", "chosen")


def test_a_block_counts_as_late_by_when_it_is_sent_but_those_before_the_start_do_not(stage):
    """A stream renders its first blocks one after the other, when they are due already."""
    stage.run(4.0)
    blocks = [item for item in stage.delivered if isinstance(item, TimedBlock)]
    stage.stream.sample_load(stage.clock.now_s)
    assert not any(stage.stream.note_sent(each.deadline_s, each.deadline_s - BLOCK_S / 2) for each in blocks[:LEAD])
    assert stage.stream.sample_load(stage.clock.now_s).lateness == 0.0
    due_s = blocks[LEAD].deadline_s - LEAD * BLOCK_S
    assert not stage.stream.note_sent(blocks[LEAD].deadline_s, due_s + 2 * BLOCK_S)
    assert stage.stream.sample_load(stage.clock.now_s).lateness == pytest.approx(2 / LEAD)
    assert stage.stream.note_sent(blocks[-1].deadline_s, blocks[-1].deadline_s + BLOCK_S)
    assert stage.stream.sample_load(stage.clock.now_s).lateness == pytest.approx(1 + 1 / LEAD)


def test_what_is_sent_late_lowers_quality_as_what_is_rendered_late_does(stage):
    stage.run(1.0)
    for _ in range(20):
        newest = next(item for item in reversed(stage.delivered) if isinstance(item, TimedBlock))
        stage.stream.note_sent(newest.deadline_s, newest.deadline_s - BLOCK_S)
        stage.run(0.25)
    assert {reason for _, reason in stage.changes} == {"load"}


def test_a_level_there_is_not_is_refused_and_changes_nothing(stage):
    stage.run(0.5)
    stage.stream.offer(SetLevel(level="best"))
    stage.run(0.5)
    (error,) = [item for item in stage.delivered if isinstance(item, Error)]
    assert (error.code, error.field) == ("unknown_level", "level")
    assert stage.changes == []


def test_an_audio_thread_without_time_eases_its_streams_and_no_other(field, filters, monkeypatch):
    stage = Stage(field, filters)
    stage.run(0.5)
    finish = Stream.finish_blocks

    def slowly(stream, clock, rendered, **options):
        stage.clock.now_s += 0.95 * BLOCK_S * len(rendered)
        return finish(stream, clock, rendered, **options)

    monkeypatch.setattr(Stream, "finish_blocks", slowly)
    stage.run(4.0)
    assert stage.changes
    assert {reason for _, reason in stage.changes} == {"load"}
