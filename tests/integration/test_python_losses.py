"""The Python client when its server shuts down or dies. It goes on by a snapshot, at another server or at the same one
once that is back, and nothing that was acknowledged is lost: what is heard is compared, sample by sample, with a render
of the clip."""

import asyncio
import os
import subprocess
import sys
from dataclasses import replace

import pytest

import nafir_client
from nafir_client import Backoff
from server.scene.effects import EffectName
from tests.integration import test_resuming
from tests.integration.lossy_proxy import LossyProxy
from tests.integration.snapshots import Snapshots
from tests.integration.test_resuming import (
    BLOCK,
    CLIP,
    PLACE,
    RATE,
    SETTLED,
    after,
    error_db,
    free_port,
    serving_until_drained,
    wait_until_ready,
)

expected = test_resuming.expected

SOON = Backoff(first_s=0.05, longest_s=0.2)
EFFECTS = {name.value: True for name in EffectName}
"""All of them, as the render has them, so that no plan comes between."""
QUIETER_DB = -6.0


def running(coroutine, limit_s=120):
    return asyncio.run(asyncio.wait_for(coroutine, limit_s))


class Notes:
    """What a server says beside blocks: snapshots and errors."""

    def __init__(self):
        self.snapshots, self.errors = [], []
        self._has_more = asyncio.Event()

    def __call__(self, message):
        if message["type"] == "snapshot":
            self.snapshots.append(message)
            self._has_more.set()
        if message["type"] == "error":
            self.errors.append(message["code"])

    async def next_snapshot(self):
        self._has_more.clear()
        await self._has_more.wait()


def connect(address, notes):
    options = {"scene": "flat", "block_size": BLOCK, "effects": EFFECTS, "reconnect": SOON, "on_message": notes}
    return nafir_client.connect(f"ws://{address}", **options)


async def hear(stream, samples):
    """The blocks of so many more samples of the clock."""
    blocks, end = [], stream.sample_clock + samples
    async for block in stream:
        blocks.append(replace(block, samples=block.samples.T))
        if block.sample_clock >= end:
            return blocks
    raise AssertionError


async def hear_anew(stream, samples):
    """Those that come once the stream is there again."""
    while stream.statistics.reconnections == 0:
        await hear(stream, 0)
    return await hear(stream, samples)


async def move_and_move_back(stream, between):
    """Leave the listener where the render has it, by way of another place at which it is during `between`."""
    start = stream.scene.listener
    await stream.move_listener((start.position[0] + 0.5, *start.position[1:]), yaw=start.yaw)
    await between
    await stream.move_listener(start.position, yaw=start.yaw)


async def change_since_the_snapshot(stream, talker):
    """What is acknowledged after it and heard: another emitter in place of the one that there was. Returns it."""
    other = await stream.add_emitter(clip=CLIP, position=PLACE, id="other")
    await other.set_gain(QUIETER_DB)
    await talker.remove()
    await hear(stream, RATE // 4)
    return other


def quieter_error_db(blocks, expected, since):
    louder = [replace(block, samples=block.samples * 10 ** (-QUIETER_DB / 20)) for block in blocks]
    return error_db(louder, expected, since)


def test_a_server_that_shuts_down_hands_the_stream_to_another(bundle, hrtfs, expected):
    async def listen(network, new, shut_down):
        notes = Notes()
        async with connect(network.address, notes) as stream:
            talker = await stream.add_emitter(clip=CLIP, position=PLACE)
            before = await hear(stream, SETTLED)
            session, since = stream.welcome.given["session"], talker.start_clock
            network.redirect(new)
            shut_down()
            blocks = await hear_anew(stream, SETTLED + RATE // 2)
            counts = stream.statistics
            assert (counts.reconnections, counts.resumptions) == (1, 1)
            assert stream.welcome.given["session"] == session
            assert stream.welcome.given["resumed"]["handled"] == notes.snapshots[-1]["handled"] == 1
            return before, blocks, since, notes.errors

    other = serving_until_drained(bundle, hrtfs)
    with (
        serving_until_drained(bundle, hrtfs) as (old, shut_down),
        other as (new, _),
        LossyProxy(old).running() as network,
    ):
        before, blocks, since, errors = running(listen(network, new, shut_down))
    assert errors == ["server_draining"]
    assert blocks[0].sequence > before[-1].sequence
    assert blocks[0].sample_clock > before[-1].sample_clock
    assert error_db(after(blocks, SETTLED), expected, since) < -80


def test_what_was_acknowledged_since_the_last_snapshot_is_said_again(bundle, hrtfs, expected, monkeypatch):
    """To a server that knows nothing but the snapshot, as after the first one died."""
    snapshots = Snapshots(monkeypatch)

    async def listen(network, new):
        notes = Notes()
        async with connect(network.address, notes) as stream:
            talker = await stream.add_emitter(clip=CLIP, position=PLACE)
            # The talker, and the place on the way.
            await move_and_move_back(stream, asyncio.to_thread(snapshots.end_with, 1, pose_id=1))
            other = await change_since_the_snapshot(stream, talker)
            session, first_heard = stream.welcome.given["session"], other.start_clock
            network.redirect(new)
            network.cut()
            blocks = await hear_anew(stream, SETTLED + RATE // 2)
            resumed = stream.welcome.given["resumed"]
            assert (resumed["handled"], resumed["pose_id"]) == (1, 1)
            assert stream.welcome.given["session"] == session
            assert stream.statistics.resumptions == 1
            assert other.start_clock > first_heard  # it was asked for again
            return blocks, other.start_clock, notes.errors

    other_server = serving_until_drained(bundle, hrtfs)
    with (
        serving_until_drained(bundle, hrtfs) as (old, _),
        other_server as (new, _),
        LossyProxy(old).running() as network,
    ):
        blocks, since, errors = running(listen(network, new))
    assert errors == []
    heard = [block for block in blocks if block.sample_clock >= since + SETTLED]
    assert quieter_error_db(heard, expected, since) < -80


def test_a_clip_that_plays_once_and_was_heard_is_not_played_by_another_server(bundle, hrtfs, monkeypatch):
    """The snapshot is older than the clip, as that of a server which dies."""
    Snapshots(monkeypatch).keep_to(1)

    async def listen(network, new):
        notes = Notes()
        async with connect(network.address, notes) as stream:
            await stream.add_emitter(clip=CLIP, position=PLACE, gain_db=-70)
            await notes.next_snapshot()
            shot = {"clip": "trumpet", "loop": False, "position": PLACE}
            heard = await stream.add_emitter(**shot, id="heard")
            stays = await stream.add_emitter(**shot, id="stays", offset_s=5)
            over = await stream.add_emitter(**shot, id="over", offset_s=5, remove_when_ended=True)
            before = await hear(stream, RATE // 2)
            await asyncio.gather(stays.wait_until_ended(), over.wait_until_ended())
            assert not heard.has_ended
            end = asyncio.create_task(heard.wait_until_ended())
            network.redirect(new)
            network.cut()
            blocks = await hear_anew(stream, 2 * RATE)
            await end
            assert stream.welcome.given["resumed"]["handled"] == 1
            later = await stream.add_emitter(**shot, id="stays", offset_s=5)  # nobody has the id
            assert not later.has_ended
            return before, blocks, notes.errors

    other_server = serving_until_drained(bundle, hrtfs)
    with (
        serving_until_drained(bundle, hrtfs) as (old, _),
        other_server as (new, _),
        LossyProxy(old).running() as network,
    ):
        before, blocks, errors = running(listen(network, new))
    assert errors == []
    loudest = max(abs(block.samples).max() for block in before)
    # The first emitter is there again, and next to silent.
    assert 0 < max(abs(block.samples).max() for block in after(blocks, RATE)) < 0.01 * loudest


@pytest.mark.long
def test_a_stream_whose_snapshot_another_secret_signed_begins_anew(served, bundle, hrtfs, monkeypatch):
    Snapshots(monkeypatch)

    async def listen(network):
        notes = Notes()
        async with connect(network.address, notes) as stream:
            await stream.add_emitter(clip=CLIP, position=PLACE)
            session = stream.welcome.given["session"]
            await notes.next_snapshot()
            network.redirect(served)
            network.cut()
            blocks = await hear_anew(stream, SETTLED)
            assert stream.welcome.given["session"] != session
            return blocks, stream.statistics

    with serving_until_drained(bundle, hrtfs) as (old, _), LossyProxy(old).running() as network:
        blocks, counts = running(listen(network))
    assert (counts.reconnections, counts.resumptions) == (1, 0)
    assert abs(blocks[-1].samples).max() > 0


@pytest.mark.long
def test_a_server_that_is_killed_and_comes_back_costs_a_fade(bundle, expected):
    port = free_port()
    secrets = {"NAFIR_RESUME_SECRET": "a secret that survives", "NAFIR_SNAPSHOT_LIFETIME_S": "900"}
    environment = {**os.environ, **secrets, "NAFIR_BUNDLES": str(bundle.folder)}
    command = [sys.executable, "-m", "server", "serve", "--port", str(port)]
    servers = []

    def start():
        servers.append(subprocess.Popen(command, env=environment))

    async def listen():
        notes = Notes()
        async with connect(f"127.0.0.1:{port}", notes) as stream:
            talker = await stream.add_emitter(clip=CLIP, position=PLACE)
            await move_and_move_back(stream, notes.next_snapshot())
            other = await change_since_the_snapshot(stream, talker)
            session = stream.welcome.given["session"]
            servers[0].kill()
            servers[0].wait()
            start()
            blocks = await hear_anew(stream, SETTLED + RATE)
            assert stream.welcome.given["session"] == session
            assert stream.statistics.resumptions == 1
            return blocks, other.start_clock, notes.errors

    try:
        start()
        wait_until_ready(f"127.0.0.1:{port}", 300.0)
        blocks, since, errors = running(listen(), 600)
    finally:
        for each in servers:
            each.kill()
            each.wait()
    assert errors == []
    heard = [block for block in blocks if block.sample_clock >= since + SETTLED]
    assert quieter_error_db(heard, expected, since) < -80
