"""Streams of the Python client from a real server over the loopback interface."""

import asyncio
import contextlib
import re
import time

import numpy as np
import pytest
import soundfile

import nafir_client
from nafir_client import Backoff, ConnectionLostError, RefusedError, UnreachableError
from server.api.api_keys import create_key, revoke_key
from server.field.fields_by_level import FieldsByLevel
from server.protocol.codes import ACCESS_ENDED
from tests.serving import serving

SOON = Backoff(first_s=0.02, longest_s=0.1)


def running(coroutine):
    """The result of a coroutine, which has a minute for it."""
    return asyncio.run(asyncio.wait_for(coroutine, 60))


def connect(address, **options):
    return nafir_client.connect(f"ws://{address}", **{"scene": "flat", **options})


async def blocks_of(stream, count):
    blocks = []
    async for block in stream:
        blocks.append(block)
        if len(blocks) == count:
            break
    return blocks


def loudness(blocks):
    return float(np.sqrt(np.mean(np.concatenate([block.samples for block in blocks]) ** 2)))


def test_a_clip_is_heard_from_its_start_and_no_block_is_missing(served):
    async def listen():
        async with connect(served) as stream:
            assert (stream.scene.id, stream.sample_rate, stream.block_size, stream.channels) == ("flat", 24_000, 256, 2)
            clip = await stream.add_emitter(clip="woman-reading")
            return clip.start_clock, await blocks_of(stream, 150), stream.statistics

    start, blocks, counts = running(listen())
    assert [block.sequence for block in blocks] == list(range(150))
    # On a busy machine the server may have left some out.
    assert blocks[-1].sample_clock <= 256 * (149 + counts.blocks_skipped)
    before = [block for block in blocks if block.sample_clock < start]
    assert all(not block.samples.any() for block in before)
    assert loudness(blocks[len(before) :]) > 1e-3


@pytest.mark.parametrize("encoding", [pytest.param("f32", marks=pytest.mark.long), "s16"])
def test_what_is_written_to_a_live_emitter_comes_back(served, encoding):
    async def perform():
        async with connect(served, encoding=encoding) as stream:
            live = await stream.add_emitter(ahead_blocks=8, jitter_ms=30)
            before = await blocks_of(stream, 4)
            noise = np.random.default_rng(1).standard_normal(12_000).astype(np.float32) / 10
            writing = asyncio.create_task(live.write(noise))
            after = await blocks_of(stream, 60)
            await writing
            return before, after, live.samples_dropped

    before, after, dropped = running(perform())
    assert (loudness(before), dropped) == (0, 0)
    assert loudness(after) > 1e-3


def test_a_stream_has_the_rate_that_it_asks_for(served):
    async def listen():
        async with connect(served, sample_rate=48_000, block_size=512) as stream:
            live = await stream.add_emitter()
            await live.write(np.random.default_rng(1).standard_normal(4_800).astype(np.float32) / 10)
            return stream.sample_rate, await blocks_of(stream, 40)

    rate, blocks = running(listen())
    assert rate == 48_000
    assert loudness(blocks) > 1e-3


def test_a_server_that_asks_for_a_key_lets_in_whoever_has_it(bundle, hrtfs, tmp_path, monkeypatch):
    key, entry = create_key(tmp_path / "keys.json", "game", ["listen", "render"], None)
    monkeypatch.setenv("NAFIR_KEYS_FILE", str(tmp_path / "keys.json"))

    async def listen(address, **access):
        async with connect(address, reconnect=SOON, **access) as stream:
            blocks = await blocks_of(stream, 5)
            revoke_key(tmp_path / "keys.json", entry.id)
            with pytest.raises(ConnectionLostError) as lost:
                await blocks_of(stream, 10_000)
            return blocks, lost.value

    with serving(FieldsByLevel.load(bundle), hrtfs) as address:
        with pytest.raises(RefusedError, match="key_required: "):
            running(listen(address))
        with pytest.raises(RefusedError, match="key_refused: "):
            nafir_client.Client(f"http://{address}", api_key="nafir_000000000000_wrong").scenes()
        assert nafir_client.Client(f"http://{address}", api_key=key).scenes()[0].id == "flat"
        blocks, lost = running(listen(address, api_key=key))
    assert len(blocks) == 5
    assert (lost.close_code, lost.is_passing) == (ACCESS_ENDED, False)


def test_what_is_refused_says_which_field_and_the_stream_goes_on(served):
    async def ask():
        refusals = []
        async with connect(served) as stream:
            await stream.add_emitter(clip="trumpet", id="there")
            for wish in (
                {"clip": "kazoo", "id": "a"},
                {"clip": "trumpet", "id": "b", "position": (99, 0, 0)},
                {"clip": "trumpet", "id": "there"},
                {"clip": "trumpet", "id": "c", "directivity": {"pattern": "odd"}},
                {"clip": "trumpet", "id": "d", "gain_db": 1_000},
                {"clip": "trumpet", "id": "e", "jitter_ms": 30},
                {"id": "f", "jitter_ms": 1_000},
            ):
                with pytest.raises(RefusedError) as refused:
                    await stream.add_emitter(**wish)
                refusals.append((refused.value.code, refused.value.field))
            await stream.add_emitter(clip="trumpet", id="a")  # the id is free
            return refusals, await blocks_of(stream, 10)

    refusals, blocks = running(ask())
    assert refusals == [
        ("unknown_clip", "clip"),
        ("position_out_of_bounds", "position"),
        ("duplicate_emitter", "id"),
        ("malformed_directivity", "directivity.pattern"),
        ("malformed_message", "gain_db"),
        ("malformed_message", "jitter_ms"),
        ("malformed_message", "jitter_ms"),
    ]
    assert len(blocks) == 10


def test_many_emitters_asked_for_at_once_are_each_answered_for_themselves(served):
    async def ask():
        async with connect(served) as stream:
            clips = ["trumpet", "kazoo", "woman-reading", "banjo"]
            wishes = [stream.add_emitter(clip=clip) for clip in clips]
            return await asyncio.gather(*wishes, return_exceptions=True)

    trumpet, kazoo, woman, banjo = running(ask())
    assert [each.id for each in (trumpet, woman)] == ["emitter-1", "emitter-3"]
    assert [(each.code, each.emitter) for each in (kazoo, banjo)] == [
        ("unknown_clip", "emitter-2"),
        ("unknown_clip", "emitter-4"),
    ]


def test_of_a_storm_of_poses_the_newest_is_heard_and_none_is_refused(served):
    errors = []

    def note(message):
        if message["type"] == "error":
            errors.append(message)

    async def storm():
        async with connect(served, on_message=note) as stream:
            clip = await stream.add_emitter(clip="trumpet")
            newest = 0
            for step in range(3_000):
                place = 1 + step / 3_000
                newest = await stream.move_listener((place, 2.0, 1.5), yaw=place)
                newest = await clip.move((place + 2, 2.0, 1.5))
                if step % 100 == 0:
                    await asyncio.sleep(0)
            async for block in stream:
                if block.reverberation_pose_id == newest:
                    assert block.pose_id == newest
                    break
            return len(stream.statistics.pose_to_sound.durations)

    assert running(storm()) > 0
    assert errors == []


def test_an_emitter_that_is_removed_is_heard_no_more_and_its_id_is_free(served):
    async def listen():
        async with connect(served) as stream:
            live = await stream.add_emitter(id="voice")
            await live.set_gain(-20.0)
            await live.remove()
            again = await stream.add_emitter(id="voice", clip="trumpet")
            return again.id, loudness(await blocks_of(stream, 40))

    name, loud = running(listen())
    assert name == "voice"
    assert loud > 1e-4


def test_a_clip_starts_and_stops_at_its_clocks_and_its_end_is_told(served):
    async def listen():
        async with connect(served) as stream:
            start = 12_800
            clip = await stream.add_emitter(
                clip="trumpet", start_at=start, stop_at=start + 4_800, loop=False, offset_s=0.1, remove_when_ended=True
            )
            again = await stream.add_emitter(clip="woman-reading", gain_db=-80)
            await again.stop(fade_s=0.02)
            blocks = await blocks_of(stream, 120)
            await asyncio.wait_for(clip.wait_until_ended(), 10)
            await asyncio.wait_for(again.wait_until_ended(), 10)
            return start, clip, blocks

    start, clip, blocks = running(listen())
    assert (clip.start_clock, clip.has_ended) == (start, True)
    sound = np.concatenate([block.samples[:, 0] for block in blocks])
    assert np.abs(sound[:start]).max() < 1e-4  # the other one is at -80 dB
    assert np.abs(sound[start : start + 4_800]).max() > 1e-3


def test_round_trips_and_late_blocks_are_counted(served):
    async def listen():
        async with connect(served) as stream:
            await blocks_of(stream, 50)
            return stream.statistics.summary()

    counts = running(listen())
    assert counts["blocks"] >= 50
    assert counts["round_trip_ms"] > 0
    assert counts["reconnections"] == 0


def test_blocks_that_are_not_taken_are_dropped_and_the_stream_stays_open(served, monkeypatch):
    monkeypatch.setattr("nafir_client.stream._KEPT_S", 0.2)

    async def listen():
        async with connect(served) as stream:
            await asyncio.sleep(0.8)
            block = (await blocks_of(stream, 1))[0]
            return block, stream.sample_clock, stream.statistics

    block, newest, counts = running(listen())
    assert newest - block.sample_clock <= 0.2 * 24_000 + 256
    assert counts.blocks_dropped == block.sequence


def test_a_scene_there_is_not_is_refused_by_the_hello(served):
    async def ask():
        async with connect(served, scene="moon"):
            pass

    with pytest.raises(RefusedError, match="unknown_scene: there is no scene 'moon'"):
        running(ask())


def test_where_there_is_no_server_a_client_that_has_no_patience_says_so_at_once():
    async def ask():
        async with connect("127.0.0.1:1"):
            pass

    with pytest.raises(UnreachableError, match=r"ws://127\.0\.0\.1:1: "):
        running(ask())


def test_a_patient_client_comes_in_once_there_is_a_server(served):
    async def ask():
        async with proxy(served) as way:
            way.is_open = False
            asyncio.get_running_loop().call_later(0.3, setattr, way, "is_open", True)
            async with connect(way.address, patience_s=10) as stream:
                return len(await blocks_of(stream, 3)), way.connections

    blocks, connections = running(ask())
    assert blocks == 3
    assert connections > 1


class Proxy:
    """A way to a server that can be cut and closed."""

    def __init__(self, target):
        self.target = target.split(":")
        self.address = ""
        self.is_open = True
        self.connections = 0
        self._writers = []
        self._silenced = set()

    async def serve(self, reader, writer):
        self.connections += 1
        if not self.is_open:
            writer.close()
            return
        onward, back = await asyncio.open_connection(*self.target)
        self._writers += [writer, back]
        with contextlib.suppress(OSError):
            await asyncio.gather(self._relay(reader, back), self._relay(onward, writer))

    async def _relay(self, reader, writer):
        while data := await reader.read(65_536):
            if writer not in self._silenced:
                writer.write(data)
        writer.close()

    def silence(self):
        """Let nothing through any more on the present connections, which stay open."""
        self._silenced |= set(self._writers)

    def cut(self):
        """End every connection as a network does: without a goodbye."""
        for writer in self._writers:
            writer.transport.abort()
        self._writers.clear()


@contextlib.asynccontextmanager
async def proxy(target):
    way = Proxy(target)
    server = await asyncio.start_server(way.serve, "127.0.0.1", 0)
    way.address = "{}:{}".format(*server.sockets[0].getsockname())
    try:
        yield way
    finally:
        server.close()
        way.cut()
        await asyncio.sleep(0.05)


@pytest.fixture(scope="module")
def served_without_resume(bundle, hrtfs):
    """A server that keeps no stream whose connection was lost."""
    with contextlib.ExitStack() as opened:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("NAFIR_RESUME_S", "0")
            address = opened.enter_context(serving(FieldsByLevel.load(bundle), hrtfs))
        yield address


def test_a_file_that_is_uploaded_can_be_played_and_deleted(bundle, hrtfs, tmp_path, monkeypatch):
    monkeypatch.setenv("NAFIR_CLIPS_FOLDER", str(tmp_path / "clips"))
    file = tmp_path / "door.wav"
    soundfile.write(file, np.random.default_rng(1).standard_normal(24_000) / 10, 24_000)

    async def play(address, clip):
        async with connect(address) as stream:
            await stream.add_emitter(clip=clip)
            return loudness(await blocks_of(stream, 60))

    with serving(FieldsByLevel.load(bundle), hrtfs) as address:
        client = nafir_client.Client(f"http://{address}")
        name = client.upload(file, title="A door")
        assert name in client.clips()
        assert running(play(address, name)) > 1e-3
        client.delete_clip(name)
        assert name not in client.clips()
        with pytest.raises(RefusedError, match="unknown_clip"):
            client.delete_clip(name)
        file.write_bytes(b"no sound")
        with pytest.raises(RefusedError, match="undecodable_clip"):
            client.upload(file)


def test_a_lost_connection_is_made_anew_with_the_emitters_the_level_and_the_pose(served_without_resume):
    async def listen():
        async with proxy(served_without_resume) as way, connect(way.address, reconnect=SOON) as stream:
            clip = await stream.add_emitter(clip="woman-reading")
            live = await stream.add_emitter(id="voice")
            await clip.move((3.0, 2.0, 1.5))
            await stream.move_listener((2.5, 2.0, 1.5), yaw=0.5)
            before = await blocks_of(stream, 40)
            way.is_open = False
            way.cut()
            asyncio.get_running_loop().call_later(0.3, setattr, way, "is_open", True)
            after = await blocks_of(stream, 100)
            moved = await clip.move((3.5, 2.0, 1.5))
            await live.write(np.zeros(600, np.float32))
            async for block in stream:
                after.append(block)
                if block.pose_id >= moved:
                    break
            return before, after, stream.statistics

    before, after, counts = running(listen())
    assert counts.reconnections == 1
    clocks = [block.sample_clock for block in before + after]
    gaps = np.diff(clocks)
    assert (gaps % 256 == 0).all()
    assert (gaps > 0).all()
    assert loudness(after[-40:]) > 1e-3


def test_a_stream_is_resumed_on_its_clock_and_nothing_said_meanwhile_is_lost(served):
    async def listen():
        async with proxy(served) as way, connect(way.address, reconnect=SOON) as stream:
            clip = await stream.add_emitter(clip="woman-reading", id="clip")
            before = await blocks_of(stream, 40)
            session, begun_s = stream.welcome.given["session"], time.monotonic()
            way.is_open = False
            way.cut()
            # Said while nobody listens: a pose, a gain, another emitter.
            moved = await clip.move((3.0, 2.0, 1.5))
            await clip.set_gain(6.0)
            adding = asyncio.create_task(stream.add_emitter(clip="trumpet", id="other"))
            asyncio.get_running_loop().call_later(0.3, setattr, way, "is_open", True)
            after = await blocks_of(stream, 1)
            away_s = after[0].arrived_s - begun_s
            other = await adding
            async for block in stream:
                after.append(block)
                if block.reverberation_pose_id >= moved and len(after) > 60:
                    break
            assert stream.welcome.given["session"] == session
            return before, after, away_s, other, stream.statistics

    before, after, away_s, other, counts = running(listen())
    assert (counts.reconnections, other.id) == (1, "other")
    assert [block.sequence for block in after] == list(range(before[-1].sequence + 1, after[-1].sequence + 1))
    gap_s = (after[0].sample_clock - before[-1].sample_clock) / 24_000
    assert 0 < gap_s < away_s + 0.5
    assert loudness(after[-30:]) > 1e-3


def test_a_connection_over_which_nothing_comes_is_noticed_and_made_anew(served, monkeypatch):
    monkeypatch.setattr("nafir_client.stream._SILENCE_S", 1.0)

    async def listen():
        async with proxy(served) as way, connect(way.address, reconnect=SOON) as stream:
            before = await blocks_of(stream, 20)
            way.silence()
            while stream.statistics.reconnections == 0:
                after = await blocks_of(stream, 1)
            return before, after

    before, after = running(listen())
    assert after[0].sequence > before[-1].sequence
    assert after[0].sample_clock > before[-1].sample_clock


def test_a_stream_that_is_not_to_come_back_ends_with_its_connection(served):
    async def listen():
        async with proxy(served) as way, connect(way.address, reconnect=None) as stream:
            await blocks_of(stream, 3)
            assert stream.is_connected
            way.cut()
            with pytest.raises(ConnectionLostError, match=re.escape(f"ws://{way.address}: ")) as lost:
                await blocks_of(stream, 1_000)
            with pytest.raises(ConnectionLostError):
                await stream.move_listener((2.0, 2.0, 1.5))
            assert not stream.is_connected
            return lost.value

    assert running(listen()).is_passing


def test_a_callback_that_fails_ends_the_stream_and_the_error_says_so(served):
    def fail(message):
        raise KeyError(message["type"])

    async def listen():
        async with connect(served, on_message=fail) as stream:
            await blocks_of(stream, 10_000)

    with pytest.raises(nafir_client.NafirClientError, match="the stream's task failed: KeyError") as failed:
        running(listen())
    assert isinstance(failed.value.__cause__, KeyError)


def test_a_stream_that_is_closed_gives_what_has_arrived_and_ends(served):
    async def listen():
        async with connect(served) as stream:
            await blocks_of(stream, 3)
            await asyncio.sleep(0.1)
        rest = [block async for block in stream]
        with pytest.raises(nafir_client.ClosedError):
            await stream.set_level("auto")
        return rest

    assert running(listen())


def test_http_gives_scenes_clips_heads_and_responses(served):
    client = nafir_client.Client(f"http://{served}")
    assert [scene.id for scene in client.scenes()] == ["flat"]
    assert client.scene("flat").emitter.position == (6.0, 3.0, 1.5)
    assert "woman-reading" in client.clips()
    assert client.heads() == ["kemar"]
    assert client.head_filters("kemar", order=1, sample_rate=24_000).shape[:2] == (2, 4)
    response = client.impulse_response("flat", (2, 2.5, 1.5), (6, 3, 1.5), yaw=np.pi / 2)
    turned = client.impulse_response("flat", (2, 2.5, 1.5), (6, 3, 1.5), orientation=(0, 0, 0.5**0.5, 0.5**0.5))
    assert (response.sample_rate, len(response.samples)) == (24_000, 2)
    np.testing.assert_allclose(turned.samples, response.samples, atol=1e-6)
    listener = nafir_client.Pose.of((2, 2.5, 1.5), yaw=np.pi / 2)
    many = client.impulse_responses("flat", [(listener, (6, 3, 1.5)), (listener, (5, 3, 1.5))])
    assert (many.sample_rate, many.samples.shape) == (24_000, (2, *response.samples.shape))
    np.testing.assert_allclose(many.samples[0], response.samples, atol=1e-6)
    assert not np.allclose(many.samples[1], response.samples, atol=1e-3)
    with pytest.raises(RefusedError) as refused:
        client.impulse_response("flat", (99, 0, 0), (6, 3, 1.5))
    assert (refused.value.code, refused.value.field) == ("position_out_of_bounds", "listener")
    with pytest.raises(RefusedError, match="unknown_scene"):
        client.scene("moon")
    with pytest.raises(UnreachableError, match=r"127\.0\.0\.1:1"):
        nafir_client.Client("http://127.0.0.1:1").clips()
