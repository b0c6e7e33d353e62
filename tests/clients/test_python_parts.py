"""Parts of the Python client without a server: what waits to be sent, live samples, waits, what is heard of a path."""

import json
import random

import numpy as np
import pytest

from nafir_client import Backoff, ProtocolError, RefusedError, UnreachableError
from nafir_client.address import api_url, stream_url
from nafir_client.ambisonics import Ears, harmonics, rotation
from nafir_client.live_input import LiveInput
from nafir_client.outbox import Outbox, Outgoing
from nafir_client.pose import Pose
from nafir_client.recording import PathAsHeard, Recording
from nafir_client.session import Session
from nafir_client.stream_statistics import PoseWaits
from nafir_client.wire import Block
from server.acoustics.spherical_harmonics import even_directions, real_harmonics
from server.acoustics.spherical_harmonics import rotation as server_rotation
from server.protocol.blocks import AudioBlock
from tests.clients import one_shots
from tests.clients.test_python_wire import WELCOME


def drained(outbox):
    messages = []
    while (message := outbox.take()) is not None:
        messages.append(message)
    return messages


def test_newer_poses_take_the_place_of_older_ones_and_keep_their_order():
    outbox = Outbox()
    for message, key in [("l1", "l"), ("a", None), ("e2", "e"), ("l3", "l"), ("b", None), ("e4", "e")]:
        outbox.put(Outgoing(message), key)
    assert drained(outbox) == ["a", "l3", "b", "e4"]


@pytest.mark.parametrize("chunk", [1, 100, 256, 1_000])
def test_live_samples_come_whole_in_order_and_a_few_blocks_ahead(chunk):
    samples = np.arange(5_000, dtype=np.float32)
    live, sent, at_server = LiveInput(256, ahead=1_024, longest=10_000), [], 0
    live.open()
    for start in range(0, len(samples), chunk):
        live.write(samples[start : start + chunk])
        blocks = live.due()
        sent += blocks
        at_server += sum(map(len, blocks))
        assert all(len(block) <= 256 for block in blocks)
        assert at_server < 1_024 + 256
        while live.waiting >= 256:
            live.advance(256)
            at_server -= 256
            blocks = live.due()
            sent += blocks
            at_server += sum(map(len, blocks))
    while live.waiting:
        live.advance(256)
        sent += live.due()
    np.testing.assert_array_equal(np.concatenate(sent), samples)


def test_live_samples_that_come_too_fast_lose_the_oldest():
    live = LiveInput(256, ahead=1_024, longest=2_000)
    live.write(np.arange(3_000))
    assert (live.waiting, live.dropped) == (2_000, 1_000)
    live.open()
    assert live.due()[0][0] == 1_000


def test_nothing_is_sent_before_the_emitter_is_heard_or_while_the_connection_is_lost():
    live = LiveInput(256, ahead=1_024, longest=10_000)
    live.write(np.ones(256))
    assert live.due() == []
    live.open()
    assert len(live.due()) == 1
    live.close()
    live.write(np.ones(256))
    assert live.due() == []


def test_what_the_server_says_it_has_is_not_sent_again():
    live = LiveInput(256, ahead=1_024, longest=10_000)
    live.open()
    live.correct(2_000)
    live.write(np.ones(512))
    assert live.due() == []
    live.advance(1_500)
    assert len(live.due()) == 2


def test_waits_of_poses_end_with_the_first_block_that_has_them_or_newer_ones():
    waits = PoseWaits()
    for pose_id in range(1, 5):
        waits.send(pose_id, 0.0)
    waits.receive(0, 0.1)
    assert len(waits.durations) == 0
    waits.receive(3, 0.2)
    waits.receive(4, 0.4)
    assert len(waits.durations) == 4
    assert waits.durations.quantile_ms(0.0) == pytest.approx(200)
    assert waits.durations.quantile_ms(1.0) == pytest.approx(400)


def test_waits_grow_up_to_a_bound_and_never_undercut_the_servers_advice():
    backoff, chance = Backoff(first_s=0.1, longest_s=2.0), random.Random(1)
    waits = [backoff.wait_s(attempt, None, chance) for attempt in range(50)]
    assert 0.05 <= waits[0] <= 0.1
    assert max(waits) <= 2.0
    assert min(waits[10:]) >= 1.0
    assert len(set(waits)) == 50
    assert backoff.wait_s(0, 7.0, chance) >= 7.0


@pytest.mark.parametrize(
    ("given", "stream", "api"),
    [
        ("ws://a:8000", "ws://a:8000/v1/stream", "http://a:8000/v1"),
        ("http://a:8000/", "ws://a:8000/v1/stream", "http://a:8000/v1"),
        ("https://a/sound/", "wss://a/sound/v1/stream", "https://a/sound/v1"),
        ("wss://a/v1/stream", "wss://a/v1/stream", "https://a/v1"),
        ("ws://[::1]:8000", "ws://[::1]:8000/v1/stream", "http://[::1]:8000/v1"),
    ],
)
def test_addresses_of_the_stream_and_of_http_follow_from_the_servers(given, stream, api):
    assert (stream_url(given), api_url(given)) == (stream, api)


@pytest.mark.parametrize("given", ["ftp://a", "127.0.0.1:8000", "ws://", "", "ws://[a"])
def test_what_is_no_address_is_said(given):
    with pytest.raises(UnreachableError, match="it has to begin like"):
        stream_url(given)


def block(clock, value=1.0, *, pose_id=0):
    return Block(0, clock, pose_id, pose_id, np.full((256, 2), value, np.float32), False, False, False, 0.0)


def test_of_a_packet_that_began_before_it_a_recording_has_the_rest_and_a_path_its_pose():
    """Packets of Opus do not begin where an emitter does."""
    recording, path = Recording(start_clock=300), PathAsHeard()
    for number, clock in enumerate((0, 256, 512)):
        path.note_pose(number, Pose.of((1.0, 2.0, number)))
        path.note_block(block(clock, number, pose_id=number))
        recording.add(block(clock, number))
    np.testing.assert_array_equal(recording.samples()[:, 0], [1.0] * 212 + [2.0] * 256)
    assert [(row[0], row[1], row[2]) for row in path.rows(300, "a")] == [(1, 300, 300), (2, 512, 512)]


def test_a_recording_has_silence_for_blocks_that_were_skipped():
    recording = Recording(start_clock=256)
    for clock in (0, 256, 1_024):
        recording.add(block(clock, clock))
    assert recording.frames == 1_024
    np.testing.assert_array_equal(recording.samples()[::256, 0], [256, 0, 0, 1_024])
    np.testing.assert_array_equal(recording.samples(300)[:, 1], [256.0] * 256 + [0.0] * 44)


@pytest.fixture
def session():
    session = Session("flat", {})
    session.greet(WELCOME, 0.0)
    return session


def wire_block(sequence, clock):
    return AudioBlock(sequence, clock, 0, 0, np.zeros((2, 256), np.float32)).serialize("f32")


def test_the_clock_goes_on_over_connections_by_the_time_between_them(session):
    for number in range(100):
        session.receive(wire_block(number, 256 * number), 5.0)
    session.disconnect()
    session.first_message()
    session.greet(WELCOME, 7.0)  # two seconds later, of which 8 blocks still waited to be played
    first = session.receive(wire_block(0, 0), 7.1)
    away = first.sample_clock - 25_600
    assert away % 256 == 0
    assert 0 <= away - (2 * 24_000 - 8 * 256) < 256
    assert session.receive('{"type": "emitter_removed", "id": "a", "sample_clock": 0}', 7.2)["sample_clock"] == (
        first.sample_clock
    )
    assert session.statistics.blocks_skipped == away // 256


def test_a_connection_that_is_back_at_once_continues_where_the_last_one_ended(session):
    session.receive(wire_block(0, 0), 5.0)
    session.first_message()
    session.greet(WELCOME, 5.01)
    assert session.receive(wire_block(0, 0), 5.02).sample_clock == 256


def resumable(**resumed):
    """A welcome with a token, of a stream that goes on if it has more fields."""
    welcome = {**json.loads(WELCOME), "resume_token": "t1", "resume_s": 30}
    return json.dumps(welcome | ({"resumed": resumed} if resumed else {}))


def test_a_stream_is_resumed_with_what_the_server_has_not_got():
    session = Session("flat", {})
    session.first_message()
    session.greet(resumable(), 0.0)
    talker = session.add_emitter({"id": "talker", "clip": "noise", "position": (1.0, 2.0, 1.0)}, None)
    session.set_level("a")
    session.move_listener(Pose.of((1, 1, 1)), 0.0)
    session.move_emitter(talker, (2.0, 2.0, 1.0), None, 0.0)
    session.set_level("b")
    session.ping(0.0)
    drained(session.outbox)
    session.set_level("c")  # which was never sent
    for number in range(3):
        session.receive(wire_block(number, 256 * number), 1.0)
    session.disconnect()
    first = json.loads(session.first_message())
    assert first == {"type": "resume", "protocol": 3, "token": "t1", "sequence": 2, "sample_clock": 512}
    # It has the emitter and level a, and the listener's pose, but not the emitter's.
    session.greet(resumable(sample_clock=768, sequence=3, pose_id=1, handled=2), 9.0)
    sent = [json.loads(message) for message in drained(session.outbox) if isinstance(message, str)]
    assert [(each["type"], each.get("level")) for each in sent] == [
        ("set_level", "b"),
        ("set_level", "c"),
        ("move_emitter", None),
    ]
    assert (sent[-1]["pose_id"], sent[-1]["position"]) == (3, [2.0, 2.0, 1.0])
    block = session.receive(wire_block(3, 768), 9.1)
    assert (block.sample_clock, session.statistics.blocks_skipped) == (768, 0)


def test_an_emitter_that_the_server_has_is_heard_even_if_that_was_said_to_nobody():
    session = Session("flat", {})
    session.first_message()
    session.greet(resumable(), 0.0)
    there = session.add_emitter({"id": "there", "clip": "noise", "position": (1.0, 2.0, 1.0)}, None)
    lost = session.add_emitter({"id": "lost", "clip": "noise", "position": (1.0, 2.0, 1.0)}, None)
    drained(session.outbox)
    session.first_message()
    session.greet(resumable(sample_clock=768, sequence=0, pose_id=0, handled=1), 0.0)
    assert (there.is_heard, there.start_clock, lost.is_heard) == (True, 768, False)


def test_messages_that_are_lost_twice_are_sent_twice():
    session = Session("flat", {})
    session.first_message()
    session.greet(resumable(), 0.0)
    for level in "abc":
        session.set_level(level)
    drained(session.outbox)
    for handled in (1, 2):
        session.first_message()
        session.greet(resumable(sample_clock=0, sequence=0, pose_id=0, handled=handled), 0.0)
        assert [json.loads(each)["level"] for each in drained(session.outbox)] == list("abc"[handled:])


def test_a_stream_of_which_too_much_is_unsaid_begins_anew():
    session = Session("flat", {})
    session.first_message()
    session.greet(resumable(), 0.0)
    session.add_emitter({"id": "a", "position": (1.0, 2.0, 1.0), "live": True}, None)
    for _ in range(1_000):
        session.set_level("auto")
        drained(session.outbox)
    session.first_message()
    with pytest.raises(RefusedError, match="begins anew") as refused:
        session.greet(resumable(sample_clock=0, sequence=0, pose_id=0, handled=0), 0.0)
    assert refused.value.is_passing
    assert json.loads(session.first_message())["type"] == "hello"
    session.greet(resumable(), 0.0)
    assert [json.loads(message)["type"] for message in drained(session.outbox)] == ["add_emitter"]


def snapshot(text, handled):
    return json.dumps({"type": "snapshot", "snapshot": text, "pose_id": 0, "handled": handled, "expires_s": 120.0})


def test_the_newest_snapshot_goes_with_the_resume_and_what_it_covers_is_forgotten():
    session = Session("flat", {})
    assert json.loads(session.first_message())["snapshots"] is True
    session.greet(resumable(), 0.0)
    for level in "abc":
        session.set_level(level)
    drained(session.outbox)
    session.receive(snapshot("older", 1), 0.0)
    session.receive(snapshot("newer", 2), 0.0)
    first = json.loads(session.first_message())
    assert (first["type"], first["token"], first["snapshot"]) == ("resume", "t1", "newer")
    assert not session.outbox.can_resume(1)
    session.greet(resumable(sample_clock=0, sequence=0, pose_id=0, handled=2), 0.0)
    assert [json.loads(each)["level"] for each in drained(session.outbox)] == ["c"]
    # What was handled counts on: the stream may be resumed by the same snapshot again.
    session.set_level("d")
    drained(session.outbox)
    session.first_message()
    session.greet(resumable(sample_clock=0, sequence=0, pose_id=0, handled=2), 0.0)
    assert [json.loads(each)["level"] for each in drained(session.outbox)] == ["c", "d"]
    assert session.statistics.resumptions == 2


def test_a_server_that_keeps_nothing_may_have_given_a_snapshot():
    session = Session("flat", {})
    session.first_message()
    session.greet(WELCOME, 0.0)
    session.receive(snapshot("sealed", 0), 0.0)
    session.receive(wire_block(4, 1_024), 0.0)
    first = json.loads(session.first_message())
    assert first == {"type": "resume", "protocol": 3, "snapshot": "sealed", "sequence": 4, "sample_clock": 1_024}


def test_an_emitter_and_a_listener_that_a_snapshot_lacks_are_there_once_they_are_added_again():
    session = Session("flat", {})
    session.first_message()
    session.greet(resumable(), 0.0)
    session.receive(snapshot("sealed", 0), 0.0)
    fields = {"id": "late", "live": True, "position": (1.0, 2.0, 1.0)}
    late = session.add_emitter(fields, session.live_input(4, 1.0))
    second = session.add_listener("second", Pose.of((1, 1, 1)), None)
    drained(session.outbox)
    session.receive('{"type": "emitter_added", "id": "late", "sample_clock": 256}', 0.0)
    session.receive('{"type": "listener_added", "id": "second", "index": 1, "sample_clock": 256}', 0.0)
    assert (late.is_heard, second.is_there) == (True, True)
    session.disconnect()
    session.first_message()
    session.greet(resumable(sample_clock=768, sequence=3, pose_id=0, handled=0), 1.0)
    assert (late.is_heard, second.is_there) == (False, False)
    late.live.write(np.ones(1_000, np.float32))
    session.pump()
    # Nothing is said of them before they are there.
    assert [json.loads(each)["type"] for each in drained(session.outbox)] == ["add_emitter", "add_listener"]
    session.receive('{"type": "emitter_added", "id": "late", "sample_clock": 1024}', 1.0)
    assert (late.is_heard, late.start_clock, len(session.outbox)) == (True, 1_024, 3)


def test_what_was_heard_to_its_end_since_the_snapshot_is_not_played_again():
    session = Session("flat", {})
    session.first_message()
    session.greet(resumable(), 0.0)
    session.receive(snapshot("sealed", 0), 0.0)
    for name in ("shot", "loop"):
        session.add_emitter({"id": name, "clip": "noise", "position": (1.0, 2.0, 1.0)}, None)
    drained(session.outbox)
    session.receive('{"type": "emitter_ended", "id": "shot", "sample_clock": 9, "removed": true}', 0.0)
    session.first_message()
    session.greet(resumable(sample_clock=0, sequence=0, pose_id=0, handled=0), 0.0)
    assert [json.loads(each)["id"] for each in drained(session.outbox)] == ["loop"]
    # The server counts what it got: one message.
    session.set_level("auto")
    drained(session.outbox)
    session.first_message()
    session.greet(resumable(sample_clock=0, sequence=0, pose_id=0, handled=1), 0.0)
    assert [json.loads(each)["type"] for each in drained(session.outbox)] == ["set_level"]


def test_where_no_stream_is_kept_a_hello_begins_anew():
    session = Session("flat", {})
    session.first_message()
    session.greet(resumable(), 0.0)
    session.add_emitter({"id": "talker", "clip": "noise", "position": (1.0, 2.0, 1.0)}, None)
    drained(session.outbox)
    session.receive(snapshot("of another server", 0), 0.0)
    assert json.loads(session.first_message())["type"] == "resume"
    with pytest.raises(RefusedError) as refused:
        session.greet('{"type": "error", "code": "unknown_resume_token", "message": "no"}', 0.0)
    assert refused.value.is_passing
    assert json.loads(session.first_message())["type"] == "hello"
    session.greet(resumable(), 0.0)
    assert [json.loads(each)["type"] for each in drained(session.outbox)] == ["add_emitter"]


def add_clip(session, name, **more):
    return session.add_emitter({"id": name, "clip": "noise", "position": (1.0, 2.0, 1.0), **more}, None)


def tell_added(session, name, clock):
    session.receive(json.dumps({"type": "emitter_added", "id": name, "sample_clock": clock}), 0.0)


def tell_ended(session, name, removed):
    session.receive(json.dumps({"type": "emitter_ended", "id": name, "sample_clock": 9, "removed": removed}), 0.0)


def test_a_new_stream_plays_no_clip_again_that_plays_once():
    session = Session("flat", {})
    session.greet(WELCOME, 0.0)
    for name, loop in [("once", False), ("waiting", False), ("loop", True)]:
        add_clip(session, name, loop=loop)
    for name in ("once", "loop"):
        tell_added(session, name, 0)
    session.receive(wire_block(0, 0), 0.0)
    once = session.emitters["once"]
    session.first_message()
    session.greet(WELCOME, 1.0)
    assert [json.loads(each)["id"] for each in drained(session.outbox)] == ["waiting", "loop"]
    assert once.has_ended


def lose_and_resume(session, handled, clock):
    session.disconnect()
    assert json.loads(session.first_message())["type"] == "resume"
    session.greet(resumable(sample_clock=clock, sequence=0, pose_id=0, handled=handled), 0.0)


def begin_anew(session):
    session.disconnect()
    session.first_message()
    with pytest.raises(RefusedError):
        session.greet('{"type": "error", "code": "unknown_resume_token", "message": "no"}', 0.0)
    assert json.loads(session.first_message())["type"] == "hello"
    session.greet(resumable(), 0.0)


def test_clips_that_play_once_and_were_heard_are_not_played_again_when_their_server_is_lost():
    session, emitters, known = Session("flat", {}), {}, set()

    def add(name, **more):
        emitters[name] = add_clip(session, name, **more)

    def said():
        ended = {name for name, emitter in emitters.items() if emitter.has_ended}
        news = [f"ended:{name}" for name in ended - known]
        known.update(ended)
        messages = [json.loads(each) for each in drained(session.outbox)]
        return " ".join(sorted(news + [f"{each['type']}:{each['id']}" for each in messages]))

    session.first_message()
    session.greet(resumable(), 0.0)
    add("loop")
    add("again", loop=False)
    first = said()
    tell_added(session, "loop", 0)
    session.receive(snapshot("sealed", 2), 0.0)
    for name in ("over", "stays", "heard", "waiting"):
        add(name, loop=False)
    add("later", loop=False, start_at=1_000_000)
    first += f" {said()}"
    for name in ("again", "over", "stays", "heard"):
        tell_added(session, name, 0)
    tell_added(session, "later", 1_000_000)
    session.set_gain(emitters["heard"], -3.0, 0.0)
    first += f" {said()}"
    tell_ended(session, "over", True)
    tell_ended(session, "stays", False)
    session.receive(wire_block(0, 0), 0.0)
    steps = [" ".join(sorted(f"{first} {said()}".split()))]
    lose_and_resume(session, 2, 5_000)
    steps.append(said())
    tell_added(session, "again", 5_120)
    steps.append(said())
    for name in ("again", "over", "heard"):
        tell_ended(session, name, True)
    steps.append(said())
    lose_and_resume(session, 4, 5_376)
    steps.append(said())
    tell_added(session, "waiting", 6_000)
    session.receive(wire_block(24, 6_144), 0.0)
    begin_anew(session)
    steps.append(said())
    one_shots.check(steps)
    assert set(session.emitters) == {"later", "loop"}


def cut_off_from_a_shot():
    """A session whose server was lost after a clip that plays once was heard, and that clip's emitter. The snapshot is
    from before."""
    session = Session("flat", {})
    session.first_message()
    session.greet(resumable(), 0.0)
    session.receive(snapshot("sealed", 0), 0.0)
    shot = add_clip(session, "shot", loop=False)
    drained(session.outbox)
    tell_added(session, "shot", 0)
    session.receive(wire_block(0, 0), 0.0)
    session.disconnect()
    return session, shot


def test_what_is_said_in_an_outage_of_a_clip_that_is_over_is_not_sent():
    session, shot = cut_off_from_a_shot()
    session.set_gain(shot, -3.0, 0.0)
    session.move_emitter(shot, (2.0, 2.0, 1.0), None, 0.0)
    session.set_level("auto")
    lose_and_resume(session, 0, 5_000)
    assert [json.loads(each)["type"] for each in drained(session.outbox)] == ["set_level"]


def test_a_clip_whose_id_is_given_again_in_an_outage_is_played():
    session, shot = cut_off_from_a_shot()
    session.remove_emitter(shot)
    again = add_clip(session, "shot", loop=False)
    lose_and_resume(session, 0, 5_000)
    assert [json.loads(each)["type"] for each in drained(session.outbox)][-2:] == ["remove_emitter", "add_emitter"]
    assert session.emitters == {"shot": again}


@pytest.mark.parametrize("is_told", [True, False])
def test_a_clip_that_is_yet_to_start_is_asked_for_by_a_new_stream(is_told):
    session = Session("flat", {})
    session.first_message()
    session.greet(resumable(), 0.0)
    later = add_clip(session, "later", loop=False, start_at=48_000)
    drained(session.outbox)
    if is_told:
        tell_added(session, "later", 48_000)
    else:  # it may have been said just before the connection was lost
        lose_and_resume(session, 1, 256)
    session.receive(wire_block(2, 512), 0.0)
    assert later.start_clock == 48_000
    begin_anew(session)
    [added] = [json.loads(each) for each in drained(session.outbox)]
    assert (added["type"], added["id"], later.has_ended) == ("add_emitter", "later", False)
    block = session.receive(wire_block(0, 0), 0.1)
    assert added["start_at"] == 48_000 - block.sample_clock


def test_messages_and_blocks_of_a_newer_server_are_ignored(session):
    assert session.receive(b"\x77something", 0.0) is None
    assert session.receive('{"type": "levitated", "height_m": 2}', 0.0)["type"] == "levitated"


@pytest.mark.parametrize("bad", ["{", "[]", "{}", '{"type": 1}'])
def test_what_is_no_message_is_an_error_of_the_protocol(session, bad):
    with pytest.raises(ProtocolError):
        session.receive(bad, 0.0)


@pytest.mark.parametrize(
    "bad",
    [
        '{"type": "status", "live": [{}]}',
        '{"type": "status", "live": 1}',
        '{"type": "level_changed", "level": "a", "sample_clock": "late"}',
        '{"type": "emitter_added", "id": [], "sample_clock": 0}',
        '{"type": "pong", "id": {}}',
    ],
)
def test_a_message_with_impossible_fields_is_an_error_of_the_protocol(session, bad):
    with pytest.raises(ProtocolError, match="of the server cannot be read"):
        session.receive(bad, 0.0)


def test_a_refused_hello_has_all_that_the_server_says():
    error = {"type": "error", "code": "server_busy", "message": "full", "field": None, "retry_after_s": 3, "level": "a"}
    with pytest.raises(RefusedError) as refused:
        Session("flat", {}).greet(json.dumps(error), 0.0)
    assert (refused.value.code, refused.value.message, refused.value.field) == ("server_busy", "full", None)
    assert (refused.value.retry_after_s, refused.value.level, refused.value.is_passing) == (3, "a", True)
    assert str(refused.value) == "server_busy: full"


@pytest.mark.parametrize("order", [1, 2, 3])
def test_rotations_and_harmonics_are_those_of_the_server(order):
    directions = even_directions(30)
    np.testing.assert_allclose(harmonics(directions, order), real_harmonics(directions, order), atol=1e-12)
    quaternions = np.random.default_rng(1).standard_normal((8, 4))
    for orientation in quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True):
        np.testing.assert_allclose(rotation(orientation, order), server_rotation(orientation, order), atol=1e-12)


def test_ears_hear_the_same_however_the_sound_is_cut_into_blocks():
    rng = np.random.default_rng(2)
    filters = rng.standard_normal((2, 4, 33))
    ears = Ears(filters), Ears(filters)
    sound, still = rng.standard_normal((1_024, 4)).astype(np.float32), (0.0, 0.0, 0.0, 1.0)
    whole = ears[0].process(sound, still)
    cut = [ears[1].process(sound[start : start + 128], still) for start in range(0, 1_024, 128)]
    np.testing.assert_allclose(np.concatenate(cut), whole, atol=1e-5)
    expected = sum(np.convolve(sound[:, channel], filters[0, channel]) for channel in range(4))[:1_024]
    np.testing.assert_allclose(whole[:, 0], expected, atol=1e-4)
