import base64
import math

import pytest
import uvicorn
from hypothesis import given, settings
from hypothesis import strategies as st
from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse
from starlette.routing import Route, WebSocketRoute
from starlette.testclient import TestClient, WebSocketDenialResponse

from server.api.api_keys import create_key
from server.api.app import create_app
from server.api.rate_limits import Buckets, Rate, RateGate, RateLimits, address_of
from server.api.serving import uvicorn_options
from server.api.settings import Settings


@settings(max_examples=50)
@given(
    st.integers(1, 50),
    st.floats(0.5, 100),
    st.lists(st.tuples(st.floats(0, 20), st.integers(1, 10)), min_size=1, max_size=40),
)
def test_a_bucket_is_that_of_the_textbook(amount, period_s, asked):
    """A second way to the same: the level is kept and filled up to the brim before each try."""
    buckets, level, before_s, now_s = Buckets(Rate(amount, period_s)), float(amount), 0.0, 0.0
    for pause_s, wanted in asked:
        now_s += pause_s
        level = min(amount, level + (now_s - before_s) * amount / period_s)
        before_s = now_s
        wait_s = buckets.wait_s("a", wanted, now_s)
        expected_s = max(0.0, (wanted - level) * period_s / amount)
        assert wait_s == pytest.approx(expected_s, abs=1e-6 * period_s)
        if wait_s == 0:
            buckets.take("a", wanted, now_s)
            level -= wanted


@settings(max_examples=10)
@given(st.lists(st.floats(0, 1), min_size=200, max_size=200))
def test_no_minute_has_more_than_twice_the_amount(pauses):
    buckets, now_s, granted = Buckets(Rate(20, 60.0)), 0.0, []
    for pause_s in pauses:
        now_s += pause_s
        if not buckets.wait_s("a", 1, now_s):
            buckets.take("a", 1, now_s)
            granted.append(now_s)
    for start_s in granted:
        assert sum(start_s <= each < start_s + 60.0 for each in granted) <= 40


def test_whoever_waits_as_told_is_let_in():
    buckets = Buckets(Rate(3, 60.0))
    for _ in range(3):
        buckets.take("a", 1, 100.0)
    wait_s = buckets.wait_s("a", 1, 100.0)
    assert wait_s == pytest.approx(20.0)
    assert buckets.wait_s("a", 1, 100.0 + math.ceil(wait_s)) == 0
    assert buckets.wait_s("a", 1, 119.0) > 0
    assert buckets.wait_s("b", 1, 100.0) == 0


def test_buckets_are_forgotten_when_they_are_full_and_never_too_many():
    buckets = Buckets(Rate(10, 60.0), most=100)
    for number in range(1_000):
        buckets.take(f"client {number}", 10, 0.0)
        assert len(buckets) <= 100
    buckets.take("a late one", 1, 1_000.0)
    assert len(buckets) == 1


@pytest.mark.parametrize(
    ("client", "actor"),
    [
        (("203.0.113.7", 1), "address 203.0.113.7"),
        (("::ffff:203.0.113.7", 1), "address 203.0.113.7"),
        (("2001:db8::7", 1), "address 2001:db8::/64"),
        (("127.0.0.1", 1), None),
        (("::1", 1), None),
        (("::ffff:127.0.0.1", 1), None),
        (("a unix socket", 1), None),
        (None, None),
    ],
)
def test_an_address_is_one_actor_and_this_machine_none(client, actor):
    assert address_of({"client": client}) == actor


class Clock:
    now_s = 0.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def client(clock):
    """Of a server with two requests, one stream and 1,000 bytes; who asks is told by a header."""

    async def answer(request):
        return PlainTextResponse(str(len(await request.body())))

    async def stream(websocket):
        await websocket.accept()
        await websocket.close()

    routes = [
        *(Route(path, answer) for path in ("/livez", "/v1/scenes")),
        Route("/v1/clips", answer, methods=["POST"]),
        WebSocketRoute("/v1/stream", stream),
    ]
    rates = {"request": Rate(2, 60.0), "stream": Rate(1, 60.0), "upload": Rate(1_000, 3600.0)}
    limits = RateLimits(rates, time_s=clock)
    return TestClient(
        RateGate(
            Starlette(routes=routes),
            limits=limits,
            actor=lambda scope: Headers(scope=scope).get("who"),
            open_paths=("/livez",),
        )
    )


def check_refused(answer, retry_after_s):
    assert answer.status_code == 429
    assert answer.headers["Content-Type"] == "application/problem+json"
    assert answer.headers["Retry-After"] == str(retry_after_s)
    assert answer.json()["code"] == "too_many_requests"


def test_requests_of_one_actor_are_refused_and_others_go_on(client, clock):
    one, other = {"who": "one"}, {"who": "other"}
    assert [client.get("/v1/scenes", headers=one).status_code for _ in range(2)] == [200, 200]
    check_refused(client.get("/v1/scenes", headers=one), 30)
    assert client.get("/v1/scenes", headers=other).status_code == 200
    assert client.get("/v1/scenes").status_code == 200
    assert client.get("/livez", headers=one).status_code == 200
    clock.now_s = 30
    assert client.get("/v1/scenes", headers=one).status_code == 200
    check_refused(client.get("/v1/scenes", headers=one), 30)


def test_streams_are_counted_apart(client):
    one = {"who": "one"}
    with client.websocket_connect("/v1/stream", headers=one):
        pass
    with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect("/v1/stream", headers=one):
        pass
    check_refused(refused.value, 60)
    assert client.get("/v1/scenes", headers=one).status_code == 200


def test_uploads_are_counted_by_what_came(client, clock):
    one = {"who": "one"}

    def chunks():
        yield from [b"x" * 1_000, b"x" * 500]

    assert client.post("/v1/clips", content=chunks(), headers=one).text == "1500"
    clock.now_s = 60
    check_refused(client.post("/v1/clips", content=b"x", headers=one), 1740)  # 500 bytes too many are 1,800 s
    clock.now_s = 1_800
    assert client.post("/v1/clips", content=b"x", headers=one).status_code == 200
    assert client.post("/v1/clips", content=b"x", headers={"who": "other"}).status_code == 200


def test_no_limit_is_no_limit():
    limits = RateLimits({"request": Rate(0, 60.0)})
    assert all(limits.refusal("request", "a") is None for _ in range(100))


def test_a_server_limits_addresses_before_it_looks_at_keys_and_each_key_on_any_address(tmp_path):
    key, _ = create_key(tmp_path / "keys.json", "", ["listen"], None)
    limited = Settings(host="0.0.0.0", keys_file=tmp_path / "keys.json", requests_per_min=3)
    app = create_app(limited, scenes={})

    def statuses(address, headers, times, path="/v1/scenes"):
        client = TestClient(app, base_url="http://192.0.2.1", client=(address, 1), raise_server_exceptions=False)
        return [client.post(path, headers=headers).status_code for _ in range(times)]

    good = {"Authorization": f"Bearer {key}"}
    guesses = {"Authorization": "Bearer nafir_000000000000_guess"}
    assert statuses("203.0.113.1", guesses, 5) == [401, 401, 401, 429, 429]
    assert statuses("203.0.113.2", good, 2) == [403, 403]
    by_password = {"Authorization": f"Basic {base64.b64encode(b'x:nafir_000000000000_guess').decode()}"}
    for number, path in enumerate(("/", "/main.js", "/readyz", "/openapi.json", "/v1/scenes")):
        assert statuses(f"203.0.113.{10 + number}", by_password, 5, path) == [401, 401, 401, 429, 429]
    assert statuses("203.0.113.20", by_password, 5, "/livez") == [405] * 5
    assert statuses("127.0.0.1", guesses, 5) == [401] * 5  # this machine, or a proxy on it
    other, _ = create_key(tmp_path / "keys.json", "", ["admin"], None)
    app = create_app(limited, scenes={})
    good = {"Authorization": f"Bearer {other}"}
    assert statuses("127.0.0.1", good, 2) == [405, 405]
    assert statuses("203.0.113.3", good, 2) == [405, 429]


@pytest.fixture
def behind_proxy(monkeypatch):
    """The address that a request counts for, by the address that it comes from and those that it names as forwarded,
    as `nafir serve` runs the application and trusts 10.213.7.0/28."""
    monkeypatch.setenv("FORWARDED_ALLOW_IPS", "10.213.7.0/28")

    async def tell(request):
        return PlainTextResponse(str(address_of(request.scope)))

    config = uvicorn.Config(Starlette(routes=[Route("/", tell)]), **uvicorn_options(Settings()))
    config.load()

    def ask(peer, *forwarded):
        headers = [("X-Forwarded-For", each) for each in forwarded]
        return TestClient(config.loaded_app, client=(peer, 50_000)).get("/", headers=headers).text

    return ask


@pytest.mark.parametrize(
    ("peer", "forwarded", "actor"),
    [
        ("10.213.7.2", ["203.0.113.7"], "address 203.0.113.7"),
        ("10.213.7.2", ["203.0.113.8"], "address 203.0.113.8"),
        ("10.213.7.2", ["2001:db8:1:2::7"], "address 2001:db8:1:2::/64"),
        ("10.213.7.2", [], "address 10.213.7.2"),
        # What a client has written comes before what its proxy has added, in one header or in two.
        ("10.213.7.2", ["127.0.0.1, 203.0.113.7"], "address 203.0.113.7"),
        ("10.213.7.2", ["127.0.0.1", "203.0.113.7"], "address 203.0.113.7"),
        ("10.213.7.2", ["203.0.113.7, 10.213.7.3"], "address 203.0.113.7"),
        # Nobody else is believed, on a network beside it either.
        ("203.0.113.9", ["203.0.113.7"], "address 203.0.113.9"),
        ("10.213.7.16", ["127.0.0.1"], "address 10.213.7.16"),
    ],
)
def test_a_trusted_proxy_tells_whose_request_it_is_and_nobody_else_does(behind_proxy, peer, forwarded, actor):
    assert behind_proxy(peer, *forwarded) == actor
