"""When to try again."""

import random
from dataclasses import dataclass


@dataclass(frozen=True)
class Backoff:
    """Waits before attempts to connect: each twice as long as the one before, with chance, so that the clients of a
    server that comes back do not all come at once. A server's own advice is never undercut."""

    first_s: float = 0.2
    longest_s: float = 15.0
    give_up_after_s: float = 300.0
    """For how long a lost connection is tried again."""

    def wait_s(self, attempt: int, advised_s: float | None, chance: random.Random) -> float:
        """The wait before an attempt, of which 0 is the first."""
        longest_s = min(self.longest_s, self.first_s * 2.0 ** min(attempt, 32))
        own_s = longest_s * chance.uniform(0.5, 1.0)
        return own_s if advised_s is None else advised_s + own_s
