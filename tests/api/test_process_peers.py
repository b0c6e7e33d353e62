"""Whom a process asks for the stream of a token, and for how long it waits."""

import asyncio

import pytest

from server.api.process_peers import ProcessPeers
from server.api.processes import listening_privately
from server.protocol.client_messages import PROTOCOL, Resume

KEY = "the key of the processes"


@pytest.fixture
def starting():
    """The socket of a process that is being started: it accepts connections, and nobody answers."""
    with listening_privately() as listener:
        listener.setblocking(False)
        yield listener


def peers_beside(listener, number=0, key=KEY):
    """Process 0; process 1 has the socket."""
    return ProcessPeers(number, (0, listener.getsockname()[1]), key)


def test_a_token_says_which_process_gave_it(starting):
    one, other = (peers_beside(starting, number) for number in range(2))
    assert [one.home_of(each.new_token()) for each in (one, other)] == [0, 1]
    assert len({one.new_token() for _ in range(100)}) == 100
    Resume(protocol=PROTOCOL, token=ProcessPeers(999, (), KEY).new_token())
    assert one.home_of(peers_beside(starting, 1, "another key").new_token()) is None
    assert peers_beside(starting, key=None).home_of(other.new_token()) is None
    token = other.new_token()
    for made_up in ("", ".", "1", "1.a.b", "é.é", f"0{token[1:]}", token[:-1], f"{token}=", token.replace(".", "")):
        assert one.home_of(made_up) is None, made_up


def test_for_a_token_that_was_made_up_nobody_is_asked(starting):
    async def take(token):
        one = peers_beside(starting)
        return await one.take(token, None, one.home_of(token))

    assert asyncio.run(take("1.made-up.by-a-client")) is None
    assert asyncio.run(take(peers_beside(starting).new_token())) is None  # its own, which it has lost
    with pytest.raises(BlockingIOError):
        starting.accept()
    assert asyncio.run(take(peers_beside(starting, 1).new_token())) is None
    starting.accept()[0].close()
