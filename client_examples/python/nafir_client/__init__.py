"""Streams of a Nafir server, and its impulse responses, from Python.

`connect` is for asyncio, `nafir_client.threaded.connect` for programs without it, such as games and audio callbacks.
"""

from nafir_client.backoff import Backoff
from nafir_client.client import Client, ImpulseResponse, ImpulseResponses
from nafir_client.errors import (
    ClipError,
    ClosedError,
    ConnectionLostError,
    DeviceError,
    MissingExtraError,
    MissingLibraryError,
    NafirClientError,
    ProtocolError,
    RefusedError,
    UnreachableError,
)
from nafir_client.pose import Pose
from nafir_client.scene import Scene, Welcome
from nafir_client.session import Message, StreamOptions
from nafir_client.stream import Emitter, Listener, Stream, connect
from nafir_client.stream_statistics import ListenerStatistics, StreamStatistics
from nafir_client.wire import EFFECTS, Block

__all__ = [
    "EFFECTS",
    "Backoff",
    "Block",
    "Client",
    "ClipError",
    "ClosedError",
    "ConnectionLostError",
    "DeviceError",
    "Emitter",
    "ImpulseResponse",
    "ImpulseResponses",
    "Listener",
    "ListenerStatistics",
    "Message",
    "MissingExtraError",
    "MissingLibraryError",
    "NafirClientError",
    "Pose",
    "ProtocolError",
    "RefusedError",
    "Scene",
    "Stream",
    "StreamOptions",
    "StreamStatistics",
    "UnreachableError",
    "Welcome",
    "connect",
]
