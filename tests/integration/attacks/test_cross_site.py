"""Pages of other sites, as a visitor's browser sends their requests."""

import http.client
import socket

import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect


def ask(address, path, **headers):
    connection = http.client.HTTPConnection(address, timeout=10)
    try:
        connection.putrequest("GET", path, skip_host=True)
        for name, value in {"Host": address, **headers}.items():
            connection.putheader(name.replace("_", "-"), value)
        connection.endheaders()
        return connection.getresponse().status
    finally:
        connection.close()


def address_of(served):
    host, _, port = served.partition(":")
    return host, int(port)


def test_a_page_of_another_site_may_neither_ask_nor_listen(served):
    evil = "https://evil.example"
    assert ask(served, "/v1/scenes") == 200
    assert ask(served, "/v1/scenes", Origin=f"http://{served}") == 200
    assert ask(served, "/v1/scenes", Origin=evil) == 403
    assert ask(served, "/v1/scenes", Sec_Fetch_Site="cross-site") == 403
    with pytest.raises(InvalidStatus) as refused, connect(f"ws://{served}/v1/stream", origin=evil):
        pass
    assert refused.value.response.status_code == 403
    with connect(f"ws://{served}/v1/stream", origin=f"http://{served}"):
        pass


def test_a_name_that_was_pointed_here_is_not_answered_to(served):
    assert ask(served, "/v1/scenes", Host="evil.example") == 421
    assert ask(served, "/livez", Host="evil.example") == 200
    dialled = socket.create_connection(address_of(served))
    with pytest.raises(InvalidStatus) as refused, connect("ws://evil.example/v1/stream", sock=dialled):
        pass
    assert refused.value.response.status_code == 403
