"""60 streams over two replicas on two nodes, one of which is drained while they play.

They are deployed as deploy/ray/serve.yaml says, and the number of replicas is changed as an operator changes it there.
`serve.run` would replace all replicas by new ones: it takes every call for new code.

Their scene is the open field, which has no reverberation, so that two cores render all of them, and so that what a
client has to hear is known to the sample: it is rendered here in one go, with nothing to disturb it. Its sample rate is
that of the apartment, where a few listen, since Ray's proxy cannot pass more blocks.
"""

import asyncio
import contextlib
import itertools
import json
import os
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("ray.serve", reason="needs Ray Serve: make cluster-test installs it")

import yaml
from ray import serve
from ray.serve.schema import ServeDeploySchema
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed

from server.api.catalogue import load_hrtfs, load_scenes, open_clips
from server.api.connection import load_clip
from server.assets.hrtfs import DEFAULT_HRTF
from server.planning.places import place_of
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import PROTOCOL, Acknowledge, AddEmitter, Hello, Ping, Resume
from server.protocol.message import Message
from server.protocol.server_messages import EmitterAdded, Error, Pong, SnapshotTaken, Welcome, parse_server_message
from server.rendering.convolver import Sharing
from server.scene.bundle import BUNDLED
from server.streaming.quality_steps import QualityStep
from server.streaming.session import Session
from tests.ray_nodes import ray_nodes
from tests.visitor import free_port

pytestmark = [pytest.mark.cluster, pytest.mark.filterwarnings("ignore")]

STREAMS = int(os.environ.get("STREAMS", "60"))
FIELD = "slow-field"
SCENES = ("apartment", *[FIELD] * 9)
"""Of the streams, in turn."""
SERVE = Path(__file__).parents[2] / "deploy" / "ray" / "serve.yaml"
BLOCK = 1024
BUFFER_BLOCKS = 32
ACKNOWLEDGED = 8
"""Blocks for each acknowledgement; it counts for all before it."""
FADE = np.sin(np.linspace(0, np.pi / 2, 64)) ** 2
"""As long as that of the page, `FADE` in jitterbuffer.js, with which a stream begins and ends there."""
SETTLED_BLOCKS = 30
"""At the end of a stream that goes on, blocks that are heard as if nothing had been. Before, it fades in: first its
effects are planned."""
_PATIENCE_S = 300.0
ENVIRONMENT = {
    "RAY_worker_niceness": "0",
    "RAY_SERVE_PROXY_READY_CHECK_TIMEOUT_S": "300",
    "RAY_SERVE_PROXY_HEALTH_CHECK_TIMEOUT_S": "120",
    "RAY_SERVE_QUEUE_LENGTH_RESPONSE_DEADLINE_S": "5",
    "RAY_SERVE_MAX_QUEUE_LENGTH_RESPONSE_DEADLINE_S": "30",
    "RAY_SERVE_CONTROL_LOOP_INTERVAL_S": "0.5",
}
"""The first as run-on-many-machines.md says, the others for a busy machine."""


@dataclass
class Heard:
    """Blocks of one connection, and the clock at which the emitter of its stream began."""

    blocks: list[AudioBlock] = field(default_factory=list)
    begin: int = -1
    opened_s: float = 0.0
    ended_s: float = 0.0
    answered: int | None = None
    """Blocks before the answer to a message that was sent after the drain."""

    @property
    def signal(self):
        return np.concatenate([block.samples for block in self.blocks], axis=1)


@dataclass
class Listening:
    """What one client heard: its connections, how each ended, and how often it was refused."""

    scene: str
    streams: list[Heard] = field(default_factory=list)
    ends: list[tuple[int, str]] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)

    @property
    def heard(self) -> int:
        return sum(len(stream.blocks) for stream in self.streams)

    @property
    def goes_on(self) -> bool:
        """Whether blocks came from the replica that is left."""
        last = self.streams[-1]
        return last.answered is not None and len(last.blocks) > last.answered + SETTLED_BLOCKS

    @property
    def skipped(self) -> int:
        """Blocks that the server did not send since the client had not acknowledged earlier ones."""
        return sum(
            (stream.blocks[-1].sample_clock - stream.blocks[0].sample_clock) // BLOCK + 1 - len(stream.blocks)
            for stream in self.streams
        )

    @property
    def gaps_s(self) -> list[float]:
        """Seconds from the end of each connection to the next welcome."""
        return [after.opened_s - before.ended_s for before, after in itertools.pairwise(self.streams)]


def messages(scene: str) -> tuple[Hello, AddEmitter]:
    """What a client says first."""
    hello = Hello(protocol=PROTOCOL, scene=scene, block_size=BLOCK, buffer_blocks=BUFFER_BLOCKS, emitters=1)
    return hello, AddEmitter(id="voice", clip="woman-reading", position=(6.0, 3.0, 1.5))


async def listen(url: str, listening: Listening, is_drained: asyncio.Event, is_over: asyncio.Event) -> None:
    """Hear one emitter until it is over. A stream that ends goes on at once with its snapshot, and one that is refused
    is asked for again when the server says."""
    hello, emitter = messages(listening.scene)
    resumption: Resume | None = None
    while not is_over.is_set():
        asks = resumption or hello
        async with connect(url, max_size=None, open_timeout=_PATIENCE_S, ping_timeout=None) as client:
            await client.send(asks.serialize())
            first = parse_server_message(await client.recv())
            if isinstance(first, Welcome):
                stream = Heard(opened_s=time.monotonic())
                if resumption is None:
                    await client.send(emitter.serialize())
                else:
                    stream.begin = listening.streams[-1].begin
                listening.streams.append(stream)
                resumption = await hear(client, listening, is_drained, is_over)
                continue
        assert isinstance(first, Error)
        assert first.code in ("server_busy", "server_draining")
        assert first.retry_after_s or first.code == "server_draining", "it says when to come back"
        listening.refusals.append(first.message.partition(":")[0])
        await asyncio.sleep(first.retry_after_s or 0.2)


async def say(client: ClientConnection, message: Message) -> None:
    """Send a message, unless the server has said its last: that is still to be read."""
    with contextlib.suppress(ConnectionClosed):
        await client.send(message.serialize())


async def hear(
    client: ClientConnection, listening: Listening, is_drained: asyncio.Event, is_over: asyncio.Event
) -> Resume:
    """Hear one connection to its end, or until it is over. Returns with what its stream can go on."""
    stream, code, snapshot, has_asked = listening.streams[-1], "", None, False
    try:
        while not is_over.is_set():
            message = await client.recv()
            if is_drained.is_set() and not has_asked:
                has_asked = True
                await say(client, Ping(id=1))
            if isinstance(message, bytes):
                stream.blocks.append(block := AudioBlock.parse(message, "f32"))
                if (block.sequence + 1) % ACKNOWLEDGED == 0:
                    await say(client, Acknowledge(sequence=block.sequence))
                continue
            match parse_server_message(message):
                case EmitterAdded(sample_clock=clock):
                    stream.begin = clock
                case SnapshotTaken(snapshot=taken):
                    snapshot = taken
                case Pong():
                    stream.answered = len(stream.blocks)
                case Error(code=code, retry_after_s=wait_s):
                    assert wait_s is None, "another replica takes it at once"
    except ConnectionClosed as closed:
        listening.ends.append((0 if closed.rcvd is None else closed.rcvd.code, code))
    stream.ended_s = time.monotonic()
    last = stream.blocks[-1]
    return Resume(protocol=PROTOCOL, snapshot=snapshot or "", sequence=last.sequence, sample_clock=last.sample_clock)


def undisturbed(bundle: Path, blocks: int):
    """So many blocks of a stream in the field, from the one with which its emitter begins."""
    scenes = load_scenes((bundle,))
    levels = scenes[FIELD]
    filters = load_hrtfs((), scenes).filters(DEFAULT_HRTF, levels.default.sample_rate)
    hello, emitter = messages(FIELD)
    clips = open_clips(scenes, ())[FIELD]
    quality = QualityStep("geometry", None, Sharing.NOTHING, 0.0)
    session = Session(
        hello,
        levels,
        filters,
        lambda name: load_clip(clips, None, name),
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


def configuration(bundle: Path, replicas: int) -> dict:
    """That of serve.yaml with the field's bundle, and so many replicas."""
    configuration = yaml.safe_load(SERVE.read_text())
    (application,) = configuration["applications"]
    application["runtime_env"]["env_vars"] |= {
        "NAFIR_BUNDLES": str(bundle),
        "NAFIR_REALTIME": "false",
        "NAFIR_MAX_STREAMS": str(2 * STREAMS),
        "NAFIR_STALL_TIMEOUT_S": "60",  # all clients are one process
        "NAFIR_DRAIN_S": "40",
        "NAFIR_RESUME_SECRET": "a secret of all replicas",
    }
    (deployment,) = application["deployments"]
    del deployment["autoscaling_config"]
    return configuration | {"applications": [application | {"deployments": [deployment | _for_a_test(replicas)]}]}


def _for_a_test(replicas: int) -> dict:
    return {
        "num_replicas": replicas,
        "ray_actor_options": {"num_cpus": 1},
        "graceful_shutdown_wait_loop_s": 0.2,
        "graceful_shutdown_timeout_s": 60,
        "health_check_timeout_s": 120,
    }


def deploy(bundle: Path, replicas: int) -> None:
    """Do what `serve deploy` does. Returns when so many replicas run, and no others are ending."""
    serve.context._get_global_client().deploy_apps(ServeDeploySchema.model_validate(configuration(bundle, replicas)))
    deadline_s = time.monotonic() + _PATIENCE_S
    while time.monotonic() < deadline_s:
        application = serve.status().applications["nafir"]
        states = [each.replica_states for each in application.deployments.values()]
        if application.status == "RUNNING" and states == [{"RUNNING": replicas}]:
            return
        time.sleep(0.2)
    raise AssertionError(f"{application.status}, {states}: {application.message}")


@pytest.fixture(scope="module")
def bundle(tmp_path_factory) -> Path:
    """The open field at 24 kHz."""
    folder: Path = tmp_path_factory.mktemp("bundle")
    manifest = json.loads((BUNDLED / "open-field" / "scene.json").read_text())
    manifest |= {"id": FIELD, "codec": manifest["codec"] | {"sample_rate": 24_000}}
    (folder / "scene.json").write_text(json.dumps(manifest))
    return folder


@pytest.fixture(scope="module")
def url(bundle):
    import ray
    from ray.serve._private import api

    port = free_port()
    with pytest.MonkeyPatch.context() as patch, ray_nodes(1, 1, environment=ENVIRONMENT) as nodes:
        patch.setattr(api, "HTTP_PROXY_TIMEOUT", int(_PATIENCE_S))
        ray.init(address=nodes.address, log_to_driver=False)
        try:
            serve.start(proxy_location="HeadOnly", http_options={"host": "127.0.0.1", "port": port})
            deploy(bundle, 2)
            yield f"ws://127.0.0.1:{port}/v1/stream"
        finally:
            serve.shutdown()
            ray.shutdown()


def test_one_of_two_replicas_is_drained_without_a_click(url, bundle) -> None:
    listeners = [Listening(SCENES[number % len(SCENES)]) for number in range(STREAMS)]

    async def play() -> None:
        is_drained, is_over = asyncio.Event(), asyncio.Event()
        async with asyncio.TaskGroup() as tasks:  # a listener that fails ends the test
            for listening in listeners:
                tasks.create_task(listen(url, listening, is_drained, is_over))
            await until(lambda: all(each.heard > 40 for each in listeners))
            await asyncio.to_thread(deploy, bundle, 1)
            is_drained.set()
            await until(lambda: all(each.goes_on for each in listeners))
            is_over.set()

    asyncio.run(play())
    drained = [each for each in listeners if each.ends]
    gaps_s = sorted(gap_s for each in drained for gap_s in each.gaps_s)
    print(
        f"{len(drained)} of {STREAMS} streams were drained; gaps of {gaps_s[0]:.2f}, {gaps_s[len(gaps_s) // 2]:.2f}, "
        f"{gaps_s[-1]:.2f} s (least, median, most); blocks heard: {sum(each.heard for each in listeners)}, "
        f"skipped: {sum(each.skipped for each in listeners)}; "
        f"refused: {dict(Counter(why for each in listeners for why in each.refusals))}"
    )
    assert STREAMS / 4 <= len(drained) <= STREAMS * 3 / 4, "both replicas had their share"
    for listening in listeners:
        assert listening.ends in ([], [(1012, "server_draining")])
        assert len(listening.streams) == 1 + len(listening.ends)
        blocks = [block for stream in listening.streams for block in stream.blocks]
        assert [block.sequence for block in blocks] == list(range(len(blocks)))  # nothing lost, nothing twice
        assert (np.diff([block.sample_clock for block in blocks]) > 0).all()
        assert {block.samples.shape for block in blocks} == {(2, BLOCK)}
        signals = [stream.signal for stream in listening.streams]
        assert all(np.abs(signal).max() > 1e-3 for signal in signals)
        for before, after in itertools.pairwise(signals):
            assert largest_step(joined(before, after)) <= 1.01 * max(largest_step(before), largest_step(after))

    streams = [stream for each in listeners if each.scene == FIELD for stream in each.streams]
    expected = undisturbed(bundle, max(stream.blocks[-1].sample_clock // BLOCK + 1 for stream in streams))
    for stream in streams:
        is_new = stream.blocks[0].sample_clock <= stream.begin
        for block in stream.blocks if is_new else stream.blocks[-SETTLED_BLOCKS:]:
            if (since := block.sample_clock - stream.begin) >= 0:
                np.testing.assert_allclose(block.samples, expected[:, since : since + BLOCK], atol=1e-6)
            else:
                assert not block.samples.any()


def joined(before, after):
    """As the page plays it: the old stream fades out, and the new one fades in."""
    before, after = before.copy(), after.copy()
    before[:, -len(FADE) :] *= FADE[::-1]
    after[:, : len(FADE)] *= FADE
    return np.concatenate([before, np.zeros((2, 128)), after], axis=1)


def largest_step(signal) -> float:
    """The largest difference of a sample and the next one."""
    return float(np.abs(np.diff(signal, axis=1)).max())
