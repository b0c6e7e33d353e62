"""Single impulse responses (IRs) with the direct sound, computed and written in the same way for the command line and
for HTTP.

Lengths are in metres. Angles are in degrees, since people write and read them. Samples are (channel, sample) float32,
with the left ear as channel 0. A scene measured with one microphone has one channel, and the head's yaw changes
nothing.
"""

import io
import json
import math
import struct
from dataclasses import asdict, dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Vector3
from server.core.entity_tags import computed_tag
from server.core.errors import RequestError
from server.core.numerals import DECIMAL, parse_decimal
from server.field.field import AcousticField
from server.responses.full_response import FullResponse

IrFormat = Literal["wav", "npy", "json"]
IR_FORMATS: tuple[IrFormat, ...] = get_args(IrFormat)
_IEEE_FLOAT = 3
MEDIA_TYPES: dict[IrFormat, str] = {"wav": "audio/wav", "npy": "application/octet-stream", "json": "application/json"}


POSITION_PATTERN = rf"^ *{DECIMAL} *, *{DECIMAL} *, *{DECIMAL} *$"
"""The texts that `parse_position` accepts, as a regular expression of JSON Schema."""


def parse_position(text: str, field: str) -> Vector3:
    """Parse three decimal numbers between commas, in metres. Raises RequestError malformed_pose naming `field`."""
    parts = text.split(",", 3)
    if len(parts) != 3:
        raise RequestError("malformed_pose", f"{field}: {text!r} is not three numbers x,y,z", field=field)
    try:
        x, y, z = map(parse_decimal, parts)
    except ValueError as exc:
        raise RequestError("malformed_pose", f"{field}: in x,y,z {exc}", field=field) from exc
    return (x, y, z)


def parse_format(name: str) -> IrFormat:
    """Return the format of this name. Raises RequestError unknown_format."""
    for known in IR_FORMATS:
        if name == known:
            return known
    raise RequestError("unknown_format", f"{name!r} is none of {', '.join(IR_FORMATS)}", field="format")


@dataclass(frozen=True)
class IrQuery:
    """The poses of an IR; `yaw_deg` is that of the head, counter-clockwise, where 0 looks along +x."""

    listener: Vector3
    emitter: Vector3
    yaw_deg: float = 0.0

    def require_inside(self, field: AcousticField) -> None:
        """Check both positions. Raises RequestError position_out_of_bounds."""
        field.bundle.require_inside(self.listener, "listener")
        field.bundle.require_inside(self.emitter, "emitter")

    def etag(self, field: AcousticField, name: str) -> str:
        """Return the strong entity tag of this IR in format `name`. It changes with the bundle, the query and the
        software that computes the IR."""
        return entity_tag(field, "impulse-response", asdict(self), name)


def entity_tag(field: AcousticField, kind: str, parameters: dict[str, object], name: str) -> str:
    """Return the entity tag of a result computed from a field's bundle, its level and `parameters`, in format
    `name`."""
    return computed_tag(field.bundle.digest, field.level.name, kind, parameters, name)


@dataclass(frozen=True)
class ImpulseResponse:
    """A computed IR: `samples` (channel, n) at `sample_rate`, sample 0 the moment of emission."""

    scene: str
    level: str
    query: IrQuery
    sample_rate: int
    channels: tuple[str, ...]
    samples: npt.NDArray[np.float32]

    @classmethod
    def compute(cls, field: AcousticField, query: IrQuery) -> "ImpulseResponse":
        """Compute the IR, in milliseconds: keep it off the event loop. The samples depend on the query alone and not on
        earlier ones, since a warm phase starts from the frozen one. Raises RequestError position_out_of_bounds."""
        query.require_inside(field)
        whole = FullResponse.through_kemar(field)
        samples = whole.impulse_responses([query.listener], [query.emitter], [math.radians(query.yaw_deg)])[0]
        channels = field.bundle.manifest.channels
        return cls(field.bundle.id, field.level.name, query, field.sample_rate, channels, samples)

    def encode(self, name: IrFormat) -> bytes:
        """Write the IR in a format. The samples are the same in all formats, and the same IR gives the same bytes."""
        buffer = io.BytesIO()
        match name:
            case "wav":
                buffer.write(self._wav())
            case "npy":
                np.save(buffer, self.samples, allow_pickle=False)
            case "json":
                buffer.write(json.dumps(self._document()).encode())
        return buffer.getvalue()

    def _wav(self) -> bytes:
        """Write a WAV file byte for byte as `scipy.io.wavfile.write` does, whose import takes a third of a second.
        libsndfile would put the time of day into WAV files of floats (PEAK chunk)."""
        channels, frames = self.samples.shape
        samples = self.samples.T.astype("<f4").tobytes()
        frame_bytes = 4 * channels
        described = struct.pack(
            "<HHIIHHH", _IEEE_FLOAT, channels, self.sample_rate, self.sample_rate * frame_bytes, frame_bytes, 32, 0
        )
        chunks = ((b"fmt ", described), (b"fact", struct.pack("<I", frames)), (b"data", samples))
        content = b"WAVE" + b"".join(name + struct.pack("<I", len(chunk)) + chunk for name, chunk in chunks)
        return b"RIFF" + struct.pack("<I", len(content)) + content

    def _document(self) -> dict[str, object]:
        return {
            "scene": self.scene,
            "level": self.level,
            **asdict(self.query),
            "sample_rate": self.sample_rate,
            "channels": list(self.channels),
            "samples": self.samples.tolist(),
        }
