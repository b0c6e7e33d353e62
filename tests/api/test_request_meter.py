"""What is too much is noticed as soon as it comes, in whatever pieces, and nothing else is."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from server.api.connection_limits import ConnectionLimits
from server.api.problems import Refusal
from server.api.request_meter import Measured, RequestMeter
from server.api.settings import Settings

LIMITS = dataclasses.replace(
    ConnectionLimits.of(Settings()),
    max_request_line_bytes=100,
    max_header_bytes=80,
    max_headers_bytes=400,
    max_headers=10,
    max_body_bytes=50,
)


def measured(*pieces, limits=LIMITS):
    """What goes to the parser and what is left, or the refusal."""
    meter = RequestMeter(limits)
    parsed, rest = b"", b""
    for piece in pieces:
        if meter.has_head:
            rest += piece
            continue
        verdict = meter.measure(piece)
        if isinstance(verdict, Refusal):
            return verdict
        parsed += verdict.part
        rest += verdict.rest
    return meter.has_head, parsed, rest


def in_pieces(data, size):
    return [data[at : at + size] for at in range(0, len(data), size)]


def head(line=b"GET / HTTP/1.1", headers=(b"Host: localhost",)):
    return b"".join(part + b"\r\n" for part in (line, *headers)) + b"\r\n"


@pytest.mark.parametrize("size", [1, 2, 3, 7, 1000])
def test_a_head_ends_at_its_empty_line_whatever_pieces_it_comes_in(size):
    assert measured(*in_pieces(head() + b"GET /next", size)) == (True, head(), b"GET /next")


@given(st.lists(st.integers(1, 60)))
def test_cuts_make_no_difference(sizes):
    data = head(headers=[b"a: " + b"x" * number for number in range(8)]) + b"rest"
    pieces, at = [], 0
    for size in sizes:
        pieces.append(data[at : at + size])
        at += size
    assert measured(*pieces, data[at:]) == measured(data)


def line_of(length):
    """With its line end."""
    return b"GET /" + b"a" * (length - len("GET / HTTP/1.1\r\n")) + b" HTTP/1.1"


HEADER = b"name: " + b"x" * (80 - len("name: \r"))


@pytest.mark.parametrize("size", [1, 13, 10_000])
@pytest.mark.parametrize(
    ("fits", "too_much", "status", "code"),
    [
        (head(line=line_of(100)), head(line=line_of(102)), 414, "request_line_too_long"),
        (head(headers=[HEADER]), head(headers=[HEADER + b"x"]), 431, "header_too_long"),
        (head(headers=[b"a: b"] * 10), head(headers=[b"a: b"] * 11), 431, "too_many_headers"),
        (head(headers=[HEADER] * 4), head(headers=[HEADER] * 5), 431, "headers_too_long"),
    ],
)
def test_at_the_limit_passes_and_beyond_it_is_refused(size, fits, too_much, status, code):
    assert measured(*in_pieces(fits, size)) == (True, fits, b"")
    refusal = measured(*in_pieces(too_much, size))
    assert (refusal.status, refusal.code) == (status, code)


@pytest.mark.parametrize(
    ("begin", "code"),
    [
        (b"GET /", "request_line_too_long"),
        (b"", "request_line_too_long"),
        (b"GET / HTTP/1.1\r\nname: ", "header_too_long"),
    ],
)
def test_what_never_ends_is_refused_at_the_limit(begin, code):
    """And not when it has come to an end: of each piece at most the limit was let through."""
    meter = RequestMeter(LIMITS)
    let_through = 0
    verdict = meter.measure(begin)
    while isinstance(verdict, Measured):
        let_through += len(verdict.part)
        verdict = meter.measure(b"aaa")
    assert verdict.code == code
    assert let_through <= len(begin) + 102


def test_empty_lines_that_never_end_are_a_request_line_too_long():
    refusal = measured(*[b"\r\n"] * 60)
    assert refusal.code == "request_line_too_long"


def test_a_few_empty_lines_before_a_request_are_none_of_it():
    assert measured(b"\r\n\r\n" + head()) == (True, b"\r\n\r\n" + head(), b"")


def body_meter(length):
    meter = RequestMeter(LIMITS)
    assert meter.measure(head()).rest == b""
    return meter, meter.expect_body(length)


def test_a_body_of_known_length_ends_where_it_says():
    meter, refusal = body_meter(5)
    assert refusal is None
    assert meter.measure(b"ab") == Measured(b"ab", b"")
    assert not meter.has_body
    assert meter.measure(b"cdeGET /") == Measured(b"cde", b"GET /")
    assert meter.has_body


def test_a_body_that_says_that_it_is_too_large_is_refused_before_it_comes():
    assert body_meter(50)[1] is None
    refusal = body_meter(51)[1]
    assert (refusal.status, refusal.code) == (413, "body_too_large")


def test_chunks_are_counted_with_their_framing():
    meter, refusal = body_meter(None)
    assert refusal is None
    for _ in range(50):
        assert isinstance(meter.measure(b"1"), Measured)
    assert meter.measure(b"1").status == 413


def test_each_request_is_measured_anew():
    meter, _ = body_meter(5)
    meter.measure(b"abcde")
    assert not meter.is_fresh
    meter.begin()
    assert meter.is_fresh
    assert meter.measure(head(line=line_of(100))) == Measured(head(line=line_of(100)), b"")
