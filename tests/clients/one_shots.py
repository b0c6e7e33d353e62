"""What a stream of an engine's client says, and tells its game, of clips that play once when its server is lost."""

from collections.abc import Sequence

STEPS = (
    # `loop` and `again` are in the snapshot, and no other. What is ordered, and told while the stream is there: `over`
    # is removed as it ends, `stays` is not. `heard`, whose gain changes, is being played, and so is `again`. `waiting`
    # is not heard yet, and `later` is to begin in the far future.
    "add_emitter:again add_emitter:heard add_emitter:later add_emitter:loop add_emitter:over add_emitter:stays "
    "add_emitter:waiting ended:over ended:stays set_gain:heard",
    # A server goes on by the snapshot.
    "add_emitter:later add_emitter:waiting ended:heard",
    # It had not begun to play `again`, and does so.
    "ended:again remove_emitter:again",
    # It tells again what is known.
    "",
    # Another has all but the last message, by the numbers of those that were sent again.
    "remove_emitter:again",
    # `waiting` is heard, and the stream begins anew.
    "add_emitter:later add_emitter:loop ended:waiting",
)


def check(lines: Sequence[str]) -> None:
    """Lines of a driver, a step each."""
    assert tuple(line.strip() for line in lines) == STEPS
