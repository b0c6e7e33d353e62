"""What a stream of an engine's client says, and tells its game, of listeners beside the first."""

from collections.abc import Sequence

from server.protocol.client_messages import Hello, Resume, parse_client_message

STEPS = (
    "hello",
    # The stream begins.
    "add_listener:guest",
    # The server has the guest, as number 7.
    "added:guest pose:0 pose:7",
    # Blocks of the first listener, of the guest, and of nobody.
    "acknowledge: acknowledge:guest",
    # The guest's level has changed: the first one's, and the guest's.
    "standard fine",
    # Two more come, and the connection is lost.
    "add_listener:late add_listener:unheard",
    "resume",
    # The server has handled what adds the guest and `unheard`, and had said so to nobody.
    "add_listener:late added:unheard",
    # The connection is lost again, and the stream begins anew.
    "add_listener:guest add_listener:late add_listener:unheard",
    # The server has no room for the guest now, does not know the head of `late`, and says of `unheard` what is not said
    # of one who is added.
    "refused:late",
    # It is time to ask for the guest again.
    "add_listener:guest pose:0",
    # The server does not know what it was asked.
    "refused:guest remove_listener:guest",
)


def check(lines: Sequence[str]) -> None:
    """Lines of a driver, a step each; the first messages of connections as they are."""
    found = [line.strip() for line in lines]
    hello, resume = (parse_client_message(found[STEPS.index(step)]) for step in ("hello", "resume"))
    assert isinstance(hello, Hello)
    assert hello.listeners == 2
    assert isinstance(resume, Resume)
    # The greatest, which is the guest's.
    assert (resume.token, resume.sequence, resume.sample_clock) == ("t", 7, 7 * 256)
    told = [step if step in {"hello", "resume"} else line for step, line in zip(STEPS, found, strict=True)]
    assert tuple(told) == STEPS
