"""An audio engine on a stage: ticked by hand, with a clock that only a test moves."""

from concurrent.futures import Future

import numpy as np

from server.field.fields_by_level import FieldsByLevel
from server.protocol.client_messages import PROTOCOL, Hello
from server.streaming import audio_engine
from server.streaming.audio_engine import AudioEngine
from server.streaming.load_policy import Ladder
from server.streaming.quality_steps import Offer
from server.streaming.session import Session
from server.streaming.stream import Stream, TimedBlock

BLOCK_S = 256 / 24_000


class Clock:
    """Time passes only when a test says so."""

    now_s = 50.0

    def __call__(self):
        return self.now_s


class Patient:
    """Workers that do what they were given when told to; `urgent` of it was urgent."""

    threads = 64

    def __init__(self):
        self.work = []
        self.urgent = []

    def submit(self, function, /, *arguments, kind, is_urgent=False):  # noqa: ARG002  in the order of asking
        future = Future()
        self.work.append((future, function, arguments))
        if is_urgent:
            self.urgent.append(arguments)
        return future

    def run(self):
        for future, function, arguments in self.work:
            try:
                future.set_result(function(*arguments))
            except ValueError as exc:
                future.set_exception(exc)
        self.work.clear()


def open_stream(hello, field, filters, load_clip, *, lead, deliver, window=40, **options):
    """At the top of its ladder, which has the scene's only level."""
    levels, offer = FieldsByLevel([field]), Offer((field.level,), {field.level.name: 1.0})
    ladder = Ladder(offer.steps(hello.level, block_s=BLOCK_S))
    session = Session(hello, levels, filters, load_clip, quality=ladder.step, window=window, **options)
    return Stream(session, levels, offer=offer, ladder=ladder, block_s=BLOCK_S, lead=lead, deliver=deliver)


class Stage:
    """An engine that is not running, ticked by hand, and what its streams delivered."""

    def __init__(self, field, filters):
        self.clock, self.workers, self.field, self.filters = Clock(), Patient(), field, filters
        self.engine = AudioEngine(lambda call: call(), self.workers, time_s=self.clock)
        (self.thread,) = self.engine.threads

    def open(self, *, lead=4, window=1_000, **options):
        clip = np.ones(64, np.float32)
        hello = Hello(protocol=PROTOCOL, scene="flat")
        delivered = []
        stream = open_stream(
            hello,
            self.field,
            self.filters,
            lambda _: clip,
            window=window,
            lead=lead,
            deliver=delivered.extend,
            **options,
        )
        self.engine.open(stream)
        return stream, delivered

    def run(self, duration_s, step_s=BLOCK_S / 8):
        end_s = self.clock.now_s + duration_s
        while self.clock.now_s < end_s:
            while (wait_s := self.thread.tick()) is not None and wait_s <= 0:
                pass
            self.clock.now_s += step_s


def blocks(delivered):
    return [item for item in delivered if isinstance(item, TimedBlock)]


def spy_on_batches(monkeypatch):
    """The renderers of each call that an audio thread makes from now on."""
    batches = []

    def render_all(renderers):
        batches.append(list(renderers))
        return rendered(renderers)

    rendered = audio_engine.render_all
    monkeypatch.setattr(audio_engine, "render_all", render_all)
    return batches
