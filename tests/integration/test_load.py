"""A stream on a host that others keep busy: it steps down instead of running late, says so, and recovers."""

import math
import os
import subprocess
import sys
import time
from contextlib import contextmanager

import numpy as np
import pytest
from websockets.sync.client import connect

from server.field.fields_by_level import FieldsByLevel
from server.field.kinds.catalogue import kind_of
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello, ListenerPose, SetLevel
from server.protocol.server_messages import LevelChanged, Status, parse_server_message
from server.scene.manifest import QualityLevel

# Long blocks, so that what a response costs fits into one on a slow host too.
HELLO = Hello(protocol=PROTOCOL, scene="flat", block_size=1024)
EMITTERS = 4
FINE_S, QUICK_S = 0.012, 0.0005
PATIENCE_S = 60.0


class Laborious:
    """A field whose responses take so much of a core's time each, whatever else runs."""

    channels, sample_rate, ir_samples = 2, 24_000, 2_000
    knows_directions = False

    def __init__(self, field, name, cost_s):
        self.bundle, self.level, self._cost_s = field.bundle, QualityLevel(name=name, field="arithmetic"), cost_s
        self.kind = kind_of(self.level)
        self.onset_s = field.onset_s
        self._ir = (0.01 * np.random.default_rng(1).standard_normal((2, self.ir_samples))).astype(np.float32)

    def through(self, filters):  # noqa: ARG002  all heads hear the same
        return self

    def impulse_responses(self, listeners, *_, **__):
        until_s = time.thread_time() + self._cost_s * len(listeners)
        while time.thread_time() < until_s:
            pass
        return np.tile(self._ir, (len(listeners), 1, 1))

    def first_samples(self, listeners, emitters, heads, samples):
        return self.impulse_responses(listeners, emitters, heads)[..., :samples].copy()


@pytest.fixture
def served(serving, field, hrtfs):
    levels = FieldsByLevel([Laborious(field, "fine", FINE_S), Laborious(field, "quick", QUICK_S)])
    with serving(levels, hrtfs, admission=True) as address:
        yield address


@contextmanager
def burning(processes):
    """So many processes that never rest."""
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
        for burner in burners:
            burner.wait()


class Listener:
    """Walks to and fro, a step with every block, and keeps what it is told of levels."""

    def __init__(self, socket):
        self.socket, self.changes, self.status = socket, [], None
        self.blocks = self.late = self.pose_id = 0

    def listen_until(self, is_enough):
        """Raises AssertionError where that takes longer than anybody would wait."""
        end_s = time.monotonic() + PATIENCE_S
        while not is_enough(self):
            assert time.monotonic() < end_s, f"only {self.changes}"
            self._receive(self.socket.recv(timeout=10))

    def _receive(self, message):
        if isinstance(message, bytes):
            block = AudioBlock.parse(message, "f32")
            self.blocks += 1
            self.late += block.is_late
            self.pose_id += 1
            self.socket.send(Acknowledge(sequence=block.sequence).serialize())
            place = (2.0 + 0.5 * math.sin(0.05 * self.pose_id), 2.5, 1.5)
            pose = ListenerPose(pose_id=self.pose_id, position=place, yaw=0.01 * self.pose_id % 3)
            self.socket.send(pose.serialize())
            return
        event = parse_server_message(message)
        if isinstance(event, LevelChanged):
            self.changes.append(event)
        elif isinstance(event, Status):
            self.status = event

    @property
    def newest(self):
        return (self.changes[-1].level, self.changes[-1].reason) if self.changes else None


@contextmanager
def listening(address):
    with connect(f"ws://{address}/v1/stream") as socket:
        socket.send(HELLO.serialize())
        welcome = parse_server_message(socket.recv(timeout=10))
        listener = Listener(socket)
        for number in range(EMITTERS):
            socket.send(AddEmitter(id=str(number), clip="woman-reading", position=(6.0, 3.0, 1.5)).serialize())
        yield listener, welcome


def test_under_load_a_stream_steps_down_says_so_and_recovers(served):
    with listening(served) as (listener, welcome):
        assert welcome.level == "fine"
        with burning(2 * os.cpu_count()):
            listener.listen_until(lambda heard: heard.newest == ("quick", "load"))
            rates = [change.ir_rate_hz for change in listener.changes]
            assert rates[0] is not None, "fewer responses come before a cheaper level"
            listener.blocks = listener.late = 0
            listener.listen_until(lambda heard: heard.blocks == 50)
            assert listener.late == 0
            assert listener.status.level == "quick"
        # To the top it takes half a minute more, and a host that nobody else uses.
        listener.listen_until(lambda heard: heard.changes[-1].reason == "recovered")


def test_a_level_that_was_chosen_is_kept_under_load(served):
    with listening(served) as (listener, _):
        listener.socket.send(SetLevel(level="fine").serialize())
        with burning(2 * os.cpu_count()):
            listener.listen_until(lambda heard: heard.newest == ("fine", "load"))
            assert {change.level for change in listener.changes} == {"fine"}
        listener.socket.send(SetLevel(level="quick").serialize())
        listener.listen_until(lambda heard: heard.newest == ("quick", "chosen"))
