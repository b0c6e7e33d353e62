"""Blocks in Opus (RFC 6716), by the system's libopus.

A block holds the packets that its samples have completed, for one or several streams of one or two channels. After a
restart decoders begin anew, and the first `look_ahead` samples that they give are no part of the sound.
"""

import ctypes
import struct
import sys
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
