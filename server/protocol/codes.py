"""What the codes of a stream mean: those of its errors, and those it is closed with."""

from collections.abc import Mapping
from typing import Final

NORMAL, POLICY_VIOLATION, INTERNAL_ERROR, SERVICE_RESTART, TRY_AGAIN_LATER = 1000, 1008, 1011, 1012, 1013
"""Codes of RFC 6455, 7.4.1, that the server closes streams with."""

ERROR_CODES: Final[Mapping[str, str]] = {
    "not_ready": "the server is still warming up, or a thread of its own has failed; the message says which",
    "server_draining": "the server is shutting down; open the stream again, there or elsewhere",
    "server_busy": "there are as many streams as there may be",
    "hello_expected": "the first message was no hello, or none came in time",
    "unexpected_hello": "a stream has one hello",
    "unsupported_protocol": "the server speaks another version of the protocol",
    "unsupported_sample_rate": "the scene has another rate",
    "unknown_scene": "one of GET /v1/scenes is asked for",
    "unknown_hrtf": "one of GET /v1/hrtfs is asked for",
    "unknown_level": "one of the scene's quality levels is asked for, or auto",
    "unknown_effect": "no effect has this name; the message lists those that are",
    "unknown_clip": "one of GET /v1/clips is asked for",
    "undecodable_clip": "the clip's file cannot be read; the message says why",
    "malformed_message": "no JSON, or a field that is missing, unknown or has an impossible value",
    "malformed_pose": "no place or direction at all",
    "malformed_directivity": "no pattern that anything radiates by",
    "malformed_block": "a dry block that is not laid out as one",
    "unknown_message": "no type, or one that there is not; of binary messages, no such kind",
    "message_too_large": "more bytes than a message may have",
    "too_many_messages": "more came within one block than are heeded; this one was not",
    "position_out_of_bounds": "the place is outside the scene's bounds",
    "stale_pose": "a pose id is greater than all before, of the listener and of emitters",
    "stale_block": "the sequence of a dry block is greater than those of its emitter before",
    "unknown_sequence": "a block was acknowledged that was not sent yet",
    "unknown_emitter": "no emitter has this id",
    "duplicate_emitter": "an emitter has this id",
    "too_many_emitters": "the stream has as many emitters as it may have",
    "fixed_directivity": "the scene's responses hold the direct sound, and its emitters radiate as they did then",
    "not_live": "a dry block came for an emitter that plays a clip",
    "bad_samples": "live samples that were no audio are silence",
    "field_failure": "no impulse response could be computed; the last ones stay in effect",
    "plan_failure": "no plan of effects could be made; what is on stays on",
    "reads_too_slowly": "the client does not read what it is sent",
    "stalled": "the window has been full for too long, and nothing was acknowledged",
    "internal_error": "the stream failed, by a defect of the server",
}

CLOSE_CODES: Final[Mapping[int, str]] = {
    NORMAL: "the client has said goodbye",
    1002: "a frame breaks RFC 6455",
    1007: "a text message is not UTF-8",
    1009: "a WebSocket message was longer than the server takes at all",
    POLICY_VIOLATION: "the hello was refused or did not come, or the client reads too slowly or acknowledges nothing",
    INTERNAL_ERROR: "the stream failed, by a defect of the server",
    SERVICE_RESTART: "the server is shutting down",
    TRY_AGAIN_LATER: "the server is not ready, or has no free stream",
}
"""1002, 1007 and 1009 are the web server's own."""
