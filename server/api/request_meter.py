"""Limits on the size of a request, applied before it is parsed. The module does no I/O."""

from dataclasses import dataclass

from server.api.connection_limits import ConnectionLimits
from server.api.problems import Refusal


@dataclass(frozen=True)
class Measured:
    """Incoming bytes, divided at the end of the head or of the body."""

    part: bytes
    """Bytes of this request's head or body, for the parser."""
    rest: bytes = b""
    """Bytes after the end of the head, or after the end of a body of known length."""


class RequestMeter:
    """Measures the requests of a connection one after the other: the head line by line, then the body.

    It looks at every byte only once, in whatever pieces the bytes come.
    """

    def __init__(self, limits: ConnectionLimits) -> None:
        self._limits = limits
        self.begin()

    def begin(self) -> None:
        """Begin with the next request."""
        self.has_head = False
        """Whether the empty line after the headers has come."""
        self.is_fresh = True
        """Whether no byte of this request has come yet."""
        self._line_bytes = 0
        self._line_begin = b""
        self._headers = self._headers_bytes = 0
        self._has_request_line = False
        self._body_bytes = 0
        self._body_length: int | None = None
        self._max_body_bytes = self._limits.max_body_bytes

    def allow_body(self, max_bytes: int) -> None:
        """Let the body of this request be so long."""
        self._max_body_bytes = max_bytes

    def expect_body(self, length: int | None) -> Refusal | None:
        """Set the length of the body; None for a chunked body, whose end the parser finds. Returns a refusal if it is
        too long."""
        self._body_length = length
        return self._too_large() if length is not None and length > self._max_body_bytes else None

    @property
    def has_body(self) -> bool:
        """Whether a body of known length is complete."""
        return self._body_bytes == self._body_length

    def measure(self, data: bytes) -> Measured | Refusal:
        self.is_fresh = self.is_fresh and not data
        return self._measure_body(data) if self.has_head else self._measure_head(data)

    def _measure_body(self, data: bytes) -> Measured | Refusal:
        """Measure a part of the body. Chunks count with their framing and trailers."""
        if self._body_length is not None:
            data, rest = data[: self._body_length - self._body_bytes], data[self._body_length - self._body_bytes :]
        else:
            rest = b""
        self._body_bytes += len(data)
        return self._too_large() if self._body_bytes > self._max_body_bytes else Measured(data, rest)

    def _measure_head(self, data: bytes) -> Measured | Refusal:
        at = 0
        while (newline := data.find(b"\n", at)) >= 0:
            refusal = self._lengthen(data[at:newline])
            if refusal is not None:
                return refusal
            at = newline + 1
            if self._end_line():
                self.has_head = True
                return Measured(data[:at], data[at:])
        return self._lengthen(data[at:]) or Measured(data)

    def _lengthen(self, piece: bytes) -> Refusal | None:
        """Count a piece of the current line. Returns a refusal if a limit is exceeded."""
        if not self._line_bytes:
            self._line_begin = piece[:1]
        self._line_bytes += len(piece)
        limits = self._limits
        if not self._has_request_line:
            if self._headers_bytes + self._line_bytes > limits.max_request_line_bytes:
                detail = f"a request line has at most {limits.max_request_line_bytes} bytes"
                return Refusal(414, "request_line_too_long", detail)
            return None
        if self._line_bytes > limits.max_header_bytes:
            return Refusal(431, "header_too_long", f"a header has at most {limits.max_header_bytes} bytes")
        if self._headers_bytes + self._line_bytes > limits.max_headers_bytes:
            return Refusal(431, "headers_too_long", f"headers have at most {limits.max_headers_bytes} bytes together")
        if self._line_bytes and self._headers >= limits.max_headers and self._line_begin != b"\r":
            return Refusal(431, "too_many_headers", f"a request has at most {limits.max_headers} headers")
        return None

    def _end_line(self) -> bool:
        """End the current line. Returns whether the head ends with it. Empty lines before the request line are skipped
        (RFC 9112, 2.2) and count as part of it."""
        is_empty = not self._line_bytes or (self._line_bytes == 1 and self._line_begin == b"\r")
        line_bytes, self._line_bytes = self._line_bytes + 1, 0
        if self._has_request_line:
            self._headers += 1
            self._headers_bytes += line_bytes
            return is_empty
        if is_empty:
            self._headers_bytes += line_bytes
        else:
            self._has_request_line, self._headers_bytes = True, 0
        return False

    def _too_large(self) -> Refusal:
        return Refusal(413, "body_too_large", f"a body has at most {self._max_body_bytes} bytes")
