"""Single impulse responses (IRs) with the direct sound, computed and written in the same way for the command line and
for HTTP.

Lengths are in metres. Angles are in degrees, since people write and read them. Samples are (channel, sample) float32:
the left ear and the right one; or the harmonics of an ambisonic response (ACN, SN3D); or one microphone.
"""

import io
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Literal, TypedDict, Unpack, get_args

import numpy as np
import numpy.typing as npt
from pydantic import TypeAdapter

from server.acoustics.geometry import Pose, Quaternion, Vector3, orientations_of
from server.acoustics.spherical_harmonics import HIGHEST_ORDER, harmonic_count
from server.assets.hrtfs import DEFAULT_HRTF
from server.core.entity_tags import computed_tag
from server.core.errors import RequestError
from server.core.numerals import DECIMAL, ZERO, parse_decimal, parse_schema_decimal
from server.core.wav import wav_bytes
from server.field.field import AcousticField
from server.rendering.hrtf import HeadFilters, kemar
from server.responses.full_response import FullResponse
from server.scene.bundle import Bundle
from server.scene.door import OpenShare

IrFormat = Literal["wav", "npy", "json", "sofa"]
IR_FORMATS: tuple[IrFormat, ...] = get_args(IrFormat)
IrOutput = Literal["binaural", "ambisonics", "mono"]
IR_OUTPUTS: tuple[IrOutput, ...] = get_args(IrOutput)
USUAL_ORDER = 1
MEDIA_TYPES: dict[IrFormat, str] = {
    "wav": "audio/wav",
    "npy": "application/octet-stream",
    "json": "application/json",
    "sofa": "application/x-sofa",
}


POSITION_PATTERN = rf"^ *{DECIMAL} *, *{DECIMAL} *, *{DECIMAL} *$"
"""The texts that `parse_position` accepts, as a regular expression of JSON Schema."""
ORIENTATION_PATTERN = (
    rf"^(?! *{ZERO} *, *{ZERO} *, *{ZERO} *, *{ZERO} *$) *{DECIMAL} *, *{DECIMAL} *, *{DECIMAL} *, *{DECIMAL} *$"
)
"""The texts that `parse_orientation` accepts, as a regular expression of JSON Schema."""
DOOR_PATTERN = r"^[^\s:,=/][^:,=/]{0,63}=(0|1|0?\.[0-9]{1,9}|[01]\.0{0,9})$"
"""Texts that `parse_doors` accepts, as a regular expression of JSON Schema. It accepts other forms of numbers too."""
_OPEN_SHARE: TypeAdapter[float] = TypeAdapter(OpenShare)


def parse_doors(texts: Iterable[str]) -> dict[str, float]:
    """Parse texts `NAME=SHARE`, such as kitchen=0.5. Raises RequestError malformed_door, or doubled_door for a name
    twice."""
    doors: dict[str, float] = {}
    for text in texts:
        name, _, number = text.rpartition("=")
        try:
            share = _OPEN_SHARE.validate_python(parse_decimal(number))
        except ValueError:
            problem = f"door {text!r} is not NAME=SHARE with a share from 0, shut, to 1, such as kitchen=0.5"
            raise RequestError("malformed_door", problem, field="door") from None
        if name in doors:
            raise RequestError("doubled_door", f"door {name!r} is there twice", field="door", status=409)
        doors[name] = share
    return doors


def parse_position(text: str, field: str) -> Vector3:
    """Parse three decimal numbers between commas, in metres. Raises RequestError malformed_pose naming `field`."""
    x, y, z = _parse_numbers(text, "x,y,z", field)
    return (x, y, z)


def parse_orientation(text: str, field: str) -> Quaternion:
    """Parse a quaternion of any length but zero, as four decimal numbers between commas. Raises RequestError
    malformed_pose naming `field`."""
    components = _parse_numbers(text, "x,y,z,w", field)
    largest = max(map(abs, components))
    # guard: a query's orientation is one
    if not largest:
        raise RequestError("malformed_pose", f"{field} must be a quaternion of non-zero length", field=field)
    _, exponent = math.frexp(largest)  # by powers of two, which leaves the components' ratios exact
    return Quaternion(*(math.ldexp(component, -exponent) for component in components))


def _parse_numbers(text: str, names: str, field: str) -> list[float]:
    count = names.count(",") + 1
    parts = text.split(",", count)
    if len(parts) != count:
        number = {3: "three", 4: "four"}[count]
        raise RequestError("malformed_pose", f"{field}: {text!r} is not {number} numbers {names}", field=field)
    try:
        return [parse_schema_decimal(part) for part in parts]
    except ValueError as exc:
        raise RequestError("malformed_pose", f"{field}: in {names} {exc}", field=field) from exc


def parse_format(name: str) -> IrFormat:
    """Return the format of this name. Raises RequestError unknown_format."""
    for known in IR_FORMATS:
        if name == known:
            return known
    raise RequestError("unknown_format", f"{name!r} is none of {', '.join(IR_FORMATS)}", field="format")


def parse_output(name: str) -> IrOutput:
    """Return the output of this name. Raises RequestError unknown_output."""
    for known in IR_OUTPUTS:
        if name == known:
            return known
    raise RequestError("unknown_output", f"{name!r} is none of {', '.join(IR_OUTPUTS)}", field="output")


def parse_order(output: IrOutput | None, order: int | None) -> int | None:
    """Return the order of an output: none but for ambisonics, whose usual order is 1. Raises RequestError."""
    if output != "ambisonics":
        if order is not None:
            raise RequestError(
                "contradicting_parameters", "order: belongs to ambisonics alone", field="order", status=409
            )
        return None
    order = USUAL_ORDER if order is None else order
    if not 1 <= order <= HIGHEST_ORDER:
        raise RequestError("malformed_request", f"order: {order} is not 1 to {HIGHEST_ORDER}", field="order")
    return order


class QueryOptions(TypedDict, total=False):
    """Options of `IrQuery.checked` that are no text."""

    yaw_deg: float | None
    pitch_deg: float | None
    roll_deg: float | None
    output: str | None
    order: int | None
    hrtf: str | None


@dataclass(frozen=True)
class IrQuery:
    """The poses of an IR, and for what it is computed.

    Angles are those of the head: `yaw_deg` counter-clockwise, where 0 looks along +x, then `pitch_deg`, nose up, then
    `roll_deg`, right ear down. An `orientation` takes their place. `output` None is the scene's own:
    one channel if it was measured with one microphone, otherwise two ears. `order` is given exactly with ambisonics.
    `hrtf` is the name of the head whose filters `ImpulseResponse.compute` gets. Raises ValueError for an order without
    ambisonics, and the other way round.
    """

    listener: Vector3
    emitter: Vector3
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    orientation: Quaternion | None = None
    output: IrOutput | None = None
    order: int | None = None
    hrtf: str = DEFAULT_HRTF

    def __post_init__(self) -> None:
        if (self.output == "ambisonics") != (self.order is not None):
            raise ValueError("order: belongs to ambisonics, which needs one")

    @classmethod
    def of(
        cls,
        field: AcousticField,
        listener: str,
        emitter: str,
        *,
        orientation: str | None = None,
        **other: Unpack["QueryOptions"],
    ) -> "IrQuery":
        """Read a query for a field from texts, and check it (`checked`)."""
        return cls.checked(
            field,
            parse_position(listener, "listener"),
            parse_position(emitter, "emitter"),
            orientation=None if orientation is None else parse_orientation(orientation, "orientation"),
            **other,
        )

    @classmethod
    def checked(
        cls,
        field: AcousticField,
        listener: Vector3,
        emitter: Vector3,
        *,
        orientation: Quaternion | None = None,
        yaw_deg: float | None = None,
        pitch_deg: float | None = None,
        roll_deg: float | None = None,
        output: str | None = None,
        order: int | None = None,
        hrtf: str | None = None,
    ) -> "IrQuery":
        """Return the query for a field; None stands for what is not given. Queries with equal answers are equal.

        Raises RequestError, which names the parameter, for what cannot be read, is outside the scene or contradicts
        another parameter, and for ambisonics of a field that knows no directions.
        """
        angles = {"yaw_deg": yaw_deg, "pitch_deg": pitch_deg, "roll_deg": roll_deg}
        given = [name for name, value in angles.items() if value is not None]
        if orientation is not None and given:
            raise RequestError(
                "contradicting_parameters",
                f"orientation: contradicts {' and '.join(given)}; leave one out",
                field="orientation",
                status=409,
            )
        for name in given:
            if not math.isfinite(angles[name] or 0.0):
                raise RequestError("malformed_pose", f"{name} is not finite", field=name)
        own = own_output(field)
        wanted = None if output is None else parse_output(output)
        if hrtf is not None and (wanted or own) != "binaural":
            raise RequestError(
                "contradicting_parameters",
                f"hrtf: a head hears binaural output alone, and the output is {wanted or own}",
                field="hrtf",
                status=409,
            )
        query = cls(
            listener,
            emitter,
            **{name: value or 0.0 for name, value in angles.items()},
            orientation=orientation,
            output=None if wanted == own else wanted,
            order=parse_order(wanted, order),
            hrtf=DEFAULT_HRTF if hrtf is None else hrtf,
        )
        query.require_inside(field)
        if wanted == "ambisonics":
            require_directions(field)
        return query

    @property
    def heads(self) -> npt.NDArray[np.float64]:
        """The head as a yaw (1,) if it is level, or else as an orientation (1, 4)."""
        if self.orientation is not None:
            return np.array([self.orientation])
        yaw, pitch, roll = map(math.radians, (self.yaw_deg, self.pitch_deg, self.roll_deg))
        if pitch or roll:
            return np.array([Quaternion.from_angles(yaw, pitch, roll)])
        return np.array([yaw])

    def require_inside(self, field: AcousticField) -> None:
        """Check both positions. Raises RequestError position_out_of_bounds."""
        field.bundle.require_inside(self.listener, "listener")
        field.bundle.require_inside(self.emitter, "emitter")

    def etag(self, field: AcousticField, name: str, filters: HeadFilters | None = None) -> str:
        """Return the strong entity tag of this IR in format `name`. It changes with the bundle, the query, the head and
        the software that computes the IR."""
        head = None if filters is None else filters.digest
        return entity_tag(field, "impulse-response", {**asdict(self), "head": head}, name)

    def told(self) -> dict[str, object]:
        """The query for the reader of an answer: places and orientation, and what is not as usual."""
        told: dict[str, object] = {"listener": self.listener, "emitter": self.emitter}
        if self.orientation is not None:
            told["orientation"] = self.orientation
        else:
            told["yaw_deg"] = self.yaw_deg
            if self.pitch_deg or self.roll_deg:
                told |= {"pitch_deg": self.pitch_deg, "roll_deg": self.roll_deg}
        if self.hrtf != DEFAULT_HRTF:
            told["hrtf"] = self.hrtf
        if self.output is not None:
            told["output"] = self.output
        if self.order is not None:
            told["order"] = self.order
        return told


def own_output(field: AcousticField) -> IrOutput:
    """The output of a scene's responses if nobody asks for another."""
    return "mono" if field.channels == 1 else "binaural"


def require_directions(field: AcousticField) -> None:
    """Raises RequestError no_directions for a field of which no ambisonics can be computed."""
    from server.responses.ambisonic_response import AmbisonicResponse

    AmbisonicResponse.require(field)


def entity_tag(field: AcousticField, kind: str, parameters: dict[str, object], name: str) -> str:
    """Return the entity tag of a result computed from a field's bundle with its doors as they are, its level and
    `parameters`, in format `name`."""
    if field.bundle.doors:
        parameters = {**parameters, "doors": field.bundle.openness}
    return computed_tag(field.bundle.digest, field.level.name, kind, parameters, name)


@dataclass(frozen=True)
class ImpulseResponse:
    """A computed IR: `samples` (channel, n) at `sample_rate`, sample 0 the moment of emission. A SOFA file of it says
    where the walls of its `bundle` are."""

    scene: str
    level: str
    query: IrQuery
    sample_rate: int
    channels: tuple[str, ...]
    samples: npt.NDArray[np.float32]
    bundle: Bundle | None = None

    @classmethod
    def compute(cls, field: AcousticField, query: IrQuery, filters: HeadFilters | None = None) -> "ImpulseResponse":
        """Compute the IR, in milliseconds: keep it off the event loop. Ears are those of the head `filters`, KEMAR by
        default. The samples depend on the query and the head alone and not on earlier queries, since a warm phase
        starts from the frozen one. Raises RequestError position_out_of_bounds, or no_directions."""
        query.require_inside(field)
        output = query.output or own_output(field)
        channels, samples = cls._samples(field, query, output, filters)
        return cls(field.bundle.id, field.level.name, query, field.sample_rate, channels, samples, bundle=field.bundle)

    @staticmethod
    def _samples(
        field: AcousticField, query: IrQuery, output: IrOutput, filters: HeadFilters | None
    ) -> tuple[tuple[str, ...], npt.NDArray[np.float32]]:
        """The names of the channels, and the samples (channel, n)."""
        poses = [query.listener], [query.emitter], query.heads
        match output:
            case "binaural":
                filters = kemar(field.sample_rate) if filters is None else filters
                heard = FullResponse(field, filters).impulse_responses(*poses)
                if field.channels == 1:
                    from server.responses.binaural import Binauralization

                    through = Binauralization(filters, speed_of_sound=field.bundle.manifest.speed_of_sound)
                    head = Pose(query.listener, Quaternion(*orientations_of(query.heads)[0]))
                    heard = through.binauralize(heard, head, [query.emitter])
                return ("left", "right"), heard[0]
            case "ambisonics":
                from server.responses.ambisonic_response import AmbisonicResponse

                assert query.order is not None  # by the query
                names = tuple(f"acn-{number}" for number in range(harmonic_count(query.order)))
                return names, AmbisonicResponse(field).impulse_responses(*poses, query.order)[0]
            case "mono":
                from server.responses.mono_response import mono_responses

                return ("mono",), mono_responses(field, *poses)[0]

    def encode(self, name: IrFormat) -> bytes:
        """Write the IR in a format. The samples are the same in all formats, and the same IR gives the same bytes."""
        buffer = io.BytesIO()
        match name:
            case "wav":
                buffer.write(wav_bytes(self.samples, self.sample_rate))
            case "npy":
                np.save(buffer, self.samples, allow_pickle=False)
            case "json":
                buffer.write(json.dumps(self._document()).encode())
            case "sofa":
                buffer.write(self.sofa_head([self.query]) + self.sofa_samples())
        return buffer.getvalue()

    def sofa_head(self, queries: Sequence[IrQuery]) -> bytes:
        """Return the beginning of a SOFA file of the responses to `queries`, which have this one's output, head and
        length. The `sofa_samples` of each have to follow."""
        from server.responses.room_sofa import Measurement, room_sofa_head

        assert self.bundle is not None  # of every response that was computed
        of_head = self.bundle.manifest.direct_sound == "geometry" or self.query.output == "binaural"
        return room_sofa_head(
            self.bundle,
            [Measurement(each.listener, Quaternion(*orientations_of(each.heads)[0]), each.emitter) for each in queries],
            self.channels,
            samples=self.samples.shape[1],
            level=self.level,
            head=self.query.hrtf if of_head else None,
            order=self.query.order,
        )

    def sofa_samples(self) -> bytes:
        """Return the samples as they stand in a SOFA file."""
        return self.samples.astype("<f8").tobytes()

    def _document(self) -> dict[str, object]:
        return {
            "scene": self.scene,
            "level": self.level,
            **self.query.told(),
            "sample_rate": self.sample_rate,
            "channels": list(self.channels),
            "samples": self.samples.tolist(),
        }
