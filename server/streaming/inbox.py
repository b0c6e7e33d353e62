"""What waits for an audio thread to take it into a stream: a client's messages, and what workers have computed.

The event loop and the workers put something in, and the audio thread takes it out. There is no lock to wait for.
"""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from server.planning.plan import Plan
from server.protocol.client_messages import AddEmitter, ClientMessage, ListenerPose
from server.responses.ir_request import IrRequest, IrResponse
from server.streaming.plan_audit import Regret

MAX_WAITING_MESSAGES = 256
T = TypeVar("T")


@dataclass(frozen=True)
class ComputedResponse:
    response: IrResponse
    duration_s: float
    cpu_s: float
    """What the thread that computed it spent."""


class Inbox:
    """Of one stream. In place of an outcome there is the exception that came instead."""

    def __init__(self) -> None:
        self.responses: deque[tuple[IrRequest, ComputedResponse | BaseException]] = deque()
        self.plans: deque[tuple[Plan, float] | BaseException] = deque()
        """With the CPU time that each took."""
        self.regrets: deque[Regret | BaseException] = deque()
        self.brings_emitter = False
        """Whether a message that waits does."""
        self._messages: deque[tuple[float, ClientMessage]] = deque()

    def put_message(self, message: ClientMessage, now_s: float) -> bool:
        """False, and the message refused, where too many wait already. A listener's pose takes the place of an older
        one that came directly before it."""
        if not self._replace_pose(message, now_s):
            if len(self._messages) >= MAX_WAITING_MESSAGES:
                return False
            self._messages.append((now_s, message))
        self.brings_emitter |= isinstance(message, AddEmitter)
        return True

    def _replace_pose(self, message: ClientMessage, now_s: float) -> bool:
        if not (isinstance(message, ListenerPose) and self._messages):
            return False
        try:
            _, last = self._messages[-1]
            if not (isinstance(last, ListenerPose) and last.pose_id < message.pose_id):
                return False
            # Only here anything is appended: if the audio thread has taken it meanwhile, nothing is left at all.
            self._messages[-1] = now_s, message
        except IndexError:
            return False
        return True

    @property
    def has_messages(self) -> bool:
        return bool(self._messages)

    @property
    def has_answers(self) -> bool:
        """Whether a response or a plan has come, which waits for no block."""
        return bool(self.responses or self.plans)

    def take_messages(self) -> Iterator[tuple[float, ClientMessage]]:
        """Those that wait now, each with the time at which it came."""
        for _ in range(len(self._messages)):
            yield self._messages.popleft()


class PendingWork:
    """What workers were given by one stream and have not done yet."""

    def __init__(self) -> None:
        # What is done is taken out: a future holds whom it calls back, which is the stream.
        self._futures: set[Future[Any]] = set()

    def keep_outcome(self, future: "Future[T]", keep: "Callable[[T | BaseException], None]") -> None:
        """Have `keep` called with what comes of it: on the worker's thread, or at once where it is done."""
        self._futures.add(future)
        future.add_done_callback(partial(self._settle, keep))

    def cancel(self) -> None:
        for future in tuple(self._futures):
            future.cancel()

    def _settle(self, keep: "Callable[[T | BaseException], None]", future: "Future[T]") -> None:
        self._futures.discard(future)
        if not future.cancelled():
            failure = future.exception()
            keep(future.result() if failure is None else failure)
