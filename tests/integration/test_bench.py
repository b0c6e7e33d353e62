"""Benchmarks measure what they say, on the arithmetic scene; no time is asserted, only counts that time decides."""

import asyncio
import json

import numpy as np
import pytest
from typer.testing import CliRunner
from websockets.asyncio.server import serve

from server.api.catalogue import describe_scene
from server.bench.cli import app
from server.bench.listen import listen
from server.core.errors import NafirError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.blocks import AudioBlock
from server.protocol.client_messages import AddEmitter, parse_client_message
from server.protocol.server_messages import Welcome


def test_field_bench_reports_the_scene_it_was_given(bundle):
    outcome = CliRunner().invoke(app, ["field", str(bundle.folder), "--rounds", "2", "--poses", "3", "--json"])
    measured = json.loads(outcome.stdout)
    missed = [each for each in measured["summary"] if not (each["reached"] or each["is_skipped"])]
    assert outcome.exit_code == (1 if missed else 0), outcome.output
    assert measured["host"]["instruction_set"]
    assert measured["ir_s"] == pytest.approx(4_000 / 24_000)
    assert [level["name"] for level in measured["levels"]] == list(FieldsByLevel.load(bundle))
    for level in measured["levels"]:
        assert 0 < level["ms_p50"] <= level["ms_p99"]


def test_listen_bench_hears_what_it_does(served):
    measured = asyncio.run(listen(f"ws://{served}/v1/stream", "flat", 2, 2.0, 20.0))
    # Two seconds of 256-sample blocks at 24 kHz, and those the server runs ahead.
    assert 150 < measured["blocks"] < 230
    assert 30 <= measured["poses"] <= 41
    assert 0 < measured["ir_exchanges"] <= measured["blocks"]
    assert 0 < measured["pose_to_block_median_ms"] <= measured["pose_to_reverberation_median_ms"] < 1000
    assert measured["errors"] == []


def test_listen_bench_says_what_the_server_refuses(served):
    with pytest.raises(NafirError, match="unknown_scene"):
        asyncio.run(listen(f"ws://{served}/v1/stream", "atlantis", 1, 1.0, 1.0))


class SkippingServer:
    """Welcomes a client and sends it the blocks of these sample clocks, the last after a while."""

    def __init__(self, field, sample_clocks):
        self.field, self.sample_clocks, self.emitters = field, sample_clocks, []

    async def __call__(self, socket):
        await socket.recv()
        description = describe_scene(FieldsByLevel([self.field]))
        welcome = Welcome(
            session="s",
            scene=description,
            sample_rate=24_000,
            block_size=256,
            channels=2,
            encoding="f32",
            buffer_blocks=8,
            window=40,
            ir_samples=4_000,
            hrtf="kemar",
            level="standard",
        )
        await socket.send(welcome.serialize())
        self.emitters = [parse_client_message(await socket.recv()) for _ in range(2)]
        for sequence, clock in enumerate(self.sample_clocks):
            await asyncio.sleep(0.3 if sequence == len(self.sample_clocks) - 1 else 0)
            silence = np.zeros((2, 256), np.float32)
            block = AudioBlock(sequence, clock, pose_id=0, reverberation_pose_id=0, samples=silence)
            await socket.send(block.serialize("f32"))
        await socket.wait_closed()

    def hear(self):
        async def scenario():
            async with serve(self, "127.0.0.1", 0) as server:
                port = server.sockets[0].getsockname()[1]
                return await listen(f"ws://127.0.0.1:{port}", "flat", 2, 0.2, 20.0)

        return asyncio.run(scenario())


def test_listen_bench_counts_the_blocks_that_the_sample_clock_jumps_over(field):
    measured = SkippingServer(field, [0, 256, 4 * 256, 5 * 256, 7 * 256]).hear()
    assert (measured["blocks"], measured["blocks_skipped"]) == (5, 3)


def test_listen_bench_hears_different_clips_from_different_places(field):
    server = SkippingServer(field, [0, 256])
    server.hear()
    one, other = server.emitters
    assert isinstance(one, AddEmitter)
    assert one.clip != other.clip
    assert one.position != other.position


@pytest.mark.parametrize("url", ["ws://127.0.0.1:1/v1/stream", "http://127.0.0.1/", "ws://{served}/v1/elsewhere"])
def test_listen_bench_says_in_one_line_why_it_cannot_connect(served, url):
    url = url.format(served=served)
    outcome = CliRunner().invoke(app, ["listen", "--url", url, "--duration-s", "1"])
    assert isinstance(outcome.exception, NafirError)
    assert str(outcome.exception).startswith(f"{url}: ")
    assert "\n" not in str(outcome.exception)
