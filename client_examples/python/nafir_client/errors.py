"""What can go wrong between a client and its server. The text of every error fits on one line."""

_FINAL = frozenset({1000, 1002, 1003, 1007, 1008, 1009, 1010})
"""Close codes after which a new connection would do no better; so are those from 4400 to 4499, as with HTTP."""


_PASSING = frozenset({"not_ready", "server_busy", "server_draining", "unknown_resume_token"})


class NafirClientError(Exception):
    """Base class of all errors of this package."""


class RefusedError(NafirClientError):
    """The server refused a message, a stream or a request.

    `code` is stable and machine-readable: the server's reference lists the codes. `field` names the input at fault, and
    `emitter` or `listener` who the refused message was about: a listener beside the first. `retry_after_s` says after
    how long it is worthwhile to ask again, and `level` at which quality level the stream would be let in now.
    """

    def __init__(
        self,
        code: str,
        message: str,
        *,
        field: str | None = None,
        emitter: str | None = None,
        listener: str | None = None,
        retry_after_s: float | None = None,
        level: str | None = None,
    ) -> None:
        super().__init__(f"{code}: {message}")
        self.code = code
        self.message = message
        self.field = field
        self.emitter = emitter
        self.listener = listener
        self.retry_after_s = retry_after_s
        self.level = level

    @property
    def is_passing(self) -> bool:
        """Whether the same request may succeed later: the server is busy, starting or shutting down."""
        return self.code in _PASSING or self.retry_after_s is not None


class UnreachableError(NafirClientError):
    """There is no server at the address, or something else answers there."""

    def __init__(self, url: str, reason: str, *, is_passing: bool = True) -> None:
        super().__init__(f"{url}: {reason}")
        self.url = url
        self.is_passing = is_passing
        """Whether it may be there later."""


class ConnectionLostError(NafirClientError):
    """The connection of a stream has ended. `close_code` is the server's; None if it said none. `retry_after_s` is
    the server's advice."""

    def __init__(self, url: str, reason: str, *, close_code: int | None, retry_after_s: float | None = None) -> None:
        super().__init__(f"{url}: {reason}")
        self.url = url
        self.close_code = close_code
        self.retry_after_s = retry_after_s

    @property
    def is_passing(self) -> bool:
        """Whether a new connection may do better: the fault was not what this client had said or done."""
        return self.close_code not in _FINAL and not 4400 <= (self.close_code or 0) < 4500


class ProtocolError(NafirClientError):
    """The server sent what this version of the package cannot read."""


class MissingExtraError(NafirClientError):
    """A part of the package needs a library that is not installed."""

    def __init__(self, library: str, extra: str, purpose: str) -> None:
        super().__init__(f"{purpose} needs {library}: pip install 'nafir-client[{extra}]'")


class MissingLibraryError(NafirClientError):
    """A part of the package needs a library of the system that is not installed."""


class ClosedError(NafirClientError):
    """The stream has been closed by this client."""


class ClipError(NafirClientError):
    """An audio file cannot be read."""


class DeviceError(NafirClientError):
    """The sound card cannot be opened."""
