"""A port is had before anything else happens."""

import socket

import pytest

from server.api.listeners import bind, url_of
from server.core.errors import NafirError


def closed(listeners):
    for listener in listeners:
        listener.close()


def test_a_port_is_bound_and_answers_before_anything_is_loaded():
    (listener,) = listeners = bind("127.0.0.1", 0)
    try:
        host, port = listener.getsockname()
        assert url_of(listener, host) == f"http://127.0.0.1:{port}"
        assert port
        socket.create_connection((host, port), timeout=5).close()
    finally:
        closed(listeners)


def test_a_port_in_use_is_refused_at_once_even_by_one_who_has_only_bound_it():
    listeners = bind("127.0.0.1", 0)
    try:
        port = listeners[0].getsockname()[1]
        with pytest.raises(NafirError, match=rf"port.*127\.0\.0\.1:{port}.*--port"):
            bind("127.0.0.1", port)
    finally:
        closed(listeners)
    closed(bind("127.0.0.1", port))  # and nothing of it stays behind


def test_a_name_of_several_addresses_has_one_port_on_all():
    listeners = bind("localhost", 0)
    try:
        assert len({listener.getsockname()[1] for listener in listeners}) == 1
        assert len({listener.family for listener in listeners}) == len(listeners)
    finally:
        closed(listeners)


@pytest.mark.parametrize("host", ["no.such.host.invalid", "192.0.2.1", "not a host"])
def test_an_address_that_is_not_of_this_machine_is_refused(host):
    with pytest.raises(NafirError, match=r"host|port"):
        bind(host, 0)


@pytest.mark.skipif(not socket.has_ipv6, reason="no IPv6")
def test_an_address_of_ipv6_is_shown_as_urls_have_it():
    try:
        listeners = bind("::1", 0)
    except NafirError:
        pytest.skip("no IPv6 on the loopback interface")
    try:
        assert url_of(listeners[0], "::1") == f"http://[::1]:{listeners[0].getsockname()[1]}"
    finally:
        closed(listeners)
