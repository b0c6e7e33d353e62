"""libopus by ctypes: encoder and decoder of one or two channels of float samples (RFC 6716).

The library is the system's. Its interface has been the same since 2012, and the functions here are all that is needed
of it. Calls release the interpreter's lock. An encoder or decoder is used by one thread at a time; its state is memory
that Python owns and frees. docs/adr/0011-opus-by-the-systems-library.md says why there is no Python package.
"""

import ctypes
import sys
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Final

import numpy as np

from server.core.errors import NafirError
from server.protocol.codecs.codec import FloatArray

RATES: Final = (8_000, 12_000, 16_000, 24_000, 48_000)
_LONGEST_PACKET_BYTES: Final = 1_275
"""The most that one frame of up to 20 ms may take."""
_LONGEST_PACKET_S: Final = 0.12

_NAMES: Final[Mapping[str, Sequence[str]]] = {
    "linux": ("libopus.so.0",),
    "darwin": ("libopus.0.dylib", "/opt/homebrew/lib/libopus.0.dylib", "/usr/local/lib/libopus.0.dylib"),
    "win32": ("opus.dll", "libopus-0.dll", "libopus.dll"),
}
_APPLICATIONS: Final = {"voip": 2048, "audio": 2049, "low_delay": 2051}
_SIGNALS: Final = {"auto": -1000, "voice": 3001, "music": 3002}
# Requests of opus_encoder_ctl and opus_decoder_ctl.
_SET_BITRATE, _SET_COMPLEXITY, _SET_SIGNAL, _GET_LOOKAHEAD, _RESET_STATE = 4002, 4010, 4024, 4027, 4028
_OK: Final = 0


class OpusMissingError(NafirError):
    """There is no libopus on this system."""


class OpusError(NafirError):
    """libopus refused what it was given. For a decoder that is a packet which is none."""


class _Library:
    """The functions of libopus. Their argument types are declared: those of variadic functions have to be for the fixed
    arguments, or processors that pass the others elsewhere (Apple's) read them from the wrong place."""

    def __init__(self, library: ctypes.CDLL) -> None:
        pointer, number, size = ctypes.c_void_p, ctypes.c_int, ctypes.c_int32
        self.version = library.opus_get_version_string
        self.version.restype = ctypes.c_char_p
        self.message = library.opus_strerror
        self.message.argtypes, self.message.restype = (number,), ctypes.c_char_p
        self.encoder_size = library.opus_encoder_get_size
        self.decoder_size = library.opus_decoder_get_size
        self.encoder_init = library.opus_encoder_init
        self.encoder_init.argtypes = (pointer, size, number, number)
        self.decoder_init = library.opus_decoder_init
        self.decoder_init.argtypes = (pointer, size, number)
        self.encoder_ctl = library.opus_encoder_ctl
        self.encoder_ctl.argtypes = (pointer, number)
        self.decoder_ctl = library.opus_decoder_ctl
        self.decoder_ctl.argtypes = (pointer, number)
        self.encode = library.opus_encode_float
        self.encode.argtypes = (pointer, pointer, number, pointer, size)
        self.decode = library.opus_decode_float
        self.decode.argtypes = (pointer, ctypes.c_char_p, size, pointer, number, number)
        self.samples = library.opus_packet_get_nb_samples
        self.samples.argtypes = (ctypes.c_char_p, size, size)

    def require(self, status: int, what: str) -> int:
        """Return a status that is no error. Raises OpusError."""
        if status < _OK:
            raise OpusError(f"{what}: {self.message(status).decode()}")
        return status


@cache
def _library() -> _Library | None:
    for name in _NAMES.get(sys.platform, ("libopus.so.0",)):
        try:
            return _Library(ctypes.CDLL(name))
        except (OSError, AttributeError):  # it is not there, or it is something else of this name
            continue
    return None


def is_available() -> bool:
    return _library() is not None


def version() -> str:
    """Raises OpusMissingError."""
    text: bytes = _require_library().version()
    return text.decode()


def _require_library() -> _Library:
    if (library := _library()) is None:
        raise OpusMissingError("libopus is not installed: apt install libopus0, or brew install opus")
    return library


class OpusEncoder:
    """Encodes frames of one or two channels. Raises OpusMissingError, and OpusError for settings that Opus lacks."""

    def __init__(
        self,
        *,
        sample_rate: int,
        channels: int,
        application: str,
        signal: str = "auto",
        bitrate: int,
        complexity: int,
    ) -> None:
        self._lib = lib = _require_library()
        self._state = ctypes.create_string_buffer(lib.encoder_size(channels))
        kind = _APPLICATIONS[application]
        lib.require(lib.encoder_init(self._state, sample_rate, channels, kind), f"an encoder for {sample_rate} Hz")
        settings = ((_SET_BITRATE, bitrate), (_SET_COMPLEXITY, complexity), (_SET_SIGNAL, _SIGNALS[signal]))
        for request, value in settings:
            lib.require(lib.encoder_ctl(self._state, request, ctypes.c_int32(value)), f"setting {request}")
        self._packet = ctypes.create_string_buffer(_LONGEST_PACKET_BYTES)

    @property
    def look_ahead(self) -> int:
        """How many samples what is decoded lies behind what was encoded."""
        value = ctypes.c_int32()
        self._lib.require(self._lib.encoder_ctl(self._state, _GET_LOOKAHEAD, ctypes.byref(value)), "look-ahead")
        return value.value

    def encode(self, frame: FloatArray) -> bytes:
        """The packet of the next frame (n, channels), contiguous, of 2.5 to 20 ms."""
        size = self._lib.encode(self._state, frame.ctypes.data, len(frame), self._packet, _LONGEST_PACKET_BYTES)
        return self._packet.raw[: self._lib.require(size, f"a frame of {len(frame)} samples")]

    def reset(self) -> None:
        """Forget everything encoded so far."""
        self._lib.require(self._lib.encoder_ctl(self._state, _RESET_STATE), "reset")


class OpusDecoder:
    """Decodes packets to one or two channels, whatever they were encoded from. Raises OpusMissingError."""

    def __init__(self, *, sample_rate: int, channels: int) -> None:
        self._lib = lib = _require_library()
        self._state = ctypes.create_string_buffer(lib.decoder_size(channels))
        lib.require(lib.decoder_init(self._state, sample_rate, channels), f"a decoder for {sample_rate} Hz")
        self._rate = sample_rate
        self._pcm = np.empty((round(_LONGEST_PACKET_S * sample_rate), channels), np.float32)

    def frames(self, packet: bytes) -> int:
        """How many samples of each channel a packet holds, as it says. Raises OpusError for one that is none."""
        return self._lib.require(self._lib.samples(packet, len(packet), self._rate), "a packet")

    def decode(self, packet: bytes) -> FloatArray:
        """The samples (n, channels) of the next packet. Raises OpusError for one that is none."""
        return self._decode(packet, len(self._pcm), False)

    def conceal(self, frames: int) -> FloatArray:
        """A guess (frames, channels) at what was lost, a multiple of 2.5 ms and at most 120."""
        return self._decode(b"", frames, False)

    def recover(self, packet: bytes, frames: int) -> FloatArray:
        """What `packet` says of the one before it (frames, channels), which was lost: a guess where it says nothing.
        `packet` itself has to be decoded next."""
        return self._decode(packet, frames, True)

    def reset(self) -> None:
        """Forget everything decoded so far."""
        self._lib.require(self._lib.decoder_ctl(self._state, _RESET_STATE), "reset")

    def _decode(self, packet: bytes, frames: int, is_before: bool) -> FloatArray:
        data, size = (packet, len(packet)) if packet else (None, 0)
        count = self._lib.decode(self._state, data, size, self._pcm.ctypes.data, frames, is_before)
        return self._pcm[: self._lib.require(count, "a packet")].copy()
