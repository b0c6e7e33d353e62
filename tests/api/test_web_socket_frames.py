"""Cutting what a client sends changes nothing of it, and finds the messages that the library's parser finds."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode
from websockets.protocol import Protocol, Side

from server.api.web_socket_frames import FrameSplitter, header

LENGTHS = st.sampled_from([0, 1, 5, 36, 125, 126, 300, 65_535, 65_536])
FRAMES = st.builds(
    Frame,
    st.sampled_from([Opcode.TEXT, Opcode.BINARY, Opcode.CONT, Opcode.PING, Opcode.PONG]),
    LENGTHS.map(lambda length: bytes(range(1, 128)) * (length // 127) + bytes(range(length % 127))),
    fin=st.booleans(),
    rsv1=st.sampled_from([False, False, False, True]),
)


def whole_messages(frames):
    """Those that came in one frame, as the standard has it: not those that a frame without an end came before."""
    is_fragmented = False
    for frame in frames:
        if frame.opcode in {Opcode.PING, Opcode.PONG}:
            continue
        if not is_fragmented and frame.opcode is not Opcode.CONT and frame.fin and not frame.rsv1:
            yield frame
        is_fragmented = not frame.fin


def sent(frames):
    """By a client that heeds neither what an extension's bits mean nor which frames may be cut."""
    return b"".join(_sent_as(frame.opcode | 0x80 * frame.fin | 0x40 * frame.rsv1, frame.data) for frame in frames)


def _sent_as(first, data):
    return bytes([first]) + Frame(Opcode.BINARY, data).serialize(mask=True)[1:]


@given(st.lists(FRAMES, max_size=6), st.lists(st.integers(0, 200_000), max_size=8))
def test_all_that_came_goes_on_in_order(frames, borders):
    """Wherever it was cut on the way, and but for what waits for its end."""
    data, splitter = sent(frames), FrameSplitter(1 << 20)
    borders = sorted(border % (len(data) + 1) for border in borders)
    pieces = [data[start:end] for start, end in zip([0, *borders], [*borders, len(data)], strict=True)]
    received = [each for piece in pieces for each in splitter.split(piece)]
    assert b"".join(each.raw for each in received) == data
    found = [(each.message, each.is_text) for each in received if each.message is not None]
    expected = [(frame.data, frame.opcode is Opcode.TEXT) for frame in whole_messages(frames)]
    at = 0
    for message in found:  # long ones are whole only where they came in one piece
        at = expected.index(message, at) + 1
    short = [message for message in expected if len(message[0]) < 126]
    assert [message for message in found if len(message[0]) < 126] == short
    if not borders:
        assert found == expected


@given(st.lists(st.tuples(st.booleans(), LENGTHS), min_size=1, max_size=6))
def test_messages_are_those_of_the_librarys_parser(messages):
    frames = [Frame(Opcode.TEXT if is_text else Opcode.BINARY, b"\x41" * length) for is_text, length in messages]
    parser = Protocol(Side.SERVER)
    parser.receive_data(sent(frames))
    parsed = [(bytes(frame.data), frame.opcode is Opcode.TEXT) for frame in parser.events_received()]
    assert [(each.message, each.is_text) for each in FrameSplitter(1 << 20).split(sent(frames))] == parsed


def test_a_message_of_one_byte_at_a_time_is_whole():
    splitter = FrameSplitter(1 << 20)
    data = Frame(Opcode.TEXT, b"bit by bit").serialize(mask=True)
    received = [each for at in range(len(data)) for each in splitter.split(data[at : at + 1])]
    assert [(each.raw, each.message) for each in received] == [(data, b"bit by bit")]


@pytest.mark.parametrize("length", [126, 65_535, 65_536])
def test_nothing_of_a_long_message_is_kept_back(length):
    """It would be memory, of which a client could claim as much as it says that its message has."""
    data = Frame(Opcode.BINARY, bytes(length)).serialize(mask=True)[:-1]
    splitter = FrameSplitter(1 << 20)
    assert [each.raw for each in splitter.split(data)] == [data]
    assert [(each.raw, each.message) for each in splitter.split(b"!")] == [(b"!", None)]


def test_what_is_longer_than_allowed_is_left_to_the_parser():
    """Which closes the connection."""
    allowed, longer = (Frame(Opcode.BINARY, bytes(length)).serialize(mask=True) for length in (100, 101))
    assert [each.message for each in FrameSplitter(100).split(allowed + longer)] == [bytes(100), None]


def test_what_is_not_masked_is_no_message():
    """It breaks the protocol, and the parser is to say so."""
    data = Frame(Opcode.BINARY, b"plain").serialize(mask=False)
    assert [(each.raw, each.message) for each in FrameSplitter(1 << 20).split(data)] == [(data, None)]


@pytest.mark.parametrize("length", [0, 1, 125, 126, 2_080, 65_535, 65_536])
def test_headers_are_those_of_the_library(length):
    payload = bytes(length)
    assert header(length) + payload == Frame(Opcode.BINARY, payload).serialize(mask=False)


@given(st.lists(FRAMES, max_size=6), st.integers(1, 4))
def test_few_frames_at_a_time_are_the_same_frames(frames, most):
    data, at_once, by_parts = sent(frames), FrameSplitter(1 << 20), FrameSplitter(1 << 20)
    whole = at_once.split(data)
    parts = [by_parts.split(data, most=most)]
    while by_parts.has_more:
        parts.append(by_parts.split(most=most))
    received = [each for part in parts for each in part]
    assert b"".join(each.raw for each in received) == data
    assert [each.message for each in received if each.message is not None] == [
        each.message for each in whole if each.message is not None
    ]
    assert all(sum(each.frames for each in part) <= most for part in parts)
    assert sum(each.frames for each in received) == sum(each.frames for each in whole) == len(frames)
