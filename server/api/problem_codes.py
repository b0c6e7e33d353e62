"""Meanings of the `code` of problem documents: every reason for which an HTTP request is refused."""

from collections.abc import Mapping
from typing import Final

PROBLEM_CODES: Final[Mapping[str, str]] = {
    "body_too_large": "413: the body is longer than the server takes",
    "doubled_effect": "409: the query switches one effect twice",
    "doubled_header": "400: `Host`, `Origin` or `Sec-Fetch-Site` is given several times",
    "doubled_parameter": "422: a parameter that may be given once is given several times",
    "handshake_refused": "4xx: a WebSocket is asked for wrongly, or by a site that may not use the server",
    "header_too_long": "431: one header is longer than the server takes",
    "headers_too_long": "431: all headers together are longer than the server takes",
    "host_not_allowed": "421: the server does not answer to this host name; an operator can allow it",
    "http_error": "4xx: the request is refused for a reason that has no code of its own; the detail says why",
    "internal_error": "500: the server failed to answer; its log says why",
    "malformed_pose": "422: a position, heading or height cannot be read",
    "malformed_request": "422, or 400 for bytes that are not HTTP/1.1: a parameter is missing or cannot be read",
    "map_too_fine": "409: the map would have too many points; ask for a larger spacing",
    "map_too_slow": "409: the map would take too long at this level; ask for a larger spacing or a cheaper level",
    "method_not_allowed": "405: the route has no such method; `Allow` lists those it has",
    "no_response": "500: the scene's field gave no usable response; the scene bundle is at fault",
    "not_found": "404: there is no such route or file",
    "not_ready": "503: the server is warming up, or one of its threads has failed; the message says which",
    "origin_not_allowed": "403: pages of this site may not use the server; an operator can allow it",
    "position_out_of_bounds": "404: the position is outside the scene or inside a wall",
    "preflight_refused": "400: pages of this site may not send such a request; the detail says what they may",
    "request_line_too_long": "414: the URL is longer than the server takes",
    "request_timeout": "408: the request did not arrive whole in time",
    "server_busy": "503: too many computations wait; ask again after `Retry-After`",
    "server_draining": "503: the server is shutting down; ask again there or elsewhere",
    "too_many_connections": "503: every connection is in use",
    "too_many_emitters": "422: a plan is asked for with more emitters than a stream may have",
    "too_many_headers": "431: the request has more headers than the server takes",
    "unknown_effect": "422: there is no effect of this name; the message lists those there are",
    "unknown_format": "422: the answer cannot be written in this format",
    "unknown_level": "404: the scene has no quality level of this name",
    "unknown_output": "422: the output is neither headphones nor mono",
    "unknown_parameter": "422: the route has no parameter of this name; the message suggests the nearest",
    "unknown_scene": "404: there is no scene of this id",
    "upgrade_required": "426: the address is a WebSocket; connect with ws:// or wss://",
}
"""Meanings by code. Each begins with the HTTP status."""
