"""Every benchmark says what it was measured on: as JSON, and to a person."""

import json

import pytest
from typer.testing import CliRunner

from server.bench import effects, field, listen, startup
from server.bench.cli import app
from server.bench.machine import describe_machine, instruction_set, processor
from server.field.fields_by_level import FieldsByLevel
from server.scene.bundle import Bundle

FOUND = {"host": describe_machine(), "summary": []}
BY_PLAN = {"plan_us": 1.0, "all_us": 2.0, "none_us": 0.5, "ratio": 0.5}
SITUATION = {
    "situation": "alone",
    "on": ["direct"],
    **BY_PLAN,
    "error_jnd": 0.1,
    "error_in": "C50",
    "least_jnd": 2.0,
    "least_of": "direct",
}


async def heard(*_):
    return {"blocks": 1}


@pytest.fixture
def quick(monkeypatch):
    """Stand-ins for what takes long: what is printed around it is looked at."""
    monkeypatch.setattr(startup, "measure_starts", lambda *_, **__: FOUND)
    monkeypatch.setattr(effects, "measure_effects", lambda *_: [SITUATION])
    monkeypatch.setattr(listen, "listen", heard)
    monkeypatch.setattr(Bundle, "load", lambda _: None)
    monkeypatch.setattr(FieldsByLevel, "load", lambda _: None)
    levels = {"scene": "flat", "ir_s": 1.0, "levels": [{"name": "a", "ms_p50": 1.0, "ms_p99": 1.0}], "responses": []}
    monkeypatch.setattr(field, "measure_levels", lambda *_, **__: {**FOUND, **levels})


# The convolver and streams are in test_convolver.py and test_sessions.py.
@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize("bench", ["field", "start", "effects", "listen"])
def test_every_bench_names_processor_and_instruction_set(bench, monkeypatch):
    monkeypatch.setenv("COLUMNS", "250")
    outcome = CliRunner().invoke(app, [bench, "--json"])
    measured = json.loads(outcome.stdout)
    host = measured.get("host") or measured["listener_host"]
    assert (host["processor"], host["instruction_set"]) == (processor(), instruction_set())
    said = CliRunner().invoke(app, [bench]).stdout
    assert processor() in said
    assert instruction_set() in said


def test_a_table_for_a_readme_names_them_too(quick):  # noqa: ARG001
    said = CliRunner().invoke(app, ["effects", "--markdown"]).stdout
    assert f"{processor()}, {instruction_set()}" in said
