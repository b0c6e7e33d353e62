"""Blocks in Opus (RFC 6716) and live sound on its way up, by the system's libopus.

A block holds the packets that its samples have completed, for one or several streams of one or two channels. After a
restart decoders begin anew, and the first `look_ahead` samples that they give are no part of the sound.
"""

import ctypes
import struct
import sys
from collections.abc import Mapping
from functools import cache
from typing import Any, Final

import numpy as np

from nafir_client.errors import MissingLibraryError, ProtocolError
from nafir_client.wire import Samples

_NAMES: Final = {
    "linux": ("libopus.so.0",),
    "darwin": ("libopus.0.dylib", "/opt/homebrew/lib/libopus.0.dylib", "/usr/local/lib/libopus.0.dylib"),
    "win32": ("opus.dll", "libopus-0.dll", "libopus.dll"),
}
_LENGTH: Final = struct.Struct("<H")
_LONGEST_PACKET_S: Final = 0.12
_RESET_STATE: Final = 4028
_SET_BITRATE, _SET_COMPLEXITY, _SET_SIGNAL = 4002, 4010, 4024
_APPLICATIONS: Final = {"voip": 2048, "audio": 2049, "low_delay": 2051}
_SIGNALS: Final = {"auto": -1000, "voice": 3001, "music": 3002}
_LONGEST_PACKET_BYTES: Final = 1276
"""Of one frame: RFC 6716, section 3.4."""


@cache
def _library() -> Any:
    """Raises MissingLibraryError."""
    for name in _NAMES.get(sys.platform, ("libopus.so.0",)):
        try:
            library = ctypes.CDLL(name)
        except OSError:
            continue
        # Processors that pass further arguments of variadic functions elsewhere have to know which are not.
        library.opus_decoder_ctl.argtypes = (ctypes.c_void_p, ctypes.c_int)
        pointer, number, size = ctypes.c_void_p, ctypes.c_int, ctypes.c_int32
        library.opus_decoder_init.argtypes = (pointer, size, number)
        library.opus_decode_float.argtypes = (pointer, ctypes.c_char_p, size, pointer, number, number)
        library.opus_encoder_ctl.argtypes = (pointer, number)
        library.opus_encoder_init.argtypes = (pointer, size, number, number)
        library.opus_encode_float.argtypes = (pointer, pointer, number, pointer, size)
        return library
    problem = "encoding: opus needs libopus, which is not there: apt-get install libopus0, or brew install opus"
    raise MissingLibraryError(problem)


def require_opus() -> None:
    """Raises MissingLibraryError where there is no libopus."""
    _library()


class _Decoder:
    """One or two channels."""

    def __init__(self, sample_rate: int, channels: int) -> None:
        self._library = _library()
        self._state = ctypes.create_string_buffer(self._library.opus_decoder_get_size(channels))
        self._room = np.zeros((round(_LONGEST_PACKET_S * sample_rate), channels), np.float32)
        if self._library.opus_decoder_init(self._state, sample_rate, channels) < 0:
            raise ProtocolError(f"there is no Opus of {channels} channels at {sample_rate} Hz")

    def reset(self) -> None:
        self._library.opus_decoder_ctl(self._state, _RESET_STATE)

    def decode(self, packet: bytes) -> Samples:
        """(frame, channel)"""
        room = self._room
        frames = self._library.opus_decode_float(self._state, packet, len(packet), room.ctypes.data, len(room), 0)
        if frames < 0:
            raise ProtocolError(f"a packet of {len(packet)} bytes is not Opus")
        return room[:frames].copy()


class OpusWriter:
    """Encodes the sound of a live emitter as the server does a single channel: with half the `bitrate` of the stream's
    options, which are those of a hello. A packet has `frame_samples`."""

    def __init__(self, sample_rate: int, frame_samples: int, options: Mapping[str, Any]) -> None:
        self.frame_samples = frame_samples
        self._library = library = _library()
        self._state = ctypes.create_string_buffer(library.opus_encoder_get_size(1))
        self._packet = ctypes.create_string_buffer(_LONGEST_PACKET_BYTES)
        kind = _APPLICATIONS[options.get("application", "low_delay")]
        if library.opus_encoder_init(self._state, sample_rate, 1, kind) < 0:
            raise ProtocolError(f"there is no Opus at {sample_rate} Hz")
        settings = {
            _SET_BITRATE: options.get("bitrate", 128_000) // 2,
            _SET_COMPLEXITY: options.get("complexity", 5),
            _SET_SIGNAL: _SIGNALS[options.get("signal", "auto")],
        }
        for request, value in settings.items():
            library.opus_encoder_ctl(self._state, request, ctypes.c_int32(value))

    def write(self, samples: Samples) -> bytes:
        """The packet of the next samples (frame_samples,). Those that are no numbers become silence."""
        frame = np.clip(np.nan_to_num(samples, nan=0.0, posinf=0.0, neginf=0.0), -1.0, 1.0).astype(np.float32)
        size = self._library.opus_encode_float(
            self._state, frame.ctypes.data, len(frame), self._packet, _LONGEST_PACKET_BYTES
        )
        if size < 0:
            raise ProtocolError(f"a frame of {len(frame)} samples cannot be Opus")
        return self._packet.raw[:size]


class OpusReader:
    """Decodes the blocks of a stream, in order. `streams` are the channels of each stream of packets."""

    def __init__(self, sample_rate: int, streams: list[int], look_ahead: int) -> None:
        self._decoders = [_Decoder(sample_rate, channels) for channels in streams]
        self._channels = streams
        self._look_ahead = look_ahead
        self._unheard = 0

    def read(self, data: bytes, offset: int, *, is_restart: bool) -> Samples:
        """(frame, channel) what the packets from a byte on decode to. Raises ProtocolError."""
        if is_restart:
            self._unheard = self._look_ahead
            for decoder in self._decoders:
                decoder.reset()
        decoded: list[list[Samples]] = [[np.zeros((0, channels), np.float32)] for channels in self._channels]
        for number, packet in enumerate(_packets(data, offset)):
            stream = number % len(self._decoders)
            decoded[stream].append(self._decoders[stream].decode(packet))
        try:
            samples: Samples = np.concatenate([np.concatenate(pieces) for pieces in decoded], axis=1)
        except ValueError as exc:
            raise ProtocolError("the packets of a block are not as long as each other") from exc
        dropped = min(len(samples), self._unheard)
        self._unheard -= dropped
        return samples[dropped:]


def _packets(data: bytes, offset: int) -> list[bytes]:
    packets = []
    while offset < len(data):
        if offset + _LENGTH.size > len(data):
            raise ProtocolError("the length of the last packet of a block is incomplete")
        (length,) = _LENGTH.unpack_from(data, offset)
        offset += _LENGTH.size
        if offset + length > len(data):
            raise ProtocolError(f"a packet has {length} bytes, of which {len(data) - offset} are there")
        packets.append(data[offset : offset + length])
        offset += length
    return packets
