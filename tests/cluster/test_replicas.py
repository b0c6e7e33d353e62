"""Streams over two replicas on two nodes, one of which is drained while they play. STREAMS says how many; it takes
longer to start 60 than to play them."""

import asyncio
import json
import os
from dataclasses import dataclass, field

import numpy as np
import pytest

pytest.importorskip("ray.serve", reason="needs Ray Serve: make cluster-test installs it")

import itertools

from ray import serve
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from server.cluster.deployment import deployment
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello
from tests.ray_nodes import ray_nodes
from tests.visitor import free_port

pytestmark = [pytest.mark.cluster, pytest.mark.filterwarnings("ignore")]

STREAMS = int(os.environ.get("STREAMS", "8"))
BLOCK = 1024
BUFFER_BLOCKS = 16
FADE = np.sin(np.linspace(0, np.pi / 2, 64)) ** 2
"""As long as that of the page, `FADE` in jitterbuffer.js, with which a stream begins and ends there."""
_PATIENCE_S = 300.0
ENVIRONMENT = {
    "RAY_SERVE_PROXY_PREFER_LOCAL_NODE_ROUTING": "0",
    "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "300",
    "RAY_SERVE_PROXY_HEALTH_CHECK_TIMEOUT_S": "120",
    "RAY_SERVE_CONTROL_LOOP_INTERVAL_S": "0.5",
}
"""Streams go to all nodes, as run-on-many-machines.md says; the rest is for a busy machine."""


@dataclass
class Listening:
    """What one client heard: blocks of each stream that it had, and how each ended."""

    streams: list[list[AudioBlock]] = field(default_factory=list)
    ends: list[tuple[int, str]] = field(default_factory=list)

    @property
    def heard(self) -> int:
        return sum(map(len, self.streams))


async def listen(url: str, listening: Listening, is_over: asyncio.Event) -> None:
    """Hear one emitter until it is over; after a stream has ended, connect again."""
    while not is_over.is_set():
        async with connect(url, max_size=None, open_timeout=_PATIENCE_S, ping_timeout=None) as client:
            await client.send(
                Hello(protocol=PROTOCOL, scene="apartment", block_size=BLOCK, buffer_blocks=BUFFER_BLOCKS).serialize()
            )
            await client.send(AddEmitter(id="voice", clip="woman-reading", position=(6.0, 3.0, 1.5)).serialize())
            listening.streams.append([])
            code = ""
            try:
                while not is_over.is_set():
                    message = await client.recv()
                    if isinstance(message, bytes):
                        block = AudioBlock.parse(message, "f32")
                        listening.streams[-1].append(block)
                        await client.send(Acknowledge(sequence=block.sequence).serialize())
                    elif (told := json.loads(message))["type"] == "error":
                        code = told["code"]
            except ConnectionClosed as closed:
                listening.ends.append((0 if closed.rcvd is None else closed.rcvd.code, code))


async def until(condition) -> None:
    async with asyncio.timeout(_PATIENCE_S):
        while not condition():  # noqa: ASYNC110  blocks are counted by many tasks
            await asyncio.sleep(0.1)


def deployed(replicas: int):
    settings = {"NAFIR_REALTIME": "false", "NAFIR_MAX_STREAMS": str(2 * STREAMS)}
    return deployment.options(
        num_replicas=replicas,
        max_ongoing_requests=1000,
        graceful_shutdown_wait_loop_s=0.2,
        graceful_shutdown_timeout_s=30,
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
    listeners = [Listening() for _ in range(STREAMS)]

    async def play() -> None:
        is_over = asyncio.Event()
        tasks = [asyncio.create_task(listen(url, listening, is_over)) for listening in listeners]
        await until(lambda: all(each.heard > 40 for each in listeners))
        await asyncio.to_thread(serve.run, deployed(1), name="nafir")
        drained = [each for each in listeners if each.ends]
        assert 0 < len(drained) < STREAMS, "both replicas had streams"
        before = [each.heard for each in listeners]
        await until(
            lambda: all(each.heard > heard + 40 for each, heard in zip(listeners, before, strict=True)), "silent"
        )
        is_over.set()
        await asyncio.gather(*tasks)

    asyncio.run(play())
    for listening in listeners:
        assert listening.ends in ([], [(1012, "server_draining")])
        assert len(listening.streams) == 1 + len(listening.ends)
        for blocks in listening.streams:  # nothing lost, nothing twice, no part of a block
            assert [block.sequence for block in blocks] == list(range(len(blocks)))
            assert {block.samples.shape for block in blocks} == {(2, BLOCK)}
        signals = [np.concatenate([block.samples for block in blocks], axis=1) for blocks in listening.streams]
        assert all(np.abs(signal).max() > 1e-3 for signal in signals)
        for before, after in itertools.pairwise(signals):
            assert largest_step(joined(before, after)) <= 1.01 * max(largest_step(before), largest_step(after))


def joined(before, after):
    """As the page plays it: the old stream fades out, and the new one fades in."""
    before, after = before.copy(), after.copy()
    before[:, -len(FADE) :] *= FADE[::-1]
    after[:, : len(FADE)] *= FADE
    return np.concatenate([before, np.zeros((2, 128)), after], axis=1)


def largest_step(signal) -> float:
    """The largest difference of a sample and the next one."""
    return float(np.abs(np.diff(signal, axis=1)).max())
