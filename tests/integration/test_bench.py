"""Benchmarks measure what they say, on the arithmetic scene; no time is asserted, only counts that time decides."""

import asyncio
import json

import pytest
from typer.testing import CliRunner

from server import bench
from server.bench import app
from server.errors import NafirError


def test_field_bench_reports_the_scene_it_was_given(bundle):
    outcome = CliRunner().invoke(app, ["field", str(bundle.folder), "--rounds", "2", "--poses", "3", "--json"])
    assert outcome.exit_code == 0, outcome.output
    measured = json.loads(outcome.output)
    assert measured["ir_s"] == pytest.approx(4_000 / 24_000)
    assert 0 < measured["median_ms"] <= measured["p99_ms"]


def test_stream_bench_hears_what_it_does(served):
    measured = asyncio.run(bench._listen(f"ws://{served}/v1/stream", "flat", 2, 2.0, 20.0))
    # Two seconds of 256-sample blocks at 24 kHz, and those the server runs ahead.
    assert 150 < measured["blocks"] < 230
    assert 30 <= measured["poses"] <= 41
    assert 0 < measured["ir_exchanges"] <= measured["blocks"]
    assert 0 < measured["pose_to_block_median_ms"] < 1000
    assert measured["errors"] == []


def test_stream_bench_says_what_the_server_refuses(served):
    with pytest.raises(NafirError, match="unknown_scene"):
        asyncio.run(bench._listen(f"ws://{served}/v1/stream", "atlantis", 1, 1.0, 1.0))
