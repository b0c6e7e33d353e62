"""Errors that cross a boundary of the package: to an operator at start-up, or to a client in a problem body."""

from pathlib import Path


class NafirError(Exception):
    """Base class of all errors that Nafir raises on purpose."""


class BundleError(NafirError):
    """A scene bundle cannot be used. The message names the file and the field at fault."""

    def __init__(self, path: Path, field: str, problem: str) -> None:
        super().__init__(f"{path}: {field}: {problem}")
        self.path = path
        self.field = field
        self.problem = problem


class RequestError(NafirError):
    """A request cannot be answered.

    `code` is stable and machine-readable, `field` names the input at fault if there is one, and `status` is the HTTP
    status (a WebSocket client gets the code instead). `retry_after_s` says after how long a retry is worthwhile, and
    `level` at which quality level the request could be met now.
    """

    def __init__(
        self,
        code: str,
        message: str,
        *,
        field: str | None = None,
        status: int = 422,
        retry_after_s: int | None = None,
        level: str | None = None,
    ) -> None:
        super().__init__(message)
        self.code = code
        self.field = field
        self.status = status
        self.retry_after_s = retry_after_s
        self.level = level


class FieldError(RequestError):
    """A field gives no usable response for valid poses. Its ONNX graph is at fault, not the request."""

    def __init__(self, message: str) -> None:
        super().__init__("no_response", message, status=500)
