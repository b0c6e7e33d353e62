"""Errors that cross a boundary of the package: to an operator at start-up, or to a client in a problem body."""

from pathlib import Path


class NafirError(Exception):
    """Base of every error Nafir raises on purpose."""


class BundleError(NafirError):
    """A scene bundle that cannot be used; names the file and the field at fault."""

    def __init__(self, path: Path, field: str, problem: str) -> None:
        super().__init__(f"{path}: {field}: {problem}")
        self.path = path
        self.field = field
        self.problem = problem


class RequestError(NafirError):
    """A request that cannot be answered as asked.

    `code` is stable and machine-readable, `field` names the offending input where there is one, and `status` is the
    HTTP status (a WebSocket client gets the code instead). `retry_after_s` is when it is worth asking again.
    """

    def __init__(
        self,
        code: str,
        message: str,
        *,
        field: str | None = None,
        status: int = 422,
        retry_after_s: int | None = None,
    ) -> None:
        super().__init__(message)
        self.code = code
        self.field = field
        self.status = status
        self.retry_after_s = retry_after_s


class FieldError(RequestError):
    """A field that has no response for poses that may be asked for: its graph, and nobody's request, is at fault."""

    def __init__(self, message: str) -> None:
        super().__init__("no_response", message, status=500)
