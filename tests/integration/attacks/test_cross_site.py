"""Pages of other sites, as a visitor's browser sends their requests."""

import http.client
import json
import socket

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

pytestmark = pytest.mark.untimed


def ask(address, path, *, method="GET", **headers):
    connection = http.client.HTTPConnection(address, timeout=10)
    try:
        connection.putrequest(method, path, skip_host=True)
        for name, value in {"Host": address, **headers}.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        return connection.getresponse().status
    finally:
        connection.close()


def address_of(served):
    host, _, port = served.partition(":")
    return host, int(port)


def assert_refused(response, status, code):
    assert response.status_code == status
    assert response.headers["Content-Type"] == "application/problem+json"
    assert json.loads(response.body)["code"] == code


def test_a_page_of_another_site_may_neither_ask_nor_listen(served):
    evil = "https://evil.example"
    assert ask(served, "/v1/scenes") == 200
    assert ask(served, "/v1/scenes", Origin=f"http://{served}") == 200
    assert ask(served, "/v1/scenes", Origin=evil) == 403
    assert ask(served, "/v1/scenes", Sec_Fetch_Site="cross-site") == 403
    for method in ("POST", "DELETE"):
        for site in ("cross-site", "same-site"):
            assert ask(served, "/v1/clips/x", method=method, Sec_Fetch_Site=site) == 403
            assert ask(served, "/", method=method, Sec_Fetch_Site=site) == 403
    with pytest.raises(InvalidStatus) as refused, connect(f"ws://{served}/v1/stream", origin=evil):
        pass
    assert_refused(refused.value.response, 403, "origin_not_allowed")
    with connect(f"ws://{served}/v1/stream", origin=f"http://{served}"):
        pass


def test_a_name_that_was_pointed_here_is_not_answered_to(served):
    assert ask(served, "/v1/scenes", Host="evil.example") == 421
    assert ask(served, "/livez", Host="evil.example") == 200
    dialled = socket.create_connection(address_of(served))
    with pytest.raises(InvalidStatus) as refused, connect("ws://evil.example/v1/stream", sock=dialled):
        pass
    assert_refused(refused.value.response, 421, "host_not_allowed")


@pytest.mark.parametrize("upgrade", ["", "Upgrade: websocket\r\nConnection: Upgrade\r\n"], ids=["http", "websocket"])
def test_a_good_name_does_not_cover_a_bad_one(served, upgrade):
    """RFC 9112, 3.2: a request with two `Host` is answered 400, whichever comes first."""
    keys = "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
    for hosts in ((served, "evil.example"), ("evil.example", served)):
        lines = "".join(f"Host: {host}\r\n" for host in hosts)
        path = "/v1/stream" if upgrade else "/v1/scenes"
        with socket.create_connection(address_of(served), timeout=10) as dialled:
            dialled.sendall(f"GET {path} HTTP/1.1\r\n{lines}{upgrade}{keys}\r\n".encode())
            assert dialled.recv(4_096).startswith(b"HTTP/1.1 400 ")
