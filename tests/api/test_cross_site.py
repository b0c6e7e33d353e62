"""Which pages may use the server, and under which names: RFC 6454, RFC 6761, the Fetch standard."""

import pytest
from pydantic import ValidationError
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.routing import Route, WebSocketRoute
from starlette.testclient import TestClient, WebSocketDenialResponse

from server.api.cross_site import CrossSiteGate, SitePolicy
from server.api.settings import Settings

LOOPBACK = Settings(allowed_hosts=(), host="127.0.0.1")
EVERYWHERE = Settings(allowed_hosts=(), host="0.0.0.0")


def status(settings, path="/v1/scenes", *, scheme="http", method="GET", **headers):
    given = Headers({name.replace("_", "-"): value for name, value in headers.items()})
    refusal = SitePolicy.of(settings).refusal(path, given, scheme=scheme, method=method)
    return 200 if refusal is None else refusal.status


@pytest.mark.parametrize(
    "host",
    ["localhost", "LOCALHOST:8000", "app.localhost:1", "127.0.0.1:8000", "127.9.9.9", "[::1]:80", "localhost."],
)
def test_a_server_of_this_machine_answers_to_the_names_of_this_machine(host):
    assert status(LOOPBACK, host=host) == 200


@pytest.mark.parametrize(
    "host",
    ["evil.example", "localhost.evil.example", "notlocalhost", "192.168.0.5:8000", "", "[::1", "127.0.0.1.nip"],
)
def test_a_server_of_this_machine_answers_to_no_other_name(host):
    assert status(LOOPBACK, host=host) == 421


def test_a_server_of_a_network_answers_to_addresses_and_to_names_that_it_was_given():
    assert status(EVERYWHERE, host="192.168.0.5:8000") == 200
    assert status(EVERYWHERE, host="nafir.example") == 421
    named = EVERYWHERE.model_copy(update={"allowed_hosts": ("Nafir.example",)})
    assert status(named, host="nafir.EXAMPLE:443") == 200
    assert status(named, host="evil.example") == 421
    assert status(EVERYWHERE.model_copy(update={"allowed_hosts": ("*",)}), host="evil.example") == 200


@pytest.mark.parametrize(
    ("origin", "expected"),
    [
        ("http://localhost:8000", 200),
        ("https://localhost:8000", 200),
        ("http://localhost", 403),
        ("http://localhost:3000", 403),
        ("https://evil.example", 403),
        ("https://localhost.evil.example:8000", 403),
        ("null", 403),
        ("", 403),
        ("file://", 403),
    ],
)
def test_only_the_servers_own_page_may_use_it(origin, expected):
    assert status(LOOPBACK, host="localhost:8000", origin=origin) == expected
    assert status(LOOPBACK, "/v1/stream", host="localhost:8000", origin=origin) == expected


@pytest.mark.parametrize("scheme", ["https", "wss"])
def test_a_page_that_came_without_tls_is_not_the_own_page_of_a_server_with_it(scheme):
    """RFC 6454, 5: the schemes of two origins that are the same are equal."""
    assert status(LOOPBACK, scheme=scheme, host="localhost", origin="https://localhost") == 200
    assert status(LOOPBACK, scheme=scheme, host="localhost", origin="http://localhost") == 403


def test_where_a_proxy_does_not_say_that_it_speaks_tls_the_browser_tells_pages_apart():
    """A browser says `same-origin` of a page of https://localhost alone, and `cross-site` of one of http://localhost."""
    page = {"host": "localhost", "origin": "http://localhost"}
    assert status(LOOPBACK, sec_fetch_site="same-origin", **page) == 200
    assert status(LOOPBACK, sec_fetch_site="cross-site", **page) == 403
    assert status(LOOPBACK, sec_fetch_site="same-site", **page) == 403


@pytest.mark.parametrize("name", [b"host", b"origin", b"sec-fetch-site"])
def test_what_decides_is_there_once(name):
    """RFC 9112, 3.2, of `Host`; of the others, too, two servers in a row could each believe another one."""
    good = {b"host": b"localhost", b"origin": b"http://localhost", b"sec-fetch-site": b"same-origin"}
    once = list(good.items())
    for second in (good[name], b"evil.example"):
        refusal = SitePolicy.of(LOOPBACK).refusal("/v1/scenes", Headers(raw=[*once, (name, second)]))
        assert (refusal.status, refusal.code) == (400, "doubled_header")
        assert refusal.detail.lower().startswith(name.decode())
    assert SitePolicy.of(LOOPBACK).refusal("/v1/scenes", Headers(raw=once)) is None


def test_a_port_that_is_not_told_is_the_schemes():
    assert status(LOOPBACK, host="localhost", origin="http://localhost:80") == 200
    assert status(LOOPBACK, host="localhost:443", origin="https://localhost") == 200


def test_a_site_that_was_named_may_use_it_and_others_may_not():
    settings = Settings(allowed_origins=("https://Game.example/",))
    assert status(settings, host="localhost", origin="https://game.example") == 200
    assert status(settings, host="localhost", origin="http://game.example") == 403
    assert status(settings, host="localhost", origin="https://game.example:8443") == 403


def test_pictures_in_pages_of_other_sites_cost_nothing_and_links_lead_to_the_page():
    foreign = {"host": "localhost", "sec_fetch_site": "cross-site"}
    assert status(LOOPBACK, "/v1/scenes/flat/loudness", **foreign) == 403
    assert status(LOOPBACK, "/metrics", **foreign) == 403
    assert status(LOOPBACK, "/metrics", host="localhost") == 200
    assert status(LOOPBACK, "/", **foreign) == 200
    assert status(LOOPBACK, "/v1/scenes", host="localhost", sec_fetch_site="same-origin") == 200


@pytest.mark.parametrize("method", ["POST", "DELETE", "PUT", "PATCH"])
def test_a_page_of_another_site_changes_nothing_also_where_its_browser_hides_the_origin(method):
    """A browser adds the key that it was given by HTTP Basic whichever page asks."""
    for path in ("/", "/v1/clips", "/anything/new"):
        for site, expected in (("cross-site", 403), ("same-site", 403), ("same-origin", 200), ("none", 200)):
            assert status(LOOPBACK, path, method=method, host="localhost", sec_fetch_site=site) == expected
        assert status(LOOPBACK, path, method=method, host="localhost") == 200


@pytest.fixture
def client():
    async def answer(_):
        return PlainTextResponse("heard", headers={"ETag": '"1"'})

    async def stream(websocket):
        await websocket.accept()
        await websocket.send_text("heard")
        await websocket.close()

    routes = [Route("/v1/scenes", answer), Route("/livez", answer), WebSocketRoute("/v1/stream", stream)]
    policy = SitePolicy.of(Settings(allowed_origins=("https://game.example",), allowed_hosts=()))
    app = CrossSiteGate(Starlette(routes=routes), policy=policy)
    return TestClient(app, base_url="http://localhost:8000")


def test_a_named_site_may_read_answers_with_their_tags(client):
    answer = client.get("/v1/scenes", headers={"Origin": "https://game.example"})
    assert answer.text == "heard"
    assert answer.headers["Access-Control-Allow-Origin"] == "https://game.example"
    assert "ETag" in answer.headers["Access-Control-Expose-Headers"]
    assert "Access-Control-Allow-Credentials" not in answer.headers
    asked = {"Origin": "https://game.example", "Access-Control-Request-Method": "GET"}
    assert client.options("/v1/scenes", headers=asked).status_code == 200


@pytest.mark.parametrize(
    "asked",
    [
        {"Access-Control-Request-Method": "PATCH"},
        {"Access-Control-Request-Method": "GET", "Access-Control-Request-Headers": "X-Own"},
    ],
)
def test_a_refused_preflight_is_a_problem_document(client, asked):
    answer = client.options("/v1/scenes", headers={"Origin": "https://game.example", **asked})
    assert answer.status_code == 400
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert answer.json()["code"] == "preflight_refused"
    assert "If-None-Match" in answer.json()["detail"]
    # So that the page's author reads it in place of "failed to fetch".
    assert answer.headers["Access-Control-Allow-Origin"] == "https://game.example"


def test_answers_depend_on_who_asks(client):
    assert "Origin" in client.get("/v1/scenes").headers["Vary"]


def test_a_refusal_is_a_problem_document_that_names_the_setting(client):
    for headers, code, name in (
        ({"Origin": "https://evil.example"}, 403, "NAFIR_ALLOWED_ORIGINS"),
        ({"Host": "evil.example"}, 421, "NAFIR_ALLOWED_HOSTS"),
    ):
        answer = client.get("/v1/scenes", headers=headers)
        assert answer.status_code == code
        assert answer.headers["Content-Type"] == "application/problem+json"
        assert name in answer.json()["detail"]
        assert "Access-Control-Allow-Origin" not in answer.headers
        assert client.get("/livez", headers=headers).status_code == 200


def test_a_stream_is_refused_before_it_opens_with_a_problem_document(client):
    for headers, status_code, code in (
        ({"Origin": "https://evil.example"}, 403, "origin_not_allowed"),
        ({"Host": "evil.example"}, 421, "host_not_allowed"),
    ):
        with (
            pytest.raises(WebSocketDenialResponse) as refused,
            client.websocket_connect("ws://localhost:8000/v1/stream", headers=headers),
        ):
            pass
        assert refused.value.status_code == status_code
        assert refused.value.headers["Content-Type"] == "application/problem+json"
        assert refused.value.json()["code"] == code
    with client.websocket_connect(
        "ws://localhost:8000/v1/stream", headers={"Origin": "https://game.example"}
    ) as stream:
        assert stream.receive_text() == "heard"


@pytest.mark.parametrize("origin", ["*", "game.example", "https://game.example/page", "https://*.example"])
def test_an_origin_is_a_scheme_and_a_host(origin):
    with pytest.raises(ValidationError, match="is no origin"):
        Settings(allowed_origins=(origin,))
