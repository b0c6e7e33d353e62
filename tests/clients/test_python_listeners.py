"""Several listeners in one stream of the Python client: what its session says, and streams from a real server."""

import asyncio
import json
import subprocess
import sys
import time

import numpy as np
import pytest
import soundfile

from nafir_client import ClosedError, Pose, RefusedError, wire
from nafir_client.playout import Playout
from nafir_client.recording import PathAsHeard
from nafir_client.session import Session
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import (
    Acknowledge,
    AddListener,
    ListenerPose,
    RemoveListener,
    parse_client_message,
)
from server.protocol.codecs import libopus
from server.protocol.opus import OpusOptions
from server.protocol.packets import BlockEncoder
from tests.clients.test_python_opus import RATE, sent, tones
from tests.clients.test_python_parts import drained, resumable
from tests.clients.test_python_stream import (
    SOON,
    blocks_of,
    connect,
    loudness,
    proxy,
    running,
    served_without_resume,  # noqa: F401  a fixture
)
from tests.clients.test_python_threaded import connect as connect_threaded
from tests.clients.test_python_wire import WELCOME
from tests.clients.vectors import CLIENTS
from tests.serving import serving

NEAR, FAR = (5.5, 3.0, 1.5), (1.0, 1.0, 1.5)
"""Of the place where the scene suggests an emitter."""
SPLIT_SCREEN = CLIENTS / "python" / "split_screen.py"


def pose(x=1.0):
    return Pose.of((x, 1.0, 1.5))


def opened(welcome=WELCOME, **options):
    session = Session("flat", options)
    session.first_message()
    session.greet(welcome, 0.0)
    return session


def added(session, identifier, index, clock=0):
    listener = session.add_listener(identifier, pose(), None)
    session.receive(
        json.dumps({"type": "listener_added", "id": identifier, "index": index, "sample_clock": clock}), 0.0
    )
    return listener


def block_of(index, sequence, clock, pose_id=0):
    samples = np.full((2, 256), index / 10, np.float32)
    return AudioBlock(sequence, clock, pose_id, pose_id, samples, listener=index).serialize("f32")


def test_the_server_reads_what_is_said_of_a_listener():
    session = opened(listeners=2)
    listener = session.add_listener("p2", Pose.of((1, 2, 1), yaw=1.0), "kemar")
    session.move_added_listener(listener, pose(2.0), 0.0)
    asked, moved = map(parse_client_message, drained(session.outbox))
    assert (asked.id, asked.hrtf, asked.position, asked.pose.orientation) == (
        "p2",
        "kemar",
        (1, 2, 1),
        pytest.approx(Pose.of((1, 2, 1), yaw=1.0).orientation),
    )
    assert isinstance(asked, AddListener)
    assert isinstance(moved, ListenerPose)
    assert (moved.listener, moved.index, moved.pose_id, moved.position) == ("p2", None, 1, (2.0, 1.0, 1.5))
    session.receive('{"type": "listener_added", "id": "p2", "index": 7, "sample_clock": 512}', 0.0)
    assert (listener.index, listener.start_clock) == (7, 512)
    session.move_added_listener(listener, pose(3.0), 0.0)
    session.move_listener(pose(4.0), 0.0)
    for sequence in range(4):
        session.receive(block_of(7, sequence, 512 + 256 * sequence, pose_id=2), 0.0)
    session.remove_listener(listener)
    moved, first, acknowledged, removed = map(parse_client_message, drained(session.outbox))
    assert (moved.index, moved.pose_id, moved.position) == (7, 2, (3.0, 1.0, 1.5))
    assert (first.index, first.pose_id, first.position) == (None, 3, (4.0, 1.0, 1.5))
    assert acknowledged == Acknowledge(sequence=3, listener="p2")
    assert removed == RemoveListener(id="p2")


def test_blocks_are_counted_for_the_listener_whose_number_they_have():
    session = opened()
    p2, p3 = added(session, "p2", 1), added(session, "p3", 2, 256)
    session.move_added_listener(p2, pose(), 1.0)
    session.receive(block_of(0, 0, 0), 1.0)
    for sequence, clock in enumerate((0, 256, 1_024)):
        block = session.receive(block_of(1, sequence, clock, pose_id=1), 1.5)
        assert (block.listener, block.samples[0, 0]) == (1, np.float32(0.1))
    assert (p2.next_clock, p3.next_clock, session.next_clock) == (1_280, 256, 256)
    assert (p2.statistics.blocks, p2.statistics.blocks_skipped) == (3, 2)
    assert (p3.statistics.blocks, session.statistics.blocks, session.statistics.blocks_skipped) == (0, 1, 0)
    assert p2.statistics.summary()["pose_to_sound_ms"] == pytest.approx(500)
    assert len(session.statistics.pose_to_sound.durations) == 0


def test_blocks_of_a_listener_who_was_removed_are_left_out():
    session = opened()
    listener = added(session, "p2", 1)
    session.remove_listener(listener)
    drained(session.outbox)
    assert session.receive(block_of(1, 3, 0), 0.0) is None
    assert drained(session.outbox) == []


@pytest.mark.skipif(not libopus.is_available(), reason="libopus is not installed (apt install libopus0)")
def test_each_listeners_packets_are_decoded_by_themselves():
    frames = 12_000
    sounds = {0: tones(2, frames), 1: tones(2, frames)[:, ::-1] / 2}
    alone, together = {}, {0: [], 1: []}
    encoded = {}
    for index, sound in sounds.items():
        encoder = BlockEncoder(OpusOptions(), channels=2, sample_rate=RATE)
        encoded[index] = [
            AudioBlock(
                number, start, 0, 0, sound[:, start : start + 256], listener=index * is_with_others
            ).serialize_packets(packets)
            for number, start in enumerate(range(0, frames - 255, 256))
            for packets in [encoder.encode(start, sound[:, start : start + 256])]
            for is_with_others in (False, True)
        ]
        by_itself = opened(sent(tones(2, 256))[0], encoding="opus")
        alone[index] = [by_itself.receive(data, 0.0).samples for data in encoded[index][::2]]
    session = opened(sent(tones(2, 256))[0], encoding="opus")
    added(session, "p2", 1)
    for pair in zip(encoded[0][1::2], encoded[1][1::2], strict=True):
        for data in pair:
            block = session.receive(data, 0.0)
            together[block.listener].append(block.samples)
    for index in sounds:
        np.testing.assert_array_equal(np.concatenate(together[index]), np.concatenate(alone[index]))
        assert np.abs(np.concatenate(together[index])).max() > 0.1


def test_a_new_stream_is_asked_for_every_listener_where_it_is():
    session = opened()
    listener, gone = added(session, "p2", 1), added(session, "gone", 2)
    session.remove_listener(gone)
    session.move_added_listener(listener, pose(3.0), 0.0)
    hello = parse_client_message(session.first_message())
    assert hello.listeners == 2
    assert not listener.is_there
    session.greet(WELCOME, 1.0)
    [again] = map(parse_client_message, drained(session.outbox))
    assert (again.id, again.position) == ("p2", (3.0, 1.0, 1.5))


def test_a_resumed_stream_goes_on_with_its_listeners_and_what_was_said_of_them():
    session = opened(resumable())
    p2, unheard = added(session, "p2", 1), session.add_listener("unheard", pose(), None)
    session.move_added_listener(p2, pose(2.0), 0.0)
    session.move_added_listener(unheard, pose(3.0), 0.0)
    drained(session.outbox)
    waiting = session.add_listener("waiting", pose(), None)
    session.receive(block_of(0, 8, 2_048), 0.0)
    session.receive(block_of(1, 4, 2_304), 0.0)
    session.disconnect()
    asked = json.loads(session.first_message())
    assert (asked["type"], asked["sequence"], asked["sample_clock"]) == ("resume", 8, 2_304)
    there = [{"id": "p2", "index": 1}, {"id": "unheard", "index": 2}]
    session.greet(resumable(sample_clock=4_096, sequence=9, pose_id=1, handled=2, listeners=there), 0.0)
    assert (p2.index, unheard.index, unheard.start_clock, waiting.index) == (1, 2, 4_096, None)
    sent_again = [parse_client_message(message) for message in drained(session.outbox)]
    assert [(each.type, getattr(each, "id", None)) for each in sent_again] == [
        ("add_listener", "waiting"),
        ("listener", None),
    ]
    assert (sent_again[1].index, sent_again[1].position) == (2, (3.0, 1.0, 1.5))  # p2's had arrived


def test_a_listener_whom_a_resumed_stream_lacks_is_asked_for_unless_an_error_tells_why():
    session = opened(resumable())
    there, asked = added(session, "there", 1), session.add_listener("asked", pose(), None)
    drained(session.outbox)
    session.first_message()
    session.greet(resumable(sample_clock=0, sequence=0, pose_id=0, handled=2), 0.0)
    [again] = map(parse_client_message, drained(session.outbox))
    assert again.id == "asked"
    error = {"type": "error", "code": "unknown_hrtf", "message": "no", "field": "hrtf", "listener": "there"}
    session.receive(json.dumps(error), 0.0)
    assert session.take_refused_listener(session.last_error) is there
    assert session.take_refused_listener(RefusedError("x", "y", listener="asked")) is asked


def test_an_error_about_the_pose_of_a_listener_who_is_there_refuses_nobody():
    session = opened()
    added(session, "p2", 1)
    assert session.take_refused_listener(RefusedError("position_out_of_bounds", "", listener="p2")) is None
    unheard = session.add_listener("p3", pose(), None)
    assert session.take_refused_listener(RefusedError("unknown_clip", "", emitter="a")) is None
    assert session.take_refused_listener(RefusedError("malformed_message", "of effects")) is None
    assert session.take_refused_listener(RefusedError("unknown_listener", "of an earlier one", listener="p3")) is None
    assert session.listeners["p3"] is unheard


def test_one_whom_an_old_server_cannot_add_is_removed_if_it_does():
    session = opened()
    added(session, "p2", 1)
    unheard = session.add_listener("p3", pose(), None)
    drained(session.outbox)
    assert session.take_refused_listener(RefusedError("unknown_message", "of a server without them")) is unheard
    assert list(map(parse_client_message, drained(session.outbox))) == [RemoveListener(id="p3")]
    assert list(session.listeners) == ["p2"]


def test_a_path_as_heard_has_the_levels_of_its_own_listener():
    first, second = PathAsHeard(), PathAsHeard("p2")
    for path in (first, second):
        path.note_pose(1, pose())
        path.note_block(wire.parse_block(block_of(0, 0, 0, pose_id=1), "f32", 0.0))
        for change in ({"level": "a", "reason": "chosen"}, {"level": "b", "reason": "load", "listener": "p2"}):
            path.note_message({"type": "level_changed", "sample_clock": 0, **change})
    assert [row[3] for row in first.rows(0, "") + second.rows(0, "")] == ["a", "b"]
    assert (first.was_under_load, second.was_under_load) == (False, True)


def test_listeners_hear_the_same_clip_each_from_its_own_place(served):
    async def listen():
        async with connect(served, listeners=2) as stream:
            assert stream.welcome.max_listeners == 8
            await stream.move_listener(NEAR)
            second = await stream.add_listener(FAR, yaw=0.5)
            assert (second.id, second.pose) == ("listener-2", Pose.of(FAR, yaw=0.5))
            await stream.add_emitter(clip="trumpet")
            near, far = await asyncio.gather(blocks_of(stream, 120), blocks_of(second, 120))
            moved = await second.move(NEAR)
            async for block in second:
                if block.pose_id >= moved and block.reverberation_pose_id >= moved:
                    break
            came = await asyncio.gather(blocks_of(stream, 40), blocks_of(second, 40))
            await second.remove()
            assert all([block.listener == 1 async for block in second])  # what had arrived
            assert isinstance(second.failure, ClosedError)
            with pytest.raises(ClosedError, match="'listener-2' was removed"):
                await second.move(FAR)
            again = await stream.add_listener(FAR, id="listener-2")
            fresh = await blocks_of(again, 3)
            return near, far, came, second, fresh

    near, far, came, second, fresh = running(listen())
    assert {block.listener for block in near} == {0}
    assert {block.listener for block in far} == {1}
    assert loudness(near[60:]) > 3 * loudness(far[60:]) > 0
    assert loudness(came[0]) == pytest.approx(loudness(came[1]), rel=0.5)
    assert [block.sequence for block in far] == list(range(120))
    assert far[0].sample_clock == second.start_clock
    assert second.statistics.blocks >= 120
    assert second.statistics.summary()["pose_to_sound_ms"] > 0
    assert {block.listener for block in fresh} == {2}


def test_a_listener_that_is_refused_is_named_and_the_stream_goes_on(bundle, hrtfs, monkeypatch):
    monkeypatch.setenv("NAFIR_MAX_LISTENERS", "2")

    async def ask(address):
        refusals = []
        async with connect(address) as stream:
            second = await stream.add_listener(NEAR, id="p2")
            for place, wish in (
                (NEAR, {"id": "p3"}),
                (NEAR, {"id": "p2"}),
            ):
                with pytest.raises(RefusedError) as refused:
                    await stream.add_listener(place, **wish)
                refusals.append((refused.value.code, refused.value.listener))
            await second.remove()
            for place, wish in (
                ((99, 0, 0), {"id": "p4"}),
                (NEAR, {"id": "p5", "hrtf": "nobody"}),
                (NEAR, {"id": "p6", "hrtf": 2}),
            ):
                with pytest.raises(RefusedError) as refused:
                    await stream.add_listener(place, **wish)
                refusals.append((refused.value.code, refused.value.listener))
            for identifier in ("", "x" * 65, 2, "\ud800"):
                with pytest.raises(ValueError, match=r"id: has to be|surrogates not allowed"):
                    await stream.add_listener(NEAR, id=identifier)
                with pytest.raises(ValueError, match=r"id: has to be|surrogates not allowed"):
                    await stream.add_emitter(id=identifier)
            third = await stream.add_listener(NEAR, id="p2")  # the id is free, and the place
            return refusals, *await asyncio.gather(blocks_of(stream, 10), blocks_of(third, 10))

    with serving(FieldsByLevel.load(bundle), hrtfs) as address:
        refusals, first, third = running(ask(address))
        with pytest.raises(RefusedError, match="too_many_listeners") as refused:
            running(blocks_of_hello(address))
    assert refusals == [
        ("too_many_listeners", "p3"),
        ("duplicate_listener", "p2"),
        ("position_out_of_bounds", "p4"),
        ("unknown_hrtf", "p5"),
        ("malformed_message", "p6"),
    ]
    assert (len(first), len(third)) == (10, 10)
    assert refused.value.field == "listeners"


def test_a_refusal_of_something_else_refuses_nobody_who_waits(served):
    async def listen():
        async with connect(served) as stream:
            told = []
            stream._on_message = lambda message: told.append(message.get("code", message["type"]))
            adding = asyncio.create_task(stream.add_listener(FAR))
            emitting = asyncio.create_task(stream.add_emitter(clip="trumpet"))
            await asyncio.sleep(0)
            await stream.set_effects({"early_reflections": "loud"})
            second, _ = await asyncio.gather(adding, emitting)
            while "malformed_message" not in told:
                await blocks_of(second, 1)
            await second.remove()
            while "listener_removed" not in told:
                await blocks_of(stream, 1)
            return told

    told = running(listen())
    assert {"listener_added", "emitter_added"} <= set(told)


@pytest.mark.parametrize("kind", ["listener", "emitter"])
def test_one_who_is_added_again_at_once_does_not_wait_for_ever(served, kind):
    """The first is refused, and the second has its id before the first has taken its own traces away."""

    async def listen():
        async with connect(served) as stream, asyncio.timeout(10):
            add = (
                stream.add_listener
                if kind == "listener"
                else lambda at, **more: stream.add_emitter(position=at, **more)
            )
            held = stream._session.listeners if kind == "listener" else stream._session.emitters
            first = asyncio.create_task(add((99, 0, 0), id="p2"))
            await asyncio.sleep(0)
            assert "p2" in held
            while "p2" in held:
                stream._has_message.clear()
                await stream._has_message.wait()
            second = await add(NEAR, id="p2")
            with pytest.raises(RefusedError):
                await first
            return second.id, await blocks_of(stream, 5)

    name, blocks = running(listen())
    assert (name, len(blocks)) == ("p2", 5)


async def blocks_of_hello(address):
    async with connect(address, listeners=3) as stream:
        return await blocks_of(stream, 1)


def test_a_resumed_stream_has_its_listeners_and_one_that_was_asked_for_meanwhile(served):
    async def listen():
        async with proxy(served) as way, connect(way.address, reconnect=SOON) as stream:
            second = await stream.add_listener(FAR, id="p2")
            await stream.add_emitter(clip="woman-reading")
            before = await asyncio.gather(blocks_of(stream, 40), blocks_of(second, 40))
            way.is_open = False
            way.cut()
            moved = await second.move(NEAR)
            adding = asyncio.create_task(stream.add_listener(NEAR, id="p3"))
            asyncio.get_running_loop().call_later(0.3, setattr, way, "is_open", True)
            third = await adding
            after = await blocks_of(stream, 40)
            theirs = []
            async for block in second:
                theirs.append(block)
                if block.reverberation_pose_id >= moved:
                    break
            theirs += await blocks_of(second, 100)  # longer than a reader's pause for breath
            return before, after, theirs, await blocks_of(third, 20), stream.statistics.reconnections

    (first, second), after, theirs, third, reconnections = running(listen())
    assert reconnections == 1
    assert {block.listener for block in theirs} == {1}
    assert {block.listener for block in third} == {2}
    for blocks in (first + after, second + theirs):
        assert (np.diff([block.sample_clock for block in blocks]) > 0).all()
    assert loudness(theirs[-100:]) > 0


def test_a_new_stream_has_its_listeners_again(served_without_resume):  # noqa: F811
    async def listen():
        async with proxy(served_without_resume) as way, connect(way.address, reconnect=SOON) as stream:
            second = await stream.add_listener(FAR, id="p2")
            await stream.add_emitter(clip="woman-reading")
            before = await blocks_of(second, 20)
            way.cut()
            await second.move(NEAR)
            while stream.statistics.reconnections == 0:
                after = await blocks_of(second, 1)
            after = await blocks_of(second, 120)
            return before, after, second

    before, after, second = running(listen())
    assert (np.diff([block.sample_clock for block in before + after]) > 0).all()
    assert second.pose.position == NEAR
    assert loudness(after[-40:]) > 1e-3


def test_a_listener_whom_the_new_stream_refuses_ends_and_the_others_go_on(served_without_resume):  # noqa: F811
    async def listen(address):
        async with proxy(address) as way, connect(way.address, reconnect=SOON) as stream:
            second = await stream.add_listener(NEAR, id="p2")
            third = await stream.add_listener(NEAR, id="p3", hrtf="kemar")
            stream._session.listeners["p3"].hrtf = "gone"  # as if its file was taken away
            way.cut()
            with pytest.raises(RefusedError) as refused:
                await blocks_of(third, 100_000)
            assert third.failure is refused.value
            return refused.value, len(await blocks_of(second, 30)), len(await blocks_of(stream, 30))

    error, second, first = running(listen(served_without_resume))
    assert (error.code, error.listener, second, first) == ("unknown_hrtf", "p3", 30, 30)


def test_threads_read_each_listener_for_itself(served):
    heard = []
    with connect_threaded(served) as stream:
        stream.move_listener(NEAR)
        second = stream.add_listener(FAR, on_block=heard.append)
        stream.add_emitter(clip="woman-reading")
        begun_s, near, far = time.monotonic(), [], []
        for read in range(75):
            time.sleep(max(0.0, begun_s + read * 480 / 24_000 - time.monotonic()))
            near.append(stream.read(480))
            far.append(second.read(480))
        assert second.move(NEAR).result(10) > 0
        assert (second.channels, second.output_rate, second.pose.position) == (2, 24_000, NEAR)
        assert second.statistics.blocks >= len(heard) > 0
        assert second.delay_s > 0
        with pytest.raises(RefusedError, match="position_out_of_bounds"):
            stream.add_listener((99, 0, 0))
        second.remove()
        while second.failure is None:
            time.sleep(0.01)
        with pytest.raises(ClosedError):
            second.move(FAR).result(10)
        assert stream.failure is None
    near, far = (np.sqrt(np.mean(np.concatenate(sound)[-24_000:] ** 2)) for sound in (near, far))
    assert near > 2 * far > 0
    assert {block.listener for block in heard} == {1}


def test_a_head_belongs_to_ambisonics():
    welcome = opened().welcome
    with pytest.raises(ValueError, match="head: belongs to the output ambisonics"):
        Playout(welcome, filters=np.zeros((2, 4, 8)))


def test_the_example_of_a_split_screen_stores_what_both_players_hear(served, tmp_path):
    command = [sys.executable, SPLIT_SCREEN, f"ws://{served}", "flat", "1.5"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    one, two = (soundfile.read(tmp_path / name)[0] for name in ("one.wav", "two.wav"))
    assert len(one) == pytest.approx(len(two), abs=256)
    assert np.sqrt(np.mean(two**2)) > 2 * np.sqrt(np.mean(one**2)) > 1e-4
    lines = [line for line in SPLIT_SCREEN.read_text().split('"""')[2].splitlines() if line.strip()]
    assert len(lines) <= 24
