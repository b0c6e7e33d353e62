import pytest
from starlette.testclient import TestClient

from server.api.app import create_app
from server.api.settings import Settings
from server.field.fields_by_level import FieldsByLevel
from tests.api.test_routes import PLACES, check_problem, wait_until_ready

SCENE = "/v1/scenes/flat"
EMITTER = {"emitter": "6,3,1.5"}
FILES = ("/", "/nafir/stream.js", "/docs", "/redoc", "/vendor/swagger-ui.css")
GETS = [
    ("/livez", {}),
    ("/readyz", {}),
    ("/asyncapi.json", {}),
    ("/openapi.json", {}),
    ("/v1/scenes", {}),
    (SCENE, {}),
    (f"{SCENE}/frontier", {}),
    (f"{SCENE}/impulse-response", PLACES),
    (f"{SCENE}/loudness", {**EMITTER, "spacing_m": "1"}),
    (f"{SCENE}/plan", {"emitter": ["6,3,1.5", "1,2,1.5"]}),
    ("/v1/clips", {}),
    ("/v1/hrtfs", {}),
    ("/v1/hrtfs/kemar/decoder", {"sample_rate": "24000"}),
    *[(path, {}) for path in FILES],
]
CHANGING = {"date", "x-request-id"}


@pytest.fixture(scope="module")
def client(bundle, hrtfs):
    levels = FieldsByLevel.load(bundle)
    with TestClient(create_app(Settings(), scenes={"flat": levels}, hrtfs=hrtfs)) as client:
        wait_until_ready(client)
        yield client


@pytest.mark.parametrize(("path", "params"), [*GETS, ("/v1/scenes/moon", {}), (f"{SCENE}/loudness", {}), ("/no", {})])
def test_head_is_get_without_a_body(client, path, params):
    for _ in range(3):  # a plan changes once more when the server has measured what effects cost
        got, head = client.get(path, params=params), client.head(path, params=params)
        # How long a compressed file is, is known only once it is.
        ignored = CHANGING | ({"content-length"} if path in FILES and "content-encoding" in got.headers else set())
        told = [{name: text for name, text in each.headers.items() if name not in ignored} for each in (got, head)]
        if told[0] == told[1]:
            break
    assert told[0] == told[1]
    assert head.status_code == got.status_code
    assert head.content == b""
    if "content-encoding" not in head.headers:
        assert int(head.headers["content-length"]) == len(got.content) > 0


def test_head_of_metrics_has_its_type(client):
    assert client.head("/metrics").headers["content-type"] == client.get("/metrics").headers["content-type"]


def test_head_answers_what_a_client_has_with_304(client):
    tag = client.head(f"{SCENE}/impulse-response", params=PLACES).headers["etag"]
    again = client.head(f"{SCENE}/impulse-response", params=PLACES, headers={"If-None-Match": tag})
    assert (again.status_code, again.headers["etag"]) == (304, tag)


@pytest.mark.parametrize(("path", "params"), [*GETS, ("/metrics", {})])
def test_allow_says_what_works_and_nothing_else(client, path, params):
    allowed = client.options(path).headers["allow"].split(", ")
    assert client.options(path).status_code == 204
    uploads = ["POST"] if path == "/v1/clips" else []
    assert sorted(allowed) == ["GET", "HEAD", "OPTIONS", *uploads]
    for method in ("GET", "HEAD", "OPTIONS", "POST", "PUT", "PATCH", "DELETE", "TRACE", "BREW"):
        answer = client.request(method, path, params=params)
        if method in uploads:
            assert answer.json()["code"] == "uploads_off", "this server takes none"
        elif method in allowed:
            assert answer.status_code in {200, 204}, method
        else:
            check_problem(answer, 405, "method_not_allowed")
            assert answer.headers["allow"].split(", ") == allowed


@pytest.mark.parametrize("method", ["GET", "HEAD", "OPTIONS", "POST"])
def test_where_there_is_nothing_no_method_is_allowed(client, method):
    assert client.request(method, "/no/such").status_code == 404


def test_a_stream_asked_for_over_http_says_what_it_is(client):
    answer = client.get("/v1/stream")
    check_problem(answer, 426, "upgrade_required")
    assert answer.headers["upgrade"] == "websocket"


@pytest.mark.parametrize(("path", "params"), [each for each in GETS if each[0] not in FILES])
@pytest.mark.parametrize("name", ["colour", "Listener", "emitter[]", " "])
def test_a_parameter_that_there_is_not_is_refused_on_every_route(client, path, params, name):
    check_problem(client.get(path, params={**params, name: "1"}), 422, "unknown_parameter", name)


@pytest.mark.parametrize(
    ("path", "query", "code", "field", "words"),
    [
        ("impulse-response", "yaw=90", "unknown_parameter", "yaw", "did you mean 'yaw_deg'?"),
        ("impulse-response", "yaw_deg=90&yaw_deg=0", "doubled_parameter", "yaw_deg", "2 times"),
        ("impulse-response", "yaw_deg=90&yaw%5Fdeg=90", "doubled_parameter", "yaw_deg", "2 times"),
        ("impulse-response", "level=&level=", "doubled_parameter", "level", "2 times"),
        ("loudness", "heigth_m=2", "unknown_parameter", "heigth_m", "did you mean 'height_m'?"),
    ],
)
def test_what_is_misspelt_or_doubled_is_named(client, path, query, code, field, words):
    places = "emitter=6,3,1.5" + ("&listener=1,2,1.5" if path == "impulse-response" else "")
    answer = client.get(f"{SCENE}/{path}?{places}&{query}")
    check_problem(answer, 422, code, field)
    assert words in answer.json()["detail"]


def test_lists_may_be_repeated_and_what_is_beside_them_may_not(client):
    places = "emitter=6,3,1.5&emitter=1,2,1.5&effect=hrtf=on&effect=occlusion=off"
    assert client.get(f"{SCENE}/plan?{places}").status_code == 200
    check_problem(client.get(f"{SCENE}/plan?{places}&listner=1,2,1"), 422, "unknown_parameter", "listner")
    check_problem(client.get(f"{SCENE}/plan?{places}&walks=true&walks=false"), 422, "doubled_parameter", "walks")


def test_the_page_keeps_its_query(client):
    assert client.get("/?scene=flat").status_code == 200
