"""The gauge around an application that does what it is told, by a clock that tells what time it is."""

import asyncio
import json
from types import SimpleNamespace

import numpy as np
import pytest

from server.bench import gauge as gauges
from server.bench.gauge import Gauge, Waiting, Waits, latencies
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import ListenerPose
from server.streaming.load_policy import Ladder
from server.streaming.quality_steps import QualityStep
from server.streaming.stream_times import StreamTimes


def pose(pose_id):
    return {
        "type": "websocket.receive",
        "bytes": ListenerPose(pose_id=pose_id, position=(1.0, 1.0, 1.0)).serialize_binary(),
    }


def block(pose_id, reverberation_pose_id):
    samples = np.zeros((2, 8), np.float32)
    data = AudioBlock(0, 0, pose_id=pose_id, reverberation_pose_id=reverberation_pose_id, samples=samples)
    return {"type": "websocket.send", "bytes": data.serialize("f32")}


class Clock:
    now_s = 100.0

    def __call__(self):
        return self.now_s


class Audio:
    streams = ()


class Host:
    audio = Audio()


def test_a_pose_is_followed_by_the_first_block_that_is_not_older():
    waiting = Waiting()
    for pose_id, arrived_s in ((1, 0.0), (2, 0.010), (3, 0.020)):
        waiting.enter(pose_id, arrived_s)
    waiting.leave(0, 0.025)
    assert waiting.times.count == 0
    waiting.leave(2, 0.030)  # the first waited 30 ms, the second 20
    assert waiting.times.count == 2
    assert waiting.times.quantiles_s(1) == [pytest.approx(0.030, rel=0.03)]
    assert waiting.times.quantiles_s(0.5) == [pytest.approx(0.020, rel=0.03)]
    waiting.leave(3, 0.040)
    waiting.leave(3, 0.050)
    assert waiting.times.count == 3


def test_a_pose_that_newer_ones_overtake_counts_from_its_own_arrival():
    waiting = Waiting()
    for number in range(100):
        waiting.enter(number, number * 0.01)
    waiting.leave(99, 1.0)
    assert waiting.times.count == 100
    assert waiting.times.quantiles_s(1) == [pytest.approx(1.0, rel=0.03)]
    assert waiting.longest_s == pytest.approx(1.0)


def stream_of_poses(answered, seconds=60, every_s=1 / 32):
    """Waits of a listener whose first `answered` poses were each answered after 10 ms, at the end of all."""
    waiting = Waiting()
    for number in range(round(seconds / every_s)):
        waiting.enter(number, number * every_s)
        if number < answered:
            waiting.leave(number, number * every_s + 0.010)
    return waiting


def test_poses_that_were_never_answered_are_not_left_out():
    fine, stuck = stream_of_poses(answered=60 * 32), stream_of_poses(answered=0)
    of_fine = latencies([fine] * 9, 60.0)
    assert of_fine["p99"] == pytest.approx(10, rel=0.03)
    assert of_fine["longest"] == pytest.approx(10)
    of_both = latencies([fine] * 9 + [stuck], 60.0)
    assert of_both["p50"] == pytest.approx(10, rel=0.03)
    assert of_both["p99"] > 50_000
    assert of_both["longest"] == pytest.approx(60_000)
    assert of_both["answered"] == 9 * 60 * 32
    of_stuck = latencies([stuck], 60.0)
    assert of_stuck["p50"] == pytest.approx(30_000, rel=0.05)
    assert of_stuck["answered"] == 0


def test_a_pose_that_has_only_just_arrived_says_nothing_yet():
    waiting = stream_of_poses(answered=60 * 32)
    before = latencies([waiting], 60.0)
    waiting.enter(10_000, 60.0)
    assert latencies([waiting], 60.001) == before


def test_a_wait_that_began_before_a_measurement_goes_on_in_it():
    waiting = Waiting()
    waiting.enter(1, 0.0)
    waiting.begin()
    waiting.leave(1, 7.0)
    assert waiting.times.quantiles_s(1) == [pytest.approx(7.0, rel=0.03)]


@pytest.mark.parametrize(("measured", "is_settled"), [((), False), (("flat",), False), (("flat", "bench"), True)])
def test_a_server_is_settled_once_the_effects_of_all_scenes_were_measured(measured, is_settled):
    host = SimpleNamespace(scenes=dict.fromkeys(("flat", "bench")), effect_costs=dict.fromkeys(measured))
    sent = []

    async def send(message):
        sent.append(message)

    scope = {"type": "http", "path": "/bench/settled", "state": {"host": host}}
    asyncio.run(Gauge(None)(scope, None, send))
    assert json.loads(sent[-1]["body"]) == {"is_settled": is_settled}


def test_poses_are_timed_from_arrival_to_the_socket_and_messages_pass_unchanged():
    clock = Clock()
    seen, sent = [], []
    script = [
        (0.000, pose(1)),
        (0.004, block(1, 0)),
        (0.005, {"type": "websocket.send", "text": "status"}),
        (0.030, block(1, 1)),
    ]

    async def receive():
        return script.pop(0)[1]

    async def send(message):
        clock.now_s += 0.001  # what handing over takes
        sent.append(message)

    async def application(_, receive, send):
        begun_s = clock.now_s
        while script:
            clock.now_s = begun_s + script[0][0]
            if script[0][1]["type"] == "websocket.receive":
                seen.append(await receive())
            else:
                await send(script.pop(0)[1])
        answers.append(await ask(gauge, "/bench/report"))

    async def scenario():
        await ask(gauge, "/bench/begin")
        await gauge({"type": "websocket", "path": "/v1/stream"}, receive, send)

    gauge = Gauge(application, time_s=clock)
    answers, messages = [], list(script)
    asyncio.run(scenario())
    assert [seen[0], *sent] == [message for _, message in messages]
    (report,) = answers
    assert report["pose_to_audio_ms"]["p99"] == pytest.approx(5, rel=0.03)
    assert report["pose_to_reverberation_ms"]["p99"] == pytest.approx(31, rel=0.03)


def test_poses_of_each_listener_wait_for_its_own_blocks():
    waits = Waits()
    for listener, pose_id in ((0, 1), (1, 2), (0, 3)):
        waits.enter(listener, pose_id, 0.0)
    waits.leave(1, (2, 0), 0.010)
    assert [len(waits.direct[number].unanswered_s(1.0)) for number in (0, 1)] == [2, 0]
    assert waits.behind_s(1.0) == 1.0
    waits.leave(0, (3, 3), 0.020)
    waits.leave(1, (3, 3), 0.020)
    assert waits.behind_s(1.0) == 0.0


async def ask(gauge, path):
    sent = []

    async def send(message):
        sent.append(message)

    await gauge({"type": "http", "path": path, "state": {"host": Host()}}, None, send)
    return json.loads(sent[1]["body"])


class Window:
    sent = 1_000


BEST, LESS = QualityStep("standard", None, False, 1.0), QualityStep("standard", 5.0, False, 1.0)


class Session:
    window = Window()
    blocks_dropped = 5
    quality = BEST


class Stream:
    """Counts as the server's do."""

    block_s = 0.01

    def __init__(self):
        self.session = Session()
        self.ladder = Ladder((BEST, LESS))
        self.blocks_late = 7
        self.times = StreamTimes()
        self.audience = Audience(self)


class Audience:
    """One listener, or another one beside it whose numbers are the same."""

    def __init__(self, stream, *, listeners=1):
        self.session = stream.session
        self.members = [SimpleNamespace(times=times) for times in (stream.times, StreamTimes())][:listeners]

    def totals(self):
        counts = {"sent": self.session.window.sent, "dropped": self.session.blocks_dropped}
        return {name: len(self.members) * count for name, count in counts.items()}, []


@pytest.mark.parametrize("listeners", [1, 2])
def test_blocks_are_counted_from_the_beginning_of_the_measurement_and_missing_ones_found(monkeypatch, listeners):
    stream, clock = Stream(), Clock()
    stream.session = Session()
    stream.session.window = Window()
    stream.audience = Audience(stream, listeners=listeners)
    monkeypatch.setattr(Audio, "streams", (stream,))
    gauge = Gauge(None, time_s=clock)

    async def scenario():
        await ask(gauge, "/bench/begin")
        for member in stream.audience.members:
            member.times.render.add(0.002)
        stream.session.window.sent += 90
        stream.session.blocks_dropped += 3
        stream.blocks_late += 2
        clock.now_s += 1.0  # a hundred blocks were due
        return await ask(gauge, "/bench/blocks"), await ask(gauge, "/bench/report")

    blocks, report = asyncio.run(scenario())
    counts = {name: report[f"blocks_{name}"] for name in ("sent", "late", "dropped", "missing")}
    assert counts == {"sent": 90 * listeners, "late": 2, "dropped": 3 * listeners, "missing": 6 * listeners}
    assert blocks == {name: report[name] for name in blocks}
    assert len(blocks) == 6
    assert report["block_ms"]["p50"] == pytest.approx(2, rel=0.03)
    assert report["lateness_ms"]["p50"] is None
    assert report["quality_at_end"] == {"standard": 1}
    assert report["below_best_share"] == 0


def test_the_share_of_time_at_less_than_the_best_quality_is_told(monkeypatch):
    streams = Stream(), Stream()
    monkeypatch.setattr(Audio, "streams", streams)
    monkeypatch.setattr(gauges, "_LOOK_EVERY_S", 0.001)
    gauge = Gauge(None)

    async def scenario():
        await ask(gauge, "/bench/begin")
        await asyncio.sleep(0.02)
        assert (await ask(gauge, "/bench/report"))["below_best_share"] == 0
        streams[0].session.quality = LESS
        await ask(gauge, "/bench/begin")
        await asyncio.sleep(0.02)
        return await ask(gauge, "/bench/report")

    report = asyncio.run(scenario())
    assert report["below_best_share"] == 0.5
    assert report["quality_at_end"] == {"standard": 1, "standard, 5 responses a second": 1}
