import io
import json
import logging
import secrets

import pytest

from server.api.api_keys import random_key
from server.runtime.logs import about, begin_about, configure_logs, formatter, hide
from tests.api.token_keys import token


@pytest.fixture
def written():
    """Logs through a handler of one form; returns what it wrote."""

    def write(form, log):
        stream = io.StringIO()
        handler = logging.StreamHandler(stream)
        handler.setFormatter(formatter(form))
        logger.handlers[:] = [handler]
        log(logger)
        return stream.getvalue()

    logger = logging.getLogger("server.some.module")
    logger.propagate = False
    logger.setLevel("INFO")
    begin_about()
    yield write
    begin_about()
    logger.handlers.clear()


def fail():
    secret = f"Bearer {random_key()[0]}"
    raise ValueError(f"no use for {secret}")


def test_a_line_of_json_says_what_when_where_and_about_what(written):
    begin_about(request_id="abc")
    about(session="def")
    line = written("json", lambda log: log.warning("block %d is late", 3, extra={"late_ms": 2.5}))
    said = json.loads(line)
    assert said.pop("timestamp").endswith("Z")
    assert said == {
        "event": "block 3 is late",
        "level": "warning",
        "logger": "server.some.module",
        "late_ms": 2.5,
        "request_id": "abc",
        "session": "def",
    }
    begin_about(request_id="ghi")
    assert "session" not in json.loads(written("json", lambda log: log.info("next")))


@pytest.mark.parametrize("form", ["json", "console"])
def test_what_cannot_be_written_is_written_all_the_same(written, form):
    odd = {"path": "/a\nINFO forged", "thing": object(), "bytes": b"\xff", "text": "\ud800"}
    line = written(form, lambda log: log.info("odd", extra=odd))
    assert line.count("\n") == 1
    assert "/a\\nINFO forged" in line


def traced(log):
    try:
        fail()
    except ValueError:
        log.exception("failed")


@pytest.mark.parametrize("form", ["json", "console"])
def test_a_traceback_says_where_and_shows_no_values(written, form):
    text = written(form, traced)
    assert "no use for Bearer ***" in text
    assert "in fail" in text
    assert "secret =" not in text.replace("secret = f", "")
    assert form == "console" or text.count("\n") == 1


def secrets_in_many_forms():
    key, identifier = random_key()
    secret = key.removeprefix(f"nafir_{identifier}_")
    jwt = token("RS256")
    word = secrets.token_hex(16)
    return [
        (key, secret),
        (f"the key {key!r} is bad", secret),
        (f"/v1/scenes?key={key}&x=1", secret),
        (str({"headers": [(b"authorization", f"Bearer {key}".encode())]}), secret),
        (jwt, jwt.split(".")[2]),
        (f"/v1/stream?token={jwt}", jwt.split(".")[2]),
        (f"Bearer {word}", word),
        (f"authorization: Basic {word}", word),
        (f"Authorization: {word}", word),
        (f'"Authorization": "Digest {word}"', word),
        (f"(b'sec-websocket-protocol', b'nafir.v3, nafir.key.{word}')", word),
        (f"< Sec-WebSocket-Protocol: {word}", word),
        (f"nafir.key.{word}", word),
    ]


def test_keys_and_tokens_are_blotted_out():
    for text, secret in secrets_in_many_forms():
        assert secret in text
        assert secret not in hide(text), text
        assert "***" in hide(text)


def test_other_text_stays_as_it_is():
    for text in ("", "nafir_keys", "the bearer of news", "GET /v1/scenes 200", "eyes.only.here", "key 0123456789ab"):
        assert hide(text) == text
    assert hide("nafir_0123456789ab_secret") == "nafir_0123456789ab_***"


def test_a_second_configuration_replaces_the_first_and_libraries_are_quiet(monkeypatch):
    root = logging.getLogger()
    monkeypatch.setattr(root, "handlers", [*root.handlers])
    before = {
        name: logging.getLogger(name).level for name in ("", "uvicorn", "uvicorn.access", "websockets", "asyncio")
    }
    first, second = io.StringIO(), io.StringIO()
    try:
        configure_logs("json", "debug", stream=first)
        configure_logs("json", "info", stream=second)
        logging.getLogger("server.test").debug("unimportant")
        logging.getLogger("server.test").info("important")
        logging.getLogger("uvicorn.error").info("< Authorization: Bearer x")
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)
    assert first.getvalue() == ""
    assert [json.loads(line)["event"] for line in second.getvalue().splitlines()] == ["important"]
