"""Single impulse responses (IRs), direct sound included: one way to compute and write them, for the command line and
for HTTP alike.

Metres; angles in degrees, since these are human edges. Samples are (channel, sample) float32, channel 0 the left ear;
of a scene that one microphone heard there is one channel, and the head's yaw changes nothing.
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
"""What `parse_position` takes, as a regular expression of JSON Schema."""


def parse_position(text: str, field: str) -> Vector3:
    """Three decimal numbers between commas, metres. Raises RequestError malformed_pose naming `field`."""
    parts = text.split(",", 3)
    if len(parts) != 3:
        raise RequestError("malformed_pose", f"{field}: {text!r} is not three numbers x,y,z", field=field)
    try:
        x, y, z = map(parse_decimal, parts)
    except ValueError as exc:
        raise RequestError("malformed_pose", f"{field}: in x,y,z {exc}", field=field) from exc
    return (x, y, z)


def parse_format(name: str) -> IrFormat:
    """Raises RequestError unknown_format."""
    for known in IR_FORMATS:
        if name == known:
            return known
    raise RequestError("unknown_format", f"{name!r} is none of {', '.join(IR_FORMATS)}", field="format")


@dataclass(frozen=True)
class IrQuery:
    """Which IR; `yaw_deg` is the head's, counter-clockwise, 0 looks along +x."""

    listener: Vector3
    emitter: Vector3
    yaw_deg: float = 0.0

    def require_inside(self, field: AcousticField) -> None:
        """Raises RequestError position_out_of_bounds."""
        field.bundle.require_inside(self.listener, "listener")
        field.bundle.require_inside(self.emitter, "emitter")

    def etag(self, field: AcousticField, name: str) -> str:
        """Strong entity tag of this IR in format `name`: changes with the bundle, the query and what computes it."""
        return entity_tag(field, "impulse-response", asdict(self), name)


def entity_tag(field: AcousticField, kind: str, parameters: dict[str, object], name: str) -> str:
    """Tag of whatever is computed from a field's bundle, its level and `parameters`, written in format `name`."""
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
        """Milliseconds of work: keep it off the event loop. The same samples for the same query, whatever was asked
        before: a warm phase starts from the frozen one. Raises RequestError position_out_of_bounds."""
        query.require_inside(field)
        whole = FullResponse.through_kemar(field)
        samples = whole.impulse_responses([query.listener], [query.emitter], [math.radians(query.yaw_deg)])[0]
        channels = field.bundle.manifest.channels
        return cls(field.bundle.id, field.level.name, query, field.sample_rate, channels, samples)

    def encode(self, name: IrFormat) -> bytes:
        """The same samples in any format, and the same bytes for the same IR."""
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
        """As `scipy.io.wavfile.write` has it, whose import takes a third of a second; libsndfile stamps the time of day
        into WAV files of floats (PEAK chunk)."""
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
