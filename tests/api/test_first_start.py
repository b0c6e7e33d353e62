"""A first start compiles in two processes, of which none is left behind, and tells how far it is."""

import asyncio
import subprocess
import sys

import numpy as np
import pytest

from server.api import first_start
from server.api.first_start import CompilingProcess, tell_while_compiling
from server.responses.impulse_response import ImpulseResponse
from server.scene.bundle import Bundle, find_bundle
from tests.directional_flat import write_directional


@pytest.fixture
def begun(monkeypatch):
    """The processes that were begun, each of which sleeps in place of what it was to do; nothing is on disk."""
    processes, begin = [], subprocess.Popen

    def sleep(arguments, **options):
        processes.append((arguments, begin([sys.executable, "-c", "import time; time.sleep(60)"], **options)))
        return processes[-1][1]

    monkeypatch.setattr(first_start.subprocess, "Popen", sleep)
    monkeypatch.setattr(first_start, "is_kept", lambda _: False)
    return processes


def test_another_process_computes_a_response_of_the_first_field_and_ends_with_the_context(field, begun):
    bundles = [Bundle.load(find_bundle("open-field")), field.bundle]
    with CompilingProcess() as compiler:
        compiler.begin(bundles, cores=2)
        compiler.begin([], cores=2)
        ((arguments, process),) = begun
        assert process.poll() is None
    assert arguments[1:] == ["-m", "server.api.first_start", str(field.bundle.folder)]
    assert process.returncode != 0
    compiler.wait()


def test_the_other_process_computes_a_whole_response_of_the_bundle_and_prepares_one_of_each_level(field, monkeypatch):
    prepared, calibrate = [], first_start.calibrate
    monkeypatch.setattr(first_start, "calibrate", lambda *asked, **more: prepared.append(calibrate(*asked, **more)))
    made, compute = [], ImpulseResponse.compute
    monkeypatch.setattr(ImpulseResponse, "compute", lambda *asked: made.append(compute(*asked)))
    first_start._compile(field.bundle.folder)
    (response,) = made
    assert response.scene == field.bundle.id
    assert np.abs(response.samples).max() > 0
    assert [set(times_ms) for times_ms in prepared] == [{level.name for level in field.bundle.manifest.levels}]


def test_where_directions_are_known_the_other_process_prepares_ambisonics_too(tmp_path, monkeypatch):
    """The page asks for them, and its first sound would wait for seconds."""
    bundle = write_directional(tmp_path / "flat")
    prepared, calibrate = {}, first_start.calibrate

    def counted(*asked, order=None, **more):
        prepared[order] = calibrate(*asked, order=order, **more)

    monkeypatch.setattr(first_start, "calibrate", counted)
    first_start._compile(bundle.folder)
    assert set(prepared) == {None, 1}
    assert set(prepared[1]) == {level.name for level in bundle.manifest.levels}


@pytest.mark.parametrize(("cores", "is_kept"), [(1, False), (2, True)])
def test_on_one_core_or_with_all_compiled_none_is_begun(field, begun, monkeypatch, cores, is_kept):
    monkeypatch.setattr(first_start, "is_kept", lambda _: is_kept)
    with CompilingProcess() as compiler:
        compiler.begin([field.bundle], cores=cores)
        compiler.wait()
    assert not begun


def test_after_the_end_none_is_begun(field, begun):
    with CompilingProcess() as compiler:
        pass
    compiler.begin([field.bundle], cores=2)
    assert not begun


def test_progress_is_told_while_functions_are_compiled(monkeypatch, caplog):
    caplog.set_level("INFO", first_start.__name__)
    counts = iter([3, 3, 7])
    monkeypatch.setattr(first_start, "functions_compiled", lambda: next(counts, 7))
    monkeypatch.setattr(first_start, "_TOLD_EVERY_S", 0.01)

    async def scenario():
        telling = asyncio.create_task(tell_while_compiling())
        await asyncio.sleep(0.2)
        telling.cancel()

    asyncio.run(scenario())
    (line,) = caplog.messages
    assert "7 functions" in line
