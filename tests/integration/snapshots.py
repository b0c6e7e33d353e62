"""Snapshots that servers in the process of the tests give their clients."""

import json
import time

import pytest

from server.protocol.snapshot import Seal


class Snapshots:
    """Five a second of each stream, until there are to be no more."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.covered: list[tuple[int, int]] = []
        """How many messages each has in it, and the newest pose."""
        self._is_over = False
        self._handled: int | None = None
        close = Seal.close

        def close_and_note(seal: Seal, data: bytes, *, plays_at: float, now: float, owner: str = "") -> str | None:
            if self._is_over:
                return None
            state = json.loads(data)
            if self._handled not in {None, state["handled"]}:
                return None
            self.covered.append((state["handled"], state["pose_id"]))
            return close(seal, data, plays_at=plays_at, now=now, owner=owner)

        monkeypatch.setattr(Seal, "close", close_and_note)
        monkeypatch.setattr("server.api.connection._SNAPSHOT_PERIOD_S", 0.2)

    def keep_to(self, handled: int) -> None:
        """From now on there are none but those that have so many messages in them."""
        self._handled = handled

    def end_with(self, handled: int, *, pose_id: int = 0) -> None:
        """Wait for one with so many messages and with this pose or a newer one. It is the last one."""
        end_s = time.monotonic() + 60
        while time.monotonic() < end_s:
            if self.covered and self.covered[-1] >= (handled, pose_id):
                self._is_over = True
                return
            time.sleep(0.02)
        raise AssertionError(f"no snapshot covers {handled} messages and pose {pose_id}: {self.covered[-1:]}")
