"""Meanings of a stream's error codes and close codes."""

from collections.abc import Mapping
from typing import Final

NORMAL, POLICY_VIOLATION, INTERNAL_ERROR, SERVICE_RESTART, TRY_AGAIN_LATER = 1000, 1008, 1011, 1012, 1013
"""Close codes of RFC 6455, section 7.4.1, that the server uses."""
ACCESS_ENDED, TAKEN_OVER = 4401, 4409
"""Close codes of our own (RFC 6455, 7.4.2): 401 and 409 for a stream that is open."""
LOST = 1006
"""What stands for the code of a connection that ended without a close frame."""
GOODBYES: Final = frozenset({NORMAL, 1001, 1002, 1003, 1005, 1007, 1009})
"""Close codes after which a client does not come back: it has said so (1005 stands for a close frame without a code),
or broke the protocol. After any other the connection was lost."""

ERROR_CODES: Final[Mapping[str, str]] = {
    "not_ready": "the server is still warming up, or a thread of its own has failed; the message says which",
    "server_draining": "the server is shutting down; resume with the snapshot, or begin anew, there or elsewhere",
    "key_expired": "the key or token that opened the stream has expired; connect again with a new one",
    "key_revoked": "the key that opened the stream, or signed its token, was revoked; connect again with a valid one",
    "server_busy": "what was asked for would break somebody's sound, or no stream is free; ask later",
    "hello_expected": "the first message was not a hello, or none came in time",
    "unexpected_hello": "a stream has one hello",
    "unexpected_resume": "a resume is the first message on a connection",
    "unknown_resume_token": "no stream is kept for this token, or no longer, and there is no good snapshot; begin anew",
    "taken_over": "the client has resumed the stream on another connection",
    "unsupported_protocol": "the server speaks another version of the protocol",
    "unsupported_sample_rate": "the scene is not rendered at this sample rate; the message lists those it is",
    "unsupported_encoding": "the server does not have the encoding, or not at this rate; GET /v1/encodings lists them",
    "unknown_scene": "there is no such scene; GET /v1/scenes lists them",
    "unknown_hrtf": "there is no such head; GET /v1/hrtfs lists them",
    "unknown_level": "the scene has no quality level of this name",
    "unknown_effect": "no effect has this name; the message lists them",
    "unknown_clip": "there is no such clip; GET /v1/clips lists them",
    "store_unreachable": "the store of uploaded clips does not answer, or refuses; ask later",
    "undecodable_clip": "the clip's file cannot be read; the message says why",
    "malformed_message": "the message is not JSON, or a field is missing, unknown or has an impossible value",
    "malformed_pose": "the position or the direction is impossible",
    "malformed_directivity": "the directivity is not a valid pattern",
    "malformed_block": "a dry block has another layout than documented",
    "unknown_message": "the message has no type, or one that does not exist; a binary message is of an unknown kind",
    "message_too_large": "the message has more bytes than allowed",
    "too_many_messages": "more messages came within one block than the server takes; this one was ignored",
    "position_out_of_bounds": "the position is outside the scene's bounds",
    "stale_pose": "the pose id is not greater than all earlier ones, of its listener and of emitters",
    "stale_block": "the sequence of a dry block is not greater than those before it of the same emitter",
    "unknown_sequence": "a block was acknowledged that was not sent yet",
    "unknown_emitter": "no emitter has this id",
    "duplicate_emitter": "another emitter has this id",
    "too_many_emitters": "the stream has as many emitters as it may have",
    "unknown_door": "the scene has no door of this name",
    "unknown_listener": "no listener has this id or number",
    "duplicate_listener": "another listener has this id",
    "too_many_listeners": "the stream has as many listeners as it may have, or asks for more",
    "fixed_directivity": "the scene's responses hold the direct sound, so its emitters cannot have a directivity",
    "no_directions": "the scene, or the quality level, does not know from where sound arrives, so it has no ambisonics",
    "fixed_output": "a stream of ambisonics stays one, and no other stream becomes one; open another stream",
    "outside_clip": "the offset or the loop reaches beyond the clip, or the loop has no length",
    "is_live": "a live emitter cannot be stopped, only removed",
    "not_live": "a dry block came for an emitter that plays a clip",
    "bad_samples": "live samples were not audio and were replaced by silence",
    "field_failure": "no impulse response could be computed; the last ones stay in effect",
    "plan_failure": "no plan of effects could be made; the effects that are on stay on",
    "door_failure": "doors could not be moved; they stay as they were heard last",
    "reads_too_slowly": "the client does not read the messages it is sent",
    "stalled": "the window has been full for too long, and nothing was acknowledged",
    "internal_error": "the stream failed because of a defect of the server",
}

CLOSE_CODES: Final[Mapping[int, str]] = {
    NORMAL: "the client has said goodbye",
    1002: "a frame breaks RFC 6455",
    1007: "a text message is not UTF-8",
    1009: "a WebSocket message was longer than the server accepts",
    POLICY_VIOLATION: "the hello was refused or did not come, or the client reads too slowly or acknowledges nothing",
    INTERNAL_ERROR: "the stream failed because of a defect of the server",
    SERVICE_RESTART: "the server is shutting down",
    TRY_AGAIN_LATER: "the server is not ready, or has no room for the stream",
    ACCESS_ENDED: "the key or token that opened the stream has expired or was revoked",
    TAKEN_OVER: "the client has resumed the stream on another connection",
}
"""Meanings by close code. The web server itself closes with 1002, 1007 and 1009."""
