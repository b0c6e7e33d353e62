"""The reference says all that the code has: settings, commands, routes, messages, codes, fields of bundles, metrics."""

import ast
import dataclasses
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from server.api.app import create_app
from server.api.connection_limits import ConnectionLimits
from server.api.http_durations import HttpDurations
from server.api.kept_streams import KeptStreams
from server.api.problem_codes import PROBLEM_CODES
from server.api.request_log import RefusedRequests
from server.api.response_cache import ResponseCache
from server.api.settings import Settings
from server.api.stream_counts import StreamLedger
from server.api.telemetry import ServerCollector
from server.assets.upload_decoder import DecodingLimits
from server.cli.main import app as nafir
from server.core.stores import StoreCalls
from server.protocol.codes import CLOSE_CODES, ERROR_CODES
from server.protocol.exchange import EXCHANGE
from server.runtime.drain import Drain
from server.runtime.readiness import Readiness
from server.runtime.thread_watch import ThreadWatch
from server.scene.manifest import Manifest
from server.streaming.admission import Admission
from server.streaming.audio_engine import AudioEngine
from server.streaming.load_thresholds import Thresholds
from tests.engine_stage import Patient
from training.cli.main import app as nafir_train
from training.evaluation.literature import METRICS as BENCHMARK_METRICS

SERVER = Path(__file__).parents[2] / "server"
Page = Callable[[str], str]


def words(text: str) -> set[str]:
    return set(re.findall(r"[A-Za-z0-9_-]+", text))


def test_every_setting_is_listed_and_explained(site: Path, page: Page) -> None:
    assert {f"NAFIR_{name.upper()}" for name in Settings.model_fields} <= words(page("reference/settings"))
    rows = re.findall(r"<tr>.*?</tr>", (site / "reference/settings/index.html").read_text(), re.DOTALL)
    cells = [re.findall(r"<td>(.*?)</td>", row, re.DOTALL) for row in rows]
    assert [row[0] for row in cells if row and not row[-1].strip()] == []


@pytest.fixture(scope="module")
def limits() -> Iterator[Any]:
    """The generator of the table of limits."""
    sys.path.insert(0, str(SERVER.parent / "docs" / "hooks"))
    try:
        import reference_limits

        yield reference_limits
    finally:
        sys.path.pop(0)


OF_A_LIMIT = re.compile(
    r"_?(MAX|MOST|LONGEST|LARGEST|BIGGEST|WIDEST|DEEPEST|HIGHEST|FASTEST|LOUDEST|FINEST)(_|$)|\w+_(COST|PER_S|QUEUE_S|QUOTA|LIMIT)$"
)
"""Names of numbers that may limit what somebody can take."""
PACKAGES = (
    *(
        "api",
        "assets",
        "core",
        "field",
        "planning",
        "protocol",
        "rendering",
        "responses",
        "runtime",
        "scene",
        "streaming",
    ),
)
NO_LIMITS = {
    "what the server does by itself": """
        server.api.processes:_LONGEST_LOOK_S server.api.processes:_MOST_DEATHS
        server.api.process_peers:_MOST_ANSWER_BYTES server.api.request_log:_LONGEST_PATH
        server.api.response_cache:_LONGEST_RETRY_S server.api.telemetry:_LONGEST_S
        server.api.turn_taking:_LONGEST_PAUSE_S
        server.assets.shared_clips:_BYTES_PER_S server.assets.shared_clips:_MOST_CALLS server.core.near_names:_LONGEST
        server.runtime.logs:_MOST_KINDS
        server.runtime.logs:_MOST_TOGETHER server.runtime.pace:_LONGEST_NAP_S server.runtime.thread_watch:_MOST_DEATHS
        server.streaming.audio_engine:_MOST_AT_A_TICK server.streaming.calibration:_MOST_MS
        server.streaming.render_costs:_MOST_FIRST_S
        server.streaming.session:_MOST_DOOR_INTERVAL_S server.streaming.stream:_MAX_BEHIND_S
        server.streaming.stream_times:_MOST_WAITING server.streaming.audience:_MOST_NUMBER
        server.scene.outline:_MOST_FAULTS_TOLD server.rendering.mixer_set:_MOST
    """,
    "follows from another limit": """
        server.api.inflow:_MOST_FRAMES server.rendering.ingest:LOUDEST_GAIN server.rendering.partitions:LARGEST_BLOCK
        server.scene.bundle:_WIDEST_SAMPLE_BYTES
    """,
    "acoustics": """
        server.assets.audio_file:_MOST_CANCELLED server.field.band_tail_kernel:MOST_IN_A_BAND
        server.field.directions_kernel:_MOST_HARMONICS server.field.gate:MOST_GIVEN server.field.lattice:_MOST_MOVED_M
        server.planning.change:MOST_JND server.planning.effect_costs:_LONGEST_S server.planning.motion:_FASTEST_M_S
        server.planning.places:_LONGEST_S server.planning.plan_figure:_MOST_JND
        server.planning.planned_effects:_LONGEST_S server.planning.planned_effects:_MOST_PERIODS
        server.planning.effect_costs:RESPONSES_PER_S
        server.rendering.sofa_file:_HIGHEST_RAD server.rendering.sphere:_WIDEST_GAP
    """,
}


def numbers_that_may_be_limits() -> set[str]:
    """Names in the source, as `MODULE:NAME`."""
    found = set()
    for path in (each for package in PACKAGES for each in (SERVER / package).rglob("*.py")):
        module = ".".join(path.relative_to(SERVER.parent).with_suffix("").parts)
        for statement in ast.parse(path.read_text()).body:
            match statement:
                case ast.Assign(targets=targets):
                    names = [each for target in targets for each in ast.walk(target)]
                case ast.AnnAssign(target=target):
                    names = [target]
                case _:
                    continue
            found |= {
                f"{module}:{each.id}" for each in names if isinstance(each, ast.Name) and OF_A_LIMIT.match(each.id)
            }
    return found


def test_every_limit_has_a_line_in_the_one_table(limits: Any, page: Page) -> None:
    text = limits.limits()
    assert text.count("| --- | --- |") == 1
    listed = [each.place for each in limits.FIXED_LIMITS]
    assert len(listed) == len(set(listed))
    passed_over = [name for names in NO_LIMITS.values() for name in names.split()]
    found = numbers_that_may_be_limits()
    assert found - {*listed} - {*passed_over} == set(), "give it a line in FIXED_LIMITS, or a reason in NO_LIMITS"
    assert {*passed_over} <= found - {*listed}
    told = " ".join(page("how-to/secure").split())
    for each in limits.FIXED_LIMITS:
        assert each.value >= 0
        assert each.what.replace("`", "") in told, each.what


def test_every_setting_that_is_a_number_is_a_limit_or_said_to_be_none(limits: Any, page: Page) -> None:
    numbers = {name for name, field in Settings.model_fields.items() if {int, float} & {field.annotation}}
    assert numbers > limits.NO_LIMITS
    names = {f"NAFIR_{name.upper()}" for name in numbers - limits.NO_LIMITS}
    assert {"NAFIR_CLIPS_QUOTA_BYTES", "NAFIR_CLIPS_EXPIRE_S", "NAFIR_RESUME_S", "NAFIR_SNAPSHOT_LIFETIME_S"} < names
    assert names <= words(page("how-to/secure"))


def test_limits_of_whole_classes_are_all_listed(limits: Any) -> None:
    listed = {each.place for each in limits.FIXED_LIMITS}
    settings = {*Settings.model_fields}
    for limited in (ConnectionLimits, DecodingLimits):
        # Of an upload's seconds and bytes there are settings of another name.
        for each in {field.name for field in dataclasses.fields(limited)} - settings - {"seconds", "max_upload_bytes"}:
            assert f"{limited.__module__}:{limited.__name__}.{each}" in listed


def commands(program: str, command: Any) -> Iterator[tuple[str, Any]]:
    yield program, command
    for name, each in getattr(command, "commands", {}).items():
        yield from commands(f"{program} {name}", each)


@pytest.mark.parametrize(("program", "app"), [("nafir", nafir), ("nafir-train", nafir_train)])
def test_every_command_and_option_is_listed(page: Page, program: str, app: typer.Typer) -> None:
    text = page(f"reference/{program}")
    found = list(commands(program, typer.main.get_command(app)))
    assert len(found) > 10
    for path, command in found:
        section = text[re.search(rf"^{re.escape(path)}¶", text, re.MULTILINE).end() :]
        section = section.split("¶")[0]
        named = {name for each in command.params if each.param_type_name == "option" for name in each.opts}
        assert named - {"--help", "--install-completion", "--show-completion"} <= words(section), path


def test_every_route_is_listed_with_its_parameters(page: Page) -> None:
    text = page("reference/http")
    for path, operations in create_app(Settings()).openapi()["paths"].items():
        for method, operation in operations.items():
            assert f"{method.upper()} {path}" in text
            assert {each["name"] for each in operation.get("parameters", ())} <= words(text)
    assert {"/metrics", "/v1/stream", "/asyncapi.json"} <= set(re.findall(r"/[a-z0-9./]+", text))


def test_every_threshold_of_the_load_policy_is_listed_with_a_reason(site: Path) -> None:
    html = (site / "explanation/load-policy/index.html").read_text()
    cells = [re.findall(r"<td>(.*?)</td>", row, re.DOTALL) for row in re.findall(r"<tr>.*?</tr>", html, re.DOTALL)]
    listed = {re.sub(r"<.*?>", "", row[0]): row[1:] for row in cells if len(row) == 3}
    for each in dataclasses.fields(Thresholds):
        value, reason = listed[each.name]
        first, *_ = each.default if isinstance(each.default, tuple) else (each.default,)
        assert float(value.split(",")[0]) == pytest.approx(first, abs=0.001)
        assert len(reason.split()) > 5, each.name


def test_every_message_of_the_stream_is_described(page: Page) -> None:
    text = page("reference/stream")
    assert all(re.search(rf"^{step.name}¶", text, re.MULTILINE) for step in EXCHANGE)


def test_every_field_of_a_manifest_is_described(page: Page) -> None:
    schema = Manifest.model_json_schema()
    objects = [schema, *(each for each in schema["$defs"].values() if "properties" in each)]
    assert {name for each in objects for name in each["properties"]} <= words(page("reference/bundle"))


def test_every_code_is_listed(page: Page) -> None:
    listed = words(page("reference/error-codes"))
    assert {*PROBLEM_CODES, *ERROR_CODES, *map(str, CLOSE_CODES)} <= listed


def codes_in(path: Path) -> set[str]:
    """What the source gives errors, refusals and obstacles as their code."""
    place = {"RequestError": 0, "Refusal": 1, "problem": 1, "Obstacle": 0}
    found = set()
    for call in ast.walk(ast.parse(path.read_text())):
        name = getattr(call.func, "id", None) if isinstance(call, ast.Call) else None
        if name in place and len(call.args) > place[name]:
            given = call.args[place[name]]
            found |= {each.value for each in ast.walk(given) if isinstance(each, ast.Constant)}
    return {code for code in found if re.fullmatch(r"[a-z]+(_[a-z]+)+", str(code))}


def test_every_code_in_the_source_has_a_meaning() -> None:
    found = {code for path in SERVER.rglob("*.py") for code in codes_in(path)}
    assert len(found) > 30
    of_the_command_line = {"malformed_duration"}
    assert found - of_the_command_line <= {*PROBLEM_CODES, *ERROR_CODES}
    of_http = {
        code for path in (SERVER / "api").glob("*.py") for code in codes_in(path) if path.name != "connection.py"
    }
    assert of_http <= {*PROBLEM_CODES, "not_found"}


def test_every_meaning_is_of_a_code_in_the_source() -> None:
    sources = [path.read_text() for path in SERVER.rglob("*.py") if path.name not in {"problem_codes.py", "codes.py"}]
    assert [code for code in PROBLEM_CODES if not any(f'"{code}"' in source for source in sources)] == []


class Host:
    def __init__(self, responses: ResponseCache) -> None:
        self.audio = AudioEngine(lambda call: call(), Patient(), time_s=lambda: 50.0)
        self.ledger = StreamLedger()
        self.admission = Admission(self.audio, most_streams=1, cores=2)
        self.kept = KeptStreams(keep_s=1.0, most=1, give_up=self.admission.leave)
        self.readiness = Readiness(Drain(8.0), ThreadWatch((self.audio,)), warm_up="done")
        self.clips: dict[str, Any] = {}
        self.offers: dict[str, Any] = {}
        self.refused_bundles = 0
        self.peers = None
        self.stores = {"clips": StoreCalls()}
        self.refused_requests = RefusedRequests()
        self.http_durations = HttpDurations()
        self.responses = responses


def test_every_metric_is_listed(page: Page) -> None:
    with ResponseCache(workers=1, waiting=1) as responses:
        told = {family.name for family in ServerCollector(Host(responses)).collect()}
    listed = {re.sub(r"_(total|info)$", "", word) for word in words(page("reference/metrics"))}
    assert len(told) > 15
    assert told <= listed


def test_every_error_of_a_benchmark_is_defined(page: Page) -> None:
    text = page("reference/error-definitions")
    for metric in BENCHMARK_METRICS:
        assert f"{metric.label} ({metric.name})" in text
        assert " ".join(metric.definition.formula.split()) in " ".join(text.split())
