import gc
import io
import json
import logging
import secrets
import sys
import weakref

import numpy as np
import pytest

from server.api.api_keys import random_key
from server.runtime.logs import (
    LEFT_OUT,
    OF_SEVERAL_KINDS,
    BoundedHandler,
    about,
    begin_about,
    configure_logs,
    formatter,
    hide,
)
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


@pytest.fixture
def bounded():
    """A logger that writes three lines of a kind a minute, what it has written, and its clock."""
    stream, clock = io.StringIO(), [0.0]
    handler = BoundedHandler(stream, most_per_min=3, time_s=lambda: clock[0])
    handler.setFormatter(formatter("json"))
    logger = logging.getLogger("server.some.bounded")
    logger.propagate = False
    logger.setLevel("INFO")
    logger.handlers[:] = [handler]

    def written():
        lines = [json.loads(line) for line in stream.getvalue().splitlines()]
        stream.seek(0)
        stream.truncate()
        return lines

    begin_about()
    yield logger, written, clock
    begin_about()
    logger.handlers.clear()


def refuse(log, code, times=1):
    for number in range(times):
        log.info("request", extra={"status": 400, "code": code, "path": f"/{number}"})


def test_lines_of_one_reason_are_bounded_and_counted_and_others_are_written(bounded):
    log, written, clock = bounded
    refuse(log, "malformed_request", 1_000)
    refuse(log, "doubled_header", 3)
    for _ in range(9):
        log.info("stream not opened", extra={"reason": "server_busy"})
    log.warning("another matter")
    said = [line for line in written() if line.get("reason") is None]
    assert [line.get("path") for line in said] == ["/0", "/1", "/2", "/0", "/1", "/2", None]
    clock[0] = 59.9
    refuse(log, "malformed_request", 5)
    assert written() == []
    clock[0] = 60.0
    begin_about(request_id="of the next request")
    log.info("next")
    summary, of_streams, following = written()
    assert (of_streams["line"], of_streams["reason"], of_streams["lines"]) == ("stream not opened", "server_busy", 6)
    del summary["timestamp"]
    assert summary == {
        "event": LEFT_OUT,
        "line": "request",
        "status": 400,
        "code": "malformed_request",
        "lines": 1_002,
        "level": "info",
        "logger": "server.some.bounded",
    }
    assert following["request_id"] == "of the next request"
    refuse(log, "malformed_request", 4)
    assert len(written()) == 3  # a new minute


def test_every_line_is_written_or_counted_however_they_come(bounded):
    log, written, clock = bounded
    random = np.random.default_rng(0)
    came = 3_000
    for _ in range(came):
        clock[0] += random.exponential(1.0)
        refuse(log, f"code_{random.integers(20)}")
    log.handlers[0].close()
    said = written()
    summaries = [line for line in said if line["event"] == LEFT_OUT]
    assert sum(line["lines"] for line in summaries) + len(said) - len(summaries) == came
    assert len(said) - len(summaries) <= 20 * 3 * (clock[0] / 60 + 1)


def test_kinds_of_lines_take_no_memory_without_bound(bounded):
    log, written, _ = bounded
    for number in range(10_000):
        log.warning(f"a line of its own: {number}")  # noqa: G004  that is the case
    assert len(log.handlers[0]._windows) <= 257
    log.handlers[0].close()
    *lines, summary = written()
    assert len(lines) == 256 + 15
    assert (summary["event"], summary["line"], summary["lines"]) == (LEFT_OUT, OF_SEVERAL_KINDS, 10_000 - len(lines))


def test_lines_of_all_kinds_together_are_bounded_and_hide_no_warning(bounded):
    log, written, clock = bounded
    for status in range(400, 600):
        log.info("request", extra={"status": status})
    log.warning("a warning")
    log.error("an error")
    *requests, warning, error = written()
    assert len(requests) == 15
    assert (warning["event"], error["event"]) == ("a warning", "an error")
    clock[0] = 60.0
    log.info("next")
    summary, following = written()
    assert (summary["line"], summary["lines"], following["event"]) == (OF_SEVERAL_KINDS, 185, "next")


def test_an_error_is_written_whatever_came_before_it(bounded):
    log, written, clock = bounded
    for number in range(1_000):
        log.info(f"a line of its own: {number}")  # noqa: G004  that is the case
    written()
    for number in range(5):
        log.error(f"failed: {number}")  # noqa: G004  that is the case
    assert [line["event"] for line in written()] == [f"failed: {number}" for number in range(5)]
    clock[0] = 60.0
    refuse(log, "map_too_fine", 10)  # kinds of an earlier minute take no room
    assert [line.get("line", line["event"]) for line in written()] == [OF_SEVERAL_KINDS, *["request"] * 3]
    log.handlers[0].close()
    (summary,) = written()
    assert (summary["line"], summary["code"], summary["lines"]) == ("request", "map_too_fine", 7)


def test_a_line_that_is_left_out_keeps_nothing_alive(bounded):
    log, _, _ = bounded

    class HeavyError(Exception):
        pass

    def fail():
        failure = HeavyError()
        try:
            raise failure
        except HeavyError:
            handler = log.handlers[0]  # alone: pytest's own keeps what it has seen
            handler.handle(log.makeRecord(log.name, logging.ERROR, "", 0, "failed", (), sys.exc_info()))
        return weakref.ref(failure)

    references = [fail() for _ in range(5)]
    gc.collect()
    assert [reference() for reference in references] == [None] * 5


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
        configure_logs("json", "info", stream=second, lines_per_min=2)
        logging.getLogger("server.test").debug("unimportant")
        for _ in range(3):
            logging.getLogger("server.test").info("important")
        logging.getLogger("uvicorn.error").info("< Authorization: Bearer x")
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)
    assert first.getvalue() == ""
    assert [json.loads(line)["event"] for line in second.getvalue().splitlines()] == ["important"] * 2
