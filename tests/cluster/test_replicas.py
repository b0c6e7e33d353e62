"""60 streams over two replicas on two nodes, one of which is drained while they play.

Their scene has no reverberation, so that two cores render all of them, and so that what a client has to hear is known
to the sample: it is rendered here in one go, with nothing to disturb it. A few listen in the apartment.
"""

import asyncio
import itertools
import json
import os
from dataclasses import dataclass, field

import numpy as np
import pytest

pytest.importorskip("ray.serve", reason="needs Ray Serve: make cluster-test installs it")

from ray import serve
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from server.api.catalogue import load_hrtfs, load_scenes, open_clips
from server.api.connection import load_clip
from server.assets.hrtfs import DEFAULT_HRTF
from server.cluster.deployment import deployment
from server.planning.places import place_of
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello
from server.rendering.convolver import Sharing
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session
from tests.ray_nodes import ray_nodes
from tests.visitor import free_port

pytestmark = [pytest.mark.cluster, pytest.mark.filterwarnings("ignore")]

STREAMS = int(os.environ.get("STREAMS", "60"))
SCENES = ("apartment", *["open-field"] * 9)
"""Of the streams, in turn."""
BLOCK = 1024
BUFFER_BLOCKS = 32
ACKNOWLEDGED = 8
"""Blocks for each acknowledgement; it counts for all before it."""
FADE = np.sin(np.linspace(0, np.pi / 2, 64)) ** 2
"""As long as that of the page, `FADE` in jitterbuffer.js, with which a stream begins and ends there."""
_PATIENCE_S = 300.0
ENVIRONMENT = {
    "RAY_SERVE_PROXY_PREFER_LOCAL_NODE_ROUTING": "0",
    "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "300",
    "RAY_SERVE_PROXY_HEALTH_CHECK_TIMEOUT_S": "120",
    "RAY_SERVE_QUEUE_LENGTH_RESPONSE_DEADLINE_S": "5",
    "RAY_SERVE_MAX_QUEUE_LENGTH_RESPONSE_DEADLINE_S": "30",
    "RAY_SERVE_CONTROL_LOOP_INTERVAL_S": "0.5",
}
"""Streams go to all nodes, as run-on-many-machines.md says; the rest is for a busy machine."""


@dataclass
class Heard:
    """Blocks of one stream, and the clock at which its emitter began."""

    blocks: list[AudioBlock] = field(default_factory=list)
    begin: int = -1

    @property
    def signal(self):
        return np.concatenate([block.samples for block in self.blocks], axis=1)

    @property
    def skipped(self) -> int:
        """Blocks that the server did not send since the client had not acknowledged earlier ones."""
        return self.blocks[-1].sample_clock // BLOCK + 1 - len(self.blocks)


@dataclass
class Listening:
    """What one client heard: its streams, and how each ended."""

    scene: str
    streams: list[Heard] = field(default_factory=list)
    ends: list[tuple[int, str]] = field(default_factory=list)

    @property
    def heard(self) -> int:
        return sum(len(stream.blocks) for stream in self.streams)


def messages(scene: str) -> tuple[Hello, AddEmitter]:
    """What a client says first."""
    hello = Hello(protocol=PROTOCOL, scene=scene, block_size=BLOCK, buffer_blocks=BUFFER_BLOCKS)
    return hello, AddEmitter(id="voice", clip="woman-reading", position=(6.0, 3.0, 1.5))


async def listen(url: str, listening: Listening, is_over: asyncio.Event) -> None:
    """Hear one emitter until it is over; after a stream has ended, connect again."""
    while not is_over.is_set():
        async with connect(url, max_size=None, open_timeout=_PATIENCE_S, ping_timeout=None) as client:
            for message in messages(listening.scene):
                await client.send(message.serialize())
            stream, code = Heard(), ""
            listening.streams.append(stream)
            try:
                while not is_over.is_set():
                    message = await client.recv()
                    if isinstance(message, bytes):
                        stream.blocks.append(block := AudioBlock.parse(message, "f32"))
                        if (block.sequence + 1) % ACKNOWLEDGED == 0:
                            await client.send(Acknowledge(sequence=block.sequence).serialize())
                        continue
                    told = json.loads(message)
                    if told["type"] == "emitter_added":
                        stream.begin = told["sample_clock"]
                    elif told["type"] == "error":
                        code = told["code"]
            except ConnectionClosed as closed:
                listening.ends.append((0 if closed.rcvd is None else closed.rcvd.code, code))


def undisturbed(blocks: int):
    """So many blocks of a stream in the open field, from the one with which its emitter begins."""
    scenes = load_scenes(())
    levels = scenes["open-field"]
    filters = load_hrtfs((), scenes).filters(DEFAULT_HRTF, levels.default.sample_rate)
    hello, emitter = messages("open-field")
    clips = open_clips(scenes, ())["open-field"]
    quality = QualityStep("geometry", None, Sharing.NOTHING, 0.0)
    session = Session(
        hello,
        levels,
        filters,
        lambda name: load_clip(clips, name),
        quality=quality,
        window=blocks,
        place=place_of(levels.bundle, (), block_size=BLOCK),
    )
    session.receive(emitter)
    plan = session.take_plan_request()
    assert plan is not None
    session.adopt(plan.plan())
    assert session.take_request() is None, "it has no response"
    return np.concatenate([session.render_block().samples for _ in range(blocks)], axis=1)


async def until(condition) -> None:
    async with asyncio.timeout(_PATIENCE_S):
        while not condition():  # noqa: ASYNC110  blocks are counted by many tasks
            await asyncio.sleep(0.1)


def deployed(replicas: int):
    settings = {
        "NAFIR_REALTIME": "false",
        "NAFIR_MAX_STREAMS": str(2 * STREAMS),
        "NAFIR_STALL_TIMEOUT_S": "60",  # all clients are one process
        "NAFIR_DRAIN_S": "40",
    }
    return deployment.options(
        num_replicas=replicas,
        max_ongoing_requests=1000,
        graceful_shutdown_wait_loop_s=0.2,
        graceful_shutdown_timeout_s=60,
        ray_actor_options={"num_cpus": 1, "runtime_env": {"env_vars": settings}},
        health_check_timeout_s=120,
    ).bind()


@pytest.fixture(scope="module")
def url():
    import ray
    from ray.serve._private import api

    port = free_port()
    with pytest.MonkeyPatch.context() as patch, ray_nodes(1, 1, environment=ENVIRONMENT) as nodes:
        patch.setattr(api, "HTTP_PROXY_TIMEOUT", int(_PATIENCE_S))
        ray.init(address=nodes.address, log_to_driver=False)
        try:
            serve.start(proxy_location="HeadOnly", http_options={"host": "127.0.0.1", "port": port})
            serve.run(deployed(2), name="nafir")
            yield f"ws://127.0.0.1:{port}/v1/stream"
        finally:
            serve.shutdown()
            ray.shutdown()


def test_one_of_two_replicas_is_drained_without_a_click(url) -> None:
    listeners = [Listening(SCENES[number % len(SCENES)]) for number in range(STREAMS)]

    async def play() -> None:
        is_over = asyncio.Event()
        async with asyncio.TaskGroup() as tasks:  # a listener that fails ends the test
            for listening in listeners:
                tasks.create_task(listen(url, listening, is_over))
            await until(lambda: all(each.heard > 40 for each in listeners))
            await asyncio.to_thread(serve.run, deployed(1), name="nafir")
            before = [each.heard for each in listeners]
            await until(lambda: all(each.heard > heard + 40 for each, heard in zip(listeners, before, strict=True)))
            is_over.set()

    asyncio.run(play())
    drained = [each for each in listeners if each.ends]
    assert STREAMS / 4 <= len(drained) <= STREAMS * 3 / 4, "both replicas had their share"
    for listening in listeners:
        assert listening.ends in ([], [(1012, "server_draining")])
        assert len(listening.streams) == 1 + len(listening.ends)
        for stream in listening.streams:  # nothing lost, nothing twice, no part of a block
            assert [block.sequence for block in stream.blocks] == list(range(len(stream.blocks)))
            assert {block.samples.shape for block in stream.blocks} == {(2, BLOCK)}
        signals = [stream.signal for stream in listening.streams]
        assert all(np.abs(signal).max() > 1e-3 for signal in signals)
        for before, after in itertools.pairwise(signals):
            assert largest_step(joined(before, after)) <= 1.01 * max(largest_step(before), largest_step(after))

    streams = [stream for each in listeners if each.scene == "open-field" for stream in each.streams]
    expected = undisturbed(max(stream.blocks[-1].sample_clock // BLOCK + 1 for stream in streams))
    for stream in streams:
        clocks = np.array([block.sample_clock for block in stream.blocks])
        assert (np.diff(clocks) > 0).all()
        assert not stream.signal[:, clocks.repeat(BLOCK) < stream.begin].any()
        for block in stream.blocks:
            if (since := block.sample_clock - stream.begin) >= 0:
                np.testing.assert_allclose(block.samples, expected[:, since : since + BLOCK], atol=1e-6)
    print(f"{len(drained)} of {STREAMS} streams were drained; blocks skipped: {sum(each.skipped for each in streams)}")


def joined(before, after):
    """As the page plays it: the old stream fades out, and the new one fades in."""
    before, after = before.copy(), after.copy()
    before[:, -len(FADE) :] *= FADE[::-1]
    after[:, : len(FADE)] *= FADE
    return np.concatenate([before, np.zeros((2, 128)), after], axis=1)


def largest_step(signal) -> float:
    """The largest difference of a sample and the next one."""
    return float(np.abs(np.diff(signal, axis=1)).max())
