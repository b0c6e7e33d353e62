"""Who may use a server that asks for keys."""

import asyncio
import base64
import contextlib
import json
import os
import time

import pytest
import uvicorn
from fastapi.routing import iter_route_contexts
from starlette.testclient import TestClient, WebSocketDenialResponse

from server.api import access as access_module
from server.api.access import Access
from server.api.access_gate import KEY_PROTOCOL, scopes_for
from server.api.api_keys import SCOPES, create_key, revoke_key
from server.api.app import WEB, create_app
from server.api.connection import SUBPROTOCOL
from server.api.process_peers import OWN_METRICS, OWN_STREAMS, PEER_KEY, ProcessPeers
from server.api.serving import uvicorn_options
from server.api.settings import Settings, settings_of
from server.core.errors import NafirError
from server.field.fields_by_level import FieldsByLevel
from server.protocol.client_messages import PROTOCOL, Hello, Resume
from server.protocol.codes import ACCESS_ENDED, CLOSE_CODES, ERROR_CODES
from server.protocol.server_messages import Error, Welcome, parse_server_message
from tests.api.token_keys import AUDIENCE, KEY_SET, token

HELLO = Hello(protocol=PROTOCOL, scene="flat")
IR = "/v1/scenes/flat/impulse-response?listener=1,2,1.5&emitter=6,3,1.5"
PEERS_KEY = "nafir_aaaaaaaaaaaa_of-the-processes"


def bearer(key):
    return {"Authorization": f"Bearer {key}"}


def protocols(key, *, chosen=SUBPROTOCOL):
    encoded = base64.urlsafe_b64encode(key.encode()).rstrip(b"=").decode()
    return [chosen, f"{KEY_PROTOCOL}{encoded}"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("keys")
    (folder / "jwks.json").write_text(json.dumps(KEY_SET))
    return folder


@pytest.fixture(scope="module")
def keys(folder):
    """A key of each scope, by the scope."""
    return {scope: create_key(folder / "keys.json", scope, [scope], None)[0] for scope in SCOPES}


@pytest.fixture(scope="module")
def client(bundle, hrtfs, folder, keys):
    assert len(keys) == len(SCOPES)  # they are in the file
    settings = Settings(
        keys_file=folder / "keys.json",
        jwt_keys_file=folder / "jwks.json",
        jwt_audience=AUDIENCE,
        jwt_leeway_s=0,
        allowed_origins=("https://game.example",),
    )
    scenes = {"flat": FieldsByLevel.load(bundle)}
    peers = ProcessPeers(0, (1,), PEERS_KEY)
    app = create_app(settings, scenes=scenes, hrtfs=hrtfs, peers=peers)
    with TestClient(app, base_url="http://localhost:8000") as client:
        until = time.monotonic() + 180
        while client.get("/readyz", headers=bearer(keys["metrics"])).status_code != 200:
            assert time.monotonic() < until
            time.sleep(0.05)
        yield client


def from_address(client, host):
    """Another client of the same running application, from an address."""
    other = TestClient(client.app, base_url="http://localhost:8000", client=(host, 50_000))
    other.app_state.update(client.app_state)
    return other


def basic(password, *, name="whoever"):
    given = f"{name}:{password}".encode()
    return {"Authorization": f"Basic {base64.b64encode(given).decode()}"}


def paths(app):
    """The path of every route, parameters filled in, with its methods; none are a WebSocket's."""
    for context in iter_route_contexts(app.router.routes):
        path = getattr(context, "path", None)
        if path:
            filled = path.replace("{scene}", "flat").replace("{hrtf}", "kemar").replace("{file}", "scene.json")
            filled = filled.replace("{path:path}", "")
            yield filled, frozenset(getattr(context, "methods", None) or ())


def check_refused(answer, status, code):
    assert answer.status_code == status, answer.url
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert answer.json()["code"] == code
    assert answer.headers["WWW-Authenticate"].startswith('Bearer realm="nafir"')


OUTSIDER = "203.0.113.7"
WRONG = (
    {},
    bearer("nafir_000000000000_wrong"),
    bearer(token(exp=1)),
    basic("nafir_000000000000_wrong"),
    basic(token(exp=1)),
    {"Authorization": "Basic eDp5"},
    {"Authorization": "Digest username=x"},
)
METHODS = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})


def page_files():
    """The path of every file of the page, and of pages without `.html`."""
    files = [file.relative_to(WEB).as_posix() for file in WEB.rglob("*") if file.is_file()]
    pages = [name.removesuffix(".html") for name in files if name.endswith(".html")]
    return ["/", *(f"/{name.removesuffix('.gz')}" for name in (*files, *pages))]


def test_an_outsider_gets_nothing_but_the_liveness(client, keys):
    """Every route is tried, with every method: one that is added later is closed unless somebody opens it."""
    outsider = from_address(client, OUTSIDER)
    document = client.get("/openapi.json", headers=bearer(keys["listen"])).json()
    declared = {path: methods for path, methods in paths(client.app) if path}
    described = {path.replace("{scene}", "flat"): frozenset() for path in document["paths"]}
    unknown = ("/v2", "/nothing", "/livez/", "/livez/x", "/livez%00", "/%6divez", "/metrics%20", "/V1/scenes")
    near_files = ("/docs/", "/docs.js.map", "/redoc/", "/index.html/", "/nafir", "/nafir/", "//", "/./main.js")
    tried = {**described, **dict.fromkeys((*page_files(), *unknown, *near_files), frozenset()), **declared}
    del tried["/livez"]
    assert {"/v1/stream", "/v1/scenes", "/metrics", OWN_METRICS, "/openapi.json", "/asyncapi.json"} <= tried.keys()
    assert {"/readyz", "/", "/docs", "/redoc", "/main.js", "/vendor/redoc.standalone.js"} <= tried.keys()
    assert len(tried) > 80
    for path, methods in tried.items():
        for method in METHODS | methods:
            for given in WRONG if path in declared else ({}, basic("nafir_000000000000_wrong")):
                answer = outsider.request(method, path, headers=given, follow_redirects=False)
                assert answer.status_code == 401, (method, path, given)
                assert method == "HEAD" or answer.json()["code"] in {"key_required", "key_refused"}
                assert answer.headers.keys() <= {
                    "content-length", "content-type", "www-authenticate", "x-request-id", "vary", "content-encoding",
                }  # fmt: skip
    assert outsider.get("/livez").json() == {"status": "live"}
    assert outsider.get("/livez", headers=WRONG[1]).json() == {"status": "live"}
    assert outsider.post("/livez").status_code == 405


@pytest.mark.parametrize("path", ["/v1/stream", "/v1/stream/", "/livez", "/readyz", "/", "/metrics", "/nothing"])
def test_an_outsider_opens_no_web_socket(client, path):
    for address in (OUTSIDER, "127.0.0.1"):
        asking = from_address(client, address)
        for given in WRONG:
            with pytest.raises(WebSocketDenialResponse) as refused, asking.websocket_connect(path, headers={**given}):
                pass
            check_refused(refused.value, 401, "key_refused" if given else "key_required")


def test_any_key_tells_whether_the_server_is_ready(client, keys):
    outsider = from_address(client, OUTSIDER)
    for key in (*keys.values(), token()):
        assert outsider.get("/readyz", headers=bearer(key)).json() == {"status": "ready"}
        assert outsider.head("/readyz", headers=basic(key)).status_code == 200
    check_refused(outsider.get("/readyz", headers=bearer(token(scope=""))), 403, "scope_missing")
    check_refused(outsider.post("/readyz", headers=bearer(keys["listen"])), 403, "scope_missing")


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "::1", "::ffff:127.0.0.1"])
def test_this_machine_needs_no_key_to_ask_whether_the_server_is_ready(client, host):
    here = from_address(client, host)
    for given in ({}, {"Host": "127.0.0.1:8000"}, {"Host": "[::1]:8000"}, *WRONG):
        assert here.get("/readyz", headers=given).json() == {"status": "ready"}
    check_refused(here.get("/v1/scenes"), 401, "key_required")
    check_refused(here.get("/metrics"), 401, "key_required")


@pytest.mark.parametrize(
    "passed_on",
    [
        {"X-Forwarded-For": OUTSIDER},
        {"X-Forwarded-For": "127.0.0.1"},  # as an outsider wrote it, and a proxy left it
        {"Forwarded": f"for={OUTSIDER}"},
        {"Via": "1.1 proxy"},
        {"X-Real-IP": OUTSIDER},
        {"Host": "sound.example"},
        {"Host": "192.0.2.1"},
    ],
)
def test_what_a_proxy_of_this_machine_passes_on_is_not_of_this_machine(client, passed_on):
    here = from_address(client, "127.0.0.1")
    check_refused(here.get("/readyz", headers=passed_on), 401, "key_required")


def test_behind_a_proxy_of_this_machine_readiness_is_told_to_keys_alone(client, keys, monkeypatch):
    """As `nafir serve` runs the application: it trusts proxies on loopback."""
    monkeypatch.delenv("FORWARDED_ALLOW_IPS", raising=False)
    config = uvicorn.Config(client.app, **uvicorn_options(Settings()))
    config.load()
    proxied = TestClient(config.loaded_app, base_url="http://localhost:8000", client=("127.0.0.1", 50_000))
    proxied.app_state.update(client.app_state)
    assert proxied.get("/readyz").status_code == 200
    for forwarded in (OUTSIDER, f"127.0.0.1, {OUTSIDER}", f"{OUTSIDER}, 127.0.0.1", "127.0.0.1", ""):
        passed_on = {"X-Forwarded-For": forwarded}
        check_refused(proxied.get("/readyz", headers=passed_on), 401, "key_required")
        assert proxied.get("/readyz", headers={**passed_on, **bearer(keys["listen"])}).status_code == 200


def challenges(answer):
    return answer.headers.get_list("www-authenticate")


def test_a_browser_is_told_to_ask_for_a_key_by_files_of_the_page_alone(client, keys):
    for path in ("/", "/docs", "/redoc", "/main.js", "/nafir/stream_worker.js", "/fonts/instrument-sans.woff2"):
        for given in WRONG:
            first, second = challenges(client.get(path, headers=given))
            assert first == 'Basic realm="nafir", charset="UTF-8"'
            assert second.startswith('Bearer realm="nafir"')
    for path in ("/v1/scenes", "/openapi.json", "/asyncapi.json", "/metrics", "/readyz", "/v1/stream", "/nothing"):
        for given in (*WRONG, basic(keys["render"])):
            answer = client.get(path, headers=given)
            if answer.status_code in {401, 403}:
                (only,) = challenges(answer)
                assert only.startswith('Bearer realm="nafir"')
    assert "password" in client.get("/").json()["detail"]


def test_any_key_opens_every_file_of_the_page(client, keys):
    for path in page_files():
        assert client.get(path, headers=basic(keys["metrics"])).status_code == 200, path
    for key in (*keys.values(), token()):
        for given in (basic(key), bearer(key), basic(key, name=""), basic(key, name="Jürgen")):
            assert client.get("/", headers=given).status_code == 200
            assert client.head("/docs", headers=given).status_code == 200
    check_refused_page = client.get("/", headers=bearer(token(scope="")))
    check_refused(check_refused_page, 403, "scope_missing")


def test_a_key_by_basic_does_what_a_bearer_does(client, keys):
    for path, method in (("/v1/scenes", "GET"), (IR, "GET"), ("/v1/clips", "POST"), ("/metrics", "GET")):
        for key in (*keys.values(), token()):
            answers = [client.request(method, path, headers=given(key)) for given in (basic, bearer)]
            codes = [(each.status_code, each.json()["code"] if each.is_error else None) for each in answers]
            assert codes[0] == codes[1]
    welcome, _ = opened(client, headers=basic(keys["listen"]))
    assert isinstance(welcome, Welcome)


@pytest.mark.parametrize(
    "given",
    [
        "",
        "!",
        "eA",  # not padded
        "eA==",  # without a colon
        "Og==",  # nothing on both sides of it
        base64.b64encode(b"x:\xff\xfe").decode(),
        base64.b64encode("x:schlüssel".encode()).decode(),
        base64.b64encode(b"x:schl\xfcssel").decode(),
        base64.b64encode(b"x:" + b"k" * 5_000).decode(),
        base64.b64encode(b"x" * 5_000 + b":").decode(),
        base64.b64encode(b"x:nafir_" + b"_" * 5_000).decode(),
        base64.b64encode(b"x:" + b"." * 5_000).decode(),
        "\u00fc",
    ],
)
def test_what_is_no_key_by_basic_opens_nothing(client, given):
    header = {"Authorization": f"Basic {given}".encode("latin-1")}
    for path in ("/", "/v1/scenes", "/readyz"):
        check = client.get(path, headers=header)
        assert (check.status_code, check.json()["code"]) == (401, "key_refused")
    with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect("/v1/stream", headers=header):
        pass
    assert refused.value.status_code == 401


def test_a_key_of_the_page_comes_before_one_that_the_browser_adds(client, keys):
    """Browsers add what they were given by Basic to the handshake of a stream, whatever the page says."""
    for by_itself in (keys["render"], "wrong"):
        welcome, _ = opened(client, headers=basic(by_itself), subprotocols=protocols(keys["listen"]))
        assert isinstance(welcome, Welcome)
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        client.websocket_connect("/v1/stream", headers=basic(keys["listen"]), subprotocols=protocols("wrong")),
    ):
        pass
    check_refused(refused.value, 401, "key_refused")


def test_a_named_site_cannot_use_the_key_that_a_browser_adds(client, keys):
    site = {"Origin": "https://game.example"}
    for method, path in (("GET", "/v1/scenes"), ("POST", "/v1/clips"), ("DELETE", "/v1/clips/abc")):
        check_refused(client.request(method, path, headers={**site, **basic(keys["upload"])}), 401, "key_required")
        assert client.request(method, path, headers={**site, **bearer(keys["upload"])}).status_code != 401
        own = {"Origin": "http://localhost:8000", "Sec-Fetch-Site": "same-origin"}
        assert client.request(method, path, headers={**own, **basic(keys["upload"])}).status_code != 401
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        client.websocket_connect("/v1/stream", headers={**site, **basic(keys["listen"])}),
    ):
        pass
    check_refused(refused.value, 401, "key_required")


def test_only_named_sites_may_show_the_page_in_a_frame(client, keys):
    """A page of another site could lay it, opened by the key that the browser adds, under its own."""
    for path in ("/", "/docs", "/redoc"):
        policy = client.get(path, headers=basic(keys["listen"])).headers["Content-Security-Policy"]
        assert policy == "frame-ancestors 'self' https://game.example"


def test_caches_that_others_share_keep_nothing_that_a_key_has_opened(client, keys):
    for path in (IR, "/v1/schemas/bundle", "/v1/scenes/flat/bundle/scene.json"):
        answer = client.get(path, headers=bearer(keys["render"]))
        assert answer.headers["Cache-Control"] == "private, max-age=3600"


def test_no_route_of_version_1_is_closed_to_all_but_operators_by_oversight(client):
    found = [(path, methods or {"GET"}) for path, methods in paths(client.app) if path.startswith("/v1/")]
    assert len(found) > 8
    for path, methods in found:
        for method in methods - {"HEAD", "OPTIONS"}:
            assert scopes_for(method, path) != {"admin"}, (method, path)


def test_a_key_in_the_query_opens_nothing(client, keys):
    for name in ("key", "token", "access_token", "api_key"):
        check_refused(client.get("/v1/scenes", params={name: keys["listen"]}), 401, "key_required")


@pytest.mark.parametrize(
    ("method", "path", "scopes"),
    [
        ("GET", "/v1/scenes", {"listen", "render"}),
        ("HEAD", "/v1/scenes/flat", {"listen", "render"}),
        ("GET", "/v1/scenes/flat/frontier", {"listen", "render"}),
        ("GET", "/v1/scenes/flat/impulse-response", {"render"}),
        ("GET", "/v1/scenes/flat/loudness", {"render"}),
        ("GET", "/v1/scenes/flat/plan", {"render"}),
        ("GET", "/v1/scenes/flat/ambisonic-noises", {"render"}),
        ("POST", "/v1/scenes/flat/impulse-responses", {"render"}),
        ("GET", "/v1/clips", {"listen", "upload"}),
        ("POST", "/v1/clips", {"upload"}),
        ("DELETE", "/v1/clips/abc", {"upload"}),
        ("GET", "/v1/hrtfs/kemar/decoder", {"listen", "render"}),
        ("GET", "/v1/stream", {"listen"}),
        ("GET", "/openapi.json", {"listen", "render", "upload", "admin"}),
        ("GET", "/metrics", {"metrics", "admin"}),
        ("GET", OWN_METRICS, {"metrics", "admin"}),
        ("POST", "/metrics", {"admin"}),
        ("POST", OWN_STREAMS, {"process"}),
        ("GET", "/anything/new", {"admin"}),
        ("POST", "/v1/scenes", {"admin"}),
        ("DELETE", "/v1/scenes/flat", {"admin"}),
        ("GET", "/v1/scenes\n", {"admin"}),
    ],
)
def test_every_path_has_its_scope(method, path, scopes):
    assert scopes_for(method, path) == scopes


def test_a_key_does_what_its_scope_says_and_nothing_else(client, keys):
    for path, method in (("/v1/scenes", "GET"), (IR, "GET"), ("/v1/clips", "POST"), ("/metrics", "GET")):
        needed = scopes_for(method, path.partition("?")[0])
        for scope, key in keys.items():
            answer = client.request(method, path, headers=bearer(key))
            if scope in needed:
                assert answer.status_code != 401, (scope, path)
                assert answer.status_code != 403 or answer.json()["code"] == "uploads_off", (scope, path)
            else:
                check_refused(answer, 403, "scope_missing")
                assert 'error="insufficient_scope"' in answer.headers["WWW-Authenticate"]
    assert client.get(IR, headers=bearer(keys["render"])).status_code == 200


def test_a_token_does_what_its_scopes_say(client):
    for algorithm in ("HS256", "RS256", "ES256"):
        assert client.get(IR, headers=bearer(token(algorithm))).status_code == 200
    check_refused(client.get("/metrics", headers=bearer(token())), 403, "scope_missing")
    assert client.get("/metrics", headers=bearer(token(scope="openid admin"))).status_code == 200
    check_refused(client.get("/v1/scenes", headers=bearer(token(scope=""))), 403, "scope_missing")
    refused = client.get(IR, headers=bearer(token(aud="another")))
    check_refused(refused, 401, "key_refused")
    assert "audience" in refused.json()["detail"]


def test_a_key_comes_once(client, keys):
    key = keys["listen"]
    twice = client.get("/v1/scenes", headers=[("Authorization", f"Bearer {key}"), ("Authorization", "Bearer x")])
    assert (twice.status_code, twice.json()["code"]) == (400, "doubled_header")
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        client.websocket_connect("/v1/stream", headers=bearer(key), subprotocols=protocols(key)),
    ):
        pass
    assert refused.value.status_code == 400
    for scheme in ("bearer", "BEARER", "Bearer  "):
        assert client.get("/v1/scenes", headers={"Authorization": f"{scheme} {key}"}).status_code == 200


def opened(client, **options):
    """What a hello is answered on a stream."""
    with client.websocket_connect("/v1/stream", **options) as socket:
        socket.send_text(HELLO.serialize())
        return parse_server_message(socket.receive_text()), socket.accepted_subprotocol


def test_a_stream_opens_by_header_and_by_subprotocol(client, keys):
    welcome, chosen = opened(client, headers=bearer(keys["listen"]))
    assert isinstance(welcome, Welcome)
    assert chosen is None
    for key in (keys["listen"], token()):
        welcome, chosen = opened(client, subprotocols=protocols(key))
        assert isinstance(welcome, Welcome)
        assert chosen == SUBPROTOCOL


def test_a_stream_is_refused_before_it_opens(client, keys):
    wrong = [f"{KEY_PROTOCOL}{text}" for text in ("", "=", "%", "bmFmaXI", "A" * 4_000)]
    tries = (
        ({}, 401, "key_required"),
        ({"subprotocols": [SUBPROTOCOL]}, 401, "key_required"),
        *(({"subprotocols": [SUBPROTOCOL, each]}, 401, "key_refused") for each in wrong),
        ({"subprotocols": protocols(keys["render"])}, 403, "scope_missing"),
        ({"headers": bearer(token(exp=1))}, 401, "key_refused"),
    )
    for options, status, code in tries:
        with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect("/v1/stream", **options):
            pass
        check_refused(refused.value, status, code)


def test_another_sites_page_opens_no_stream_even_with_a_key(client, keys):
    for origin, status in (("https://evil.example", 403), ("null", 403), ("http://localhost:3000", 403)):
        with (
            pytest.raises(WebSocketDenialResponse) as refused,
            client.websocket_connect(
                "ws://localhost:8000/v1/stream", headers={"Origin": origin}, subprotocols=protocols(keys["listen"])
            ),
        ):
            pass
        assert (refused.value.status_code, refused.value.json()["code"]) == (status, "origin_not_allowed")
    welcome, _ = opened(client, headers={"Origin": "https://game.example"}, subprotocols=protocols(keys["listen"]))
    assert isinstance(welcome, Welcome)


def test_pages_of_named_sites_may_send_keys_and_read_why_they_are_refused(client, keys):
    site = {"Origin": "https://game.example"}
    for method, header in (("GET", "Authorization"), ("POST", "Content-Type"), ("DELETE", "Authorization")):
        asked = {"Access-Control-Request-Method": method, "Access-Control-Request-Headers": header}
        preflight = client.options("/v1/clips", headers={**site, **asked})
        assert preflight.status_code == 200
        assert header.lower() in preflight.headers["Access-Control-Allow-Headers"].lower()
        assert method in preflight.headers["Access-Control-Allow-Methods"]
    answer = client.get("/v1/scenes", headers=site)
    check_refused(answer, 401, "key_required")
    assert answer.headers["Access-Control-Allow-Origin"] == site["Origin"]
    assert "WWW-Authenticate" in answer.headers["Access-Control-Expose-Headers"]
    assert client.get("/v1/scenes", headers={**site, **bearer(keys["listen"])}).status_code == 200


def closed_with(socket):
    """The last error of a stream and its close code."""
    error = None
    while (event := socket.receive())["type"] != "websocket.close":
        if event.get("text") is not None:
            message = parse_server_message(event["text"])
            error = message if isinstance(message, Error) else error
    assert error is not None
    assert event["reason"] == error.code
    return error.code, event["code"]


def test_a_stream_ends_when_its_token_expires(client):
    expires_s = int(time.time()) + 2
    with client.websocket_connect("/v1/stream", headers=bearer(token(exp=expires_s))) as socket:
        socket.send_text(HELLO.serialize())
        assert closed_with(socket) == ("key_expired", ACCESS_ENDED)
        assert 0 <= time.time() - expires_s < 2


def test_a_stream_ends_when_its_key_is_revoked_and_others_go_on(client, folder, keys):
    key, entry = create_key(folder / "keys.json", "leaving", ["listen"], None)
    wait_until(lambda: client.get("/v1/scenes", headers=bearer(key)).status_code == 200)
    with (
        client.websocket_connect("/v1/stream", headers=bearer(key)) as leaving,
        client.websocket_connect("/v1/stream", headers=bearer(keys["listen"])) as staying,
    ):
        for socket in (leaving, staying):
            socket.send_text(HELLO.serialize())
            assert isinstance(parse_server_message(socket.receive_text()), Welcome)
        revoke_key(folder / "keys.json", entry.id)
        assert closed_with(leaving) == ("key_revoked", ACCESS_ENDED)
        staying.send_text('{"type": "ping", "id": 7}')
        while '"pong"' not in (staying.receive().get("text") or ""):
            pass
    check_refused(client.get("/v1/scenes", headers=bearer(key)), 401, "key_refused")


def test_a_stream_ends_when_the_key_of_its_token_leaves_the_set(client, folder):
    file = folder / "jwks.json"
    with client.websocket_connect("/v1/stream", headers=bearer(token("ES256"))) as socket:
        socket.send_text(HELLO.serialize())
        assert isinstance(parse_server_message(socket.receive_text()), Welcome)
        file.write_text(json.dumps({"keys": [key for key in KEY_SET["keys"] if key["alg"] != "ES256"]}))
        assert closed_with(socket) == ("key_revoked", ACCESS_ENDED)
    assert client.get("/v1/scenes", headers=bearer(token("RS256"))).status_code == 200
    file.write_text(json.dumps(KEY_SET))
    wait_until(lambda: client.get("/v1/scenes", headers=bearer(token("ES256"))).status_code == 200)


def test_a_stream_is_resumed_by_whoever_opened_it_and_nobody_else(client, keys, folder):
    """Keys and subjects are told apart also where their scopes are the same."""

    def begin(key, first):
        """A stream, and what the server says first."""
        socket = streams.enter_context(client.websocket_connect("/v1/stream", headers=bearer(key)))
        socket.send_text(first.serialize())
        return socket, parse_server_message(socket.receive_text())

    other, _ = create_key(folder / "keys.json", "other", ["listen"], None)
    wait_until(lambda: client.get("/v1/scenes", headers=bearer(other)).status_code == 200)
    player, later, another = token(sub="player"), token(sub="player", exp=int(time.time()) + 90), token(sub="another")
    cases = ((keys["listen"], keys["listen"], (other, player)), (player, later, (another, other)))
    for owner, again, strangers in cases:
        with contextlib.ExitStack() as streams:
            first, welcome = begin(owner, HELLO)
            resume = Resume(protocol=PROTOCOL, token=welcome.resume_token)
            for stranger in strangers:
                assert begin(stranger, resume)[1].code == "unknown_resume_token"
            first.send_text('{"type": "ping", "id": 7}')  # nothing was taken over
            while '"pong"' not in (first.receive().get("text") or ""):
                pass
            assert isinstance(begin(again, resume)[1], Welcome)
            assert closed_with(first)[0] == "taken_over"


def wait_until(holds):
    deadline = time.monotonic() + 20
    while not holds():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def test_the_code_of_every_end_of_access_is_described():
    assert ACCESS_ENDED in CLOSE_CODES
    assert {"key_expired", "key_revoked"} <= ERROR_CODES.keys()


def test_the_document_says_what_needs_a_key(client, keys):
    document = client.get("/openapi.json", headers=bearer(keys["listen"])).json()
    schemes = document["components"]["securitySchemes"]
    assert {name: scheme["scheme"] for name, scheme in schemes.items()} == {"key": "bearer", "password": "basic"}
    for path, operations in document["paths"].items():
        for operation in operations.values():
            assert ("security" in operation) == (path != "/livez")
            assert ("401" in operation["responses"]) == (path != "/livez")
    response = document["paths"]["/v1/scenes/{scene}/impulse-response"]["get"]
    assert response["security"] == [{"key": ["render"]}, {"password": ["render"]}]
    ready = document["paths"]["/readyz"]["get"]
    assert ready["security"] == [{name: [scope]} for scope in SCOPES for name in ("key", "password")]


def test_the_processes_of_a_server_ask_each_other_with_a_key_of_their_own(client, keys):
    assert client.get(OWN_METRICS, headers=bearer(PEERS_KEY)).status_code == 200
    check_refused(client.get("/v1/scenes", headers=bearer(PEERS_KEY)), 403, "scope_missing")
    asked = {"token": "of-nobody", "owner": None, "by": 1}
    of_peer = bearer(PEERS_KEY) | {PEER_KEY: PEERS_KEY}
    assert client.post(OWN_STREAMS, headers=of_peer, json=asked).json() == {"stream": None, "moved_to": None}
    for key in (*keys.values(), token(scope="process")):
        check_refused(client.post(OWN_STREAMS, headers=bearer(key) | {PEER_KEY: key}, json=asked), 403, "scope_missing")
    check_refused(client.get("/anything/new", headers=bearer(PEERS_KEY)), 403, "scope_missing")


def test_the_processes_of_a_server_do_not_wait_for_each_other(client):
    """They share one key, and ask for as many streams as clients come back to the wrong one."""
    told = {"token": "of-nobody", "by": 1, "is_resumed": True}
    of_peer = bearer(PEERS_KEY) | {PEER_KEY: PEERS_KEY}
    most = client.app_state["host"].settings.requests_per_min
    assert {client.put(OWN_STREAMS, headers=of_peer, json=told).status_code for _ in range(most + 1)} == {204}
    assert PEERS_KEY not in repr(ProcessPeers(0, (1,), PEERS_KEY))


def test_only_an_operator_is_told_why_a_server_is_not_ready(client, keys):
    readiness = client.app_state["host"].readiness
    here = from_address(client, "127.0.0.1")
    before, readiness.warm_up = readiness.warm_up, "failed"
    try:
        told = client.get("/readyz", headers=bearer(keys["admin"]))
        others = (client.get("/readyz", headers=bearer(keys["listen"])), here.get("/readyz"))
        outsider = client.get("/readyz")
    finally:
        readiness.warm_up = before
    for answer in (told, *others):
        assert (answer.status_code, answer.json()["code"]) == (503, "not_ready")
    assert {answer.json()["detail"] for answer in others} == {"the server is not ready"}
    assert told.json()["detail"] != "the server is not ready"
    check_refused(outsider, 401, "key_required")


# Files that change.


def test_a_file_that_becomes_unreadable_changes_nothing_and_is_told_once(tmp_path, caplog):
    file = tmp_path / "keys.json"
    key, _ = create_key(file, "", ["listen"], None)
    access = Access.of(Settings(keys_file=file))
    good = file.read_text()
    for harm in (lambda: file.write_text("{"), file.unlink):
        harm()
        with caplog.at_level("ERROR", access_module.__name__):
            caplog.clear()
            asyncio.run(access.refresh())
            asyncio.run(access.refresh())
        assert access.admit(key).scopes == {"listen"}
        assert len(caplog.records) == 1
        assert str(file) in caplog.text
    file.write_text(good.replace(key.split("_")[1], "0" * 12))
    asyncio.run(access.refresh())
    with pytest.raises(access_module.AccessError):
        access.admit(key)


def test_a_change_that_keeps_size_and_time_is_seen(tmp_path):
    """As a file that is replaced, in the way `nafir keys` and Kubernetes do it."""
    file, other = tmp_path / "keys.json", tmp_path / "new.json"
    (first, _), (second, _) = (create_key(each, "", ["listen"], None) for each in (file, other))
    access = Access.of(Settings(keys_file=file))
    stat = file.stat()
    os.utime(other, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    other.replace(file)
    asyncio.run(access.refresh())
    assert access.admit(second)
    with pytest.raises(access_module.AccessError, match="no such key"):
        access.admit(first)


def test_a_key_that_has_expired_or_changed_admits_nobody(tmp_path):
    file = tmp_path / "keys.json"
    key, _ = create_key(file, "", ["listen"], None)
    now_s = 1_000.0
    document = json.loads(file.read_text())
    document["keys"][0]["expires"] = "1970-01-01T00:20:00Z"
    file.write_text(json.dumps(document))
    access = Access(read_keys=lambda: access_module.ApiKeys.read(file), files=(file,), time_s=lambda: now_s)
    caller = access.admit(key)
    assert access.ending(caller) is None
    now_s = 1_200.0
    assert access.ending(caller) == "key_expired"
    with pytest.raises(access_module.AccessError, match="expired"):
        access.admit(key)
    now_s = 1_000.0
    document["keys"][0]["scopes"] = ["upload"]
    file.write_text(json.dumps(document))
    asyncio.run(access.refresh())
    assert access.ending(caller) == "key_revoked"


# Settings.


@pytest.fixture
def warnings_of_start(caplog):
    def start(**settings):
        with caplog.at_level("WARNING"):
            caplog.clear()
            create_app(Settings(**settings), scenes={})
        return caplog.text

    return start


def test_a_server_that_others_reach_without_a_key_warns(warnings_of_start, tmp_path):
    create_key(tmp_path / "keys.json", "", ["listen"], None)
    for host in ("0.0.0.0", "::", "192.168.0.5", "sound.example", ""):
        assert "anybody may use it" in warnings_of_start(host=host)
        assert warnings_of_start(host=host, keys_file=tmp_path / "keys.json") == ""
    for host in ("127.0.0.1", "localhost", "::1", "127.1.2.3"):
        assert warnings_of_start(host=host) == ""


def test_a_server_that_has_to_ask_for_keys_does_not_start_without(tmp_path):
    for host in ("127.0.0.1", "0.0.0.0"):
        with pytest.raises(NafirError, match="NAFIR_KEYS_FILE"):
            create_app(Settings(host=host, require_auth=True), scenes={})
    create_key(tmp_path / "keys.json", "", ["listen"], None)
    create_app(Settings(host="0.0.0.0", require_auth=True, keys_file=tmp_path / "keys.json"), scenes={})


def test_tokens_need_an_audience(tmp_path):
    with pytest.raises(NafirError, match="jwt_audience"):
        settings_of({"jwt_keys_file": tmp_path / "jwks.json"})


def test_a_server_without_a_page_shows_none(tmp_path):
    create_key(tmp_path / "keys.json", "", ["listen"], None)
    client = TestClient(create_app(Settings(page=False, keys_file=tmp_path / "keys.json"), scenes={}))
    for path in ("/", "/index.html", "/main.js"):
        assert client.get(path, headers={"Host": "localhost"}).status_code == 401
