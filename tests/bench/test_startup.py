"""`nafir bench start`, measured on a small program that behaves like nafir."""

import sys

import pytest
from typer.testing import CliRunner

from server.bench import startup
from server.bench.cli import app
from server.core.errors import NafirError

PROGRAM = """
import http.server, sys, time
if "--help" in sys.argv:
    sys.exit(0)
if "ir" in sys.argv:
    spent_until = time.process_time() + 0.3
    while time.process_time() < spent_until:
        pass
    sys.exit(IR_EXIT)
began_s = time.monotonic()
class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200 if time.monotonic() - began_s > 0.5 else 503)
        self.end_headers()
server = http.server.HTTPServer(("127.0.0.1", 0), Handler)
print(f"Nafir serves nothing at http://127.0.0.1:{server.server_port}", flush=True)
if SERVES:
    server.serve_forever()
"""


@pytest.fixture
def pretend(monkeypatch):
    def program(*, ir_exit=0, serves=True):
        text = PROGRAM.replace("IR_EXIT", str(ir_exit)).replace("SERVES", str(serves))
        monkeypatch.setattr(startup, "_NAFIR", (sys.executable, "-c", text))

    return program


def test_processor_time_and_the_time_until_ready_are_told_apart(pretend):
    pretend()
    measured = {row["measure"]: row["value"] for row in startup.measure_starts(1)["summary"]}
    assert measured["cpu_s of nafir --help"] < measured["cpu_s of nafir ir"]
    assert measured["cpu_s of nafir ir"] >= 0.3
    assert measured["s until nafir serve is ready"] >= 0.5
    assert len(measured) == 3


def test_a_first_start_has_an_empty_cache(pretend, monkeypatch):
    pretend()
    folders = []
    monkeypatch.setattr(
        startup, "_ready_s", lambda environment: folders.append(environment.get("NUMBA_CACHE_DIR")) or 1.0
    )
    judged = startup.measure_starts(1, is_first=True)["summary"]
    assert judged[-1]["value"] == 1.0
    assert folders[-1] not in folders[:-1]


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [({"ir_exit": 3}, "nafir ir apartment .* failed"), ({"serves": False}, "did not become ready")],
)
def test_a_process_that_fails_is_no_measurement(pretend, changes, complaint):
    pretend(**changes)
    with pytest.raises(NafirError, match=complaint):
        startup.measure_starts(1)


def test_a_slow_start_misses_its_goal(monkeypatch):
    slow = {"host": {}, "rounds": 1, "summary": [startup.asdict(startup.READY_S.judge(9.0))]}
    monkeypatch.setattr(startup, "measure_starts", lambda *_, **__: slow)
    result = CliRunner().invoke(app, ["start"])
    assert result.exit_code == 1
    assert "s until nafir serve is ready" in result.output
