"""Impulse responses for many poses: the request in JSON, and answers that are written response by response, so that
memory does not grow with their number.

Everything but the poses is common to all responses of a batch: quality level, output, head and format. They have the
same channels and the same length then.
"""

import io
import json
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from typing import IO, Annotated, Any, Final, Literal, Protocol, get_args

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, ValidationError
from pydantic_core import PydanticCustomError

from server.acoustics.geometry import FARTHEST_M, Quaternion, orientations_of
from server.acoustics.spherical_harmonics import HIGHEST_ORDER, harmonic_count
from server.core.errors import RequestError
from server.core.json_keys import DoubledKeyError, require_distinct_keys
from server.core.near_names import suggestion
from server.core.numerals import as_whole
from server.core.zip_parts import ZipParts
from server.field.field import AcousticField
from server.responses.impulse_response import USUAL_ORDER, ImpulseResponse, IrOutput, IrQuery, own_output
from server.scene.door import MOST_DOORS, OpenShare

BatchFormat = Literal["npz", "zip", "sofa"]
BATCH_FORMATS: Final[tuple[BatchFormat, ...]] = get_args(BatchFormat)
BATCH_MEDIA_TYPES: Final[dict[BatchFormat, str]] = {
    "npz": "application/zip",
    "zip": "application/zip",
    "sofa": "application/x-sofa",
}
MOST_BYTES: Final = 2**30
"""The longest answer, in bytes of samples."""
_SAMPLE_BYTES: Final = {"npz": 4, "zip": 4, "sofa": 8}
_TURN_DEG: Final = 36_000

BATCH_EXAMPLE: Final = {
    "poses": [
        {"listener": [1, 2, 1.5], "emitter": [6, 3, 1.5], "yaw_deg": 90},
        {"listener": [2, 2, 1.5], "emitter": [6, 3, 1.5], "orientation": [0, 0, 0.707, 0.707]},
    ],
    "format": "npz",
}
_Coordinate = Annotated[FiniteFloat, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
_Place = Annotated[
    tuple[_Coordinate, _Coordinate, _Coordinate], Field(description="x, y, z in metres", examples=[[1.0, 2.0, 1.5]])
]
_LEAST, _MOST = 1e-6, 1e6
_Component = Annotated[FiniteFloat, Field(ge=-_MOST, le=_MOST)]


def _require_length(components: tuple[float, ...]) -> tuple[float, ...]:
    if max(map(abs, components)) < _LEAST:
        raise PydanticCustomError("no_length", "one component has to be {least} or more", {"least": _LEAST})
    return components


_Orientation = Annotated[
    tuple[_Component, _Component, _Component, _Component],
    AfterValidator(_require_length),
    Field(json_schema_extra={"contains": {"anyOf": [{"minimum": _LEAST}, {"maximum": -_LEAST}]}}),
]
_Degrees = Annotated[FiniteFloat, Field(ge=-_TURN_DEG, le=_TURN_DEG)]
_POSE_FIELDS: Final = frozenset({"listener", "emitter", "yaw_deg", "pitch_deg", "roll_deg", "orientation"})
_CODES: Final = {"output": "unknown_output", "format": "unknown_format"}
_LONGEST_NAME: Final = 256


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")


class PosePair(_Strict):
    """A listener and an emitter. The listener's head turns by three angles in degrees or by a quaternion, not by both;
    without them it looks along +x."""

    listener: _Place
    emitter: _Place
    yaw_deg: Annotated[_Degrees | None, Field(description="of the head, counter-clockwise, 0 looks along +x")] = None
    pitch_deg: Annotated[_Degrees | None, Field(description="of the head after its yaw, nose up")] = None
    roll_deg: Annotated[_Degrees | None, Field(description="of the head after its pitch, right ear down")] = None
    orientation: Annotated[
        _Orientation | None, Field(description="x, y, z, w: a quaternion of the head, in place of the angles")
    ] = None


class ResponseBatch(_Strict):
    """Poses, and what is common to their responses."""

    poses: Annotated[tuple[PosePair, ...], Field(min_length=1)]
    level: Annotated[
        str | None, Field(max_length=_LONGEST_NAME, description="quality level; by default the scene's first")
    ] = None
    output: Annotated[
        IrOutput | None, Field(description="by default binaural, or mono where one microphone measured")
    ] = None
    order: Annotated[
        Annotated[int, Field(ge=1, le=HIGHEST_ORDER), BeforeValidator(as_whole)] | None,
        Field(description="of ambisonics; by default 1"),
    ] = None
    hrtf: Annotated[
        str | None,
        Field(
            max_length=_LONGEST_NAME,
            description="head of binaural responses, one of GET /v1/hrtfs; by default kemar",
        ),
    ] = None
    doors: Annotated[
        dict[Annotated[str, Field(max_length=64)], OpenShare] | None,
        Field(max_length=MOST_DOORS, description="how far doors of the scene are open, by name"),
    ] = None
    format: Annotated[
        BatchFormat | None,
        Field(description="npz for NumPy (the default), zip of WAV files, or one sofa file (SingleRoomSRIR)"),
    ] = None

    @property
    def file_format(self) -> BatchFormat:
        return self.format or "npz"

    @classmethod
    def parse(cls, text: bytes, *, most: int = sys.maxsize) -> "ResponseBatch":
        """Read a batch of at most so many poses. Raises RequestError, which names the field at fault, such as
        `poses[3].listener`."""
        try:
            batch = cls.model_validate_json(text)
            require_distinct_keys(text)
        except ValidationError as exc:
            raise _refusal(exc) from exc
        except DoubledKeyError as exc:
            raise RequestError("malformed_request", str(exc), field=exc.key) from exc
        if len(batch.poses) > most:
            problem = f"poses: {len(batch.poses)} are more than {most}: send several requests"
            raise RequestError("too_many_poses", problem, field="poses")
        return batch

    def queries(self, field: AcousticField) -> tuple[IrQuery, ...]:
        """Return a query for each pose. Raises RequestError, as `IrQuery.checked` does, and for an answer of more than
        `MOST_BYTES`."""
        queries = tuple(self._query(field, number) for number in range(len(self.poses)))
        most = MOST_BYTES // (self._channels(field) * field.ir_samples * _SAMPLE_BYTES[self.file_format])
        if len(queries) > most:
            problem = f"poses: the answer is longer than {MOST_BYTES >> 20} MiB, which {most} poses fit: send fewer"
            raise RequestError("answer_too_long", problem, field="poses", status=409)
        return queries

    def _channels(self, field: AcousticField) -> int:
        match self.output or own_output(field):
            case "binaural":
                return 2
            case "mono":
                return 1
            case "ambisonics":
                return harmonic_count(self.order or USUAL_ORDER)

    def _query(self, field: AcousticField, number: int) -> IrQuery:
        pair = self.poses[number]
        try:
            return IrQuery.checked(
                field,
                pair.listener,
                pair.emitter,
                orientation=None if pair.orientation is None else Quaternion(*pair.orientation),
                yaw_deg=pair.yaw_deg,
                pitch_deg=pair.pitch_deg,
                roll_deg=pair.roll_deg,
                output=self.output,
                order=self.order,
                hrtf=self.hrtf,
            )
        except RequestError as exc:
            if exc.field not in _POSE_FIELDS:
                raise
            place = f"poses[{number}]"
            raise RequestError(exc.code, f"{place}: {exc}", field=f"{place}.{exc.field}", status=exc.status) from exc

    def writer(self, queries: Sequence[IrQuery]) -> "BatchWriter":
        """Return a writer of the responses to `queries` in this batch's format."""
        match self.file_format:
            case "npz":
                return _NpzWriter(queries)
            case "zip":
                return _WavWriter(queries)
            case "sofa":
                return _SofaWriter(queries)


class BatchWriter(Protocol):
    """Writes one answer. `add` is called once for the response to each query, in their order, and then `end`; what they
    return is the answer, part by part."""

    def add(self, response: ImpulseResponse) -> bytes: ...

    def end(self) -> bytes: ...


class _NpzWriter:
    """Arrays `responses` (pose, channel, sample), `listeners` and `emitters` (pose, 3), `orientations` (pose, 4) as
    unit quaternions, `channels`, `sample_rate`, `scene` and `level`."""

    def __init__(self, queries: Sequence[IrQuery]) -> None:
        self._queries = queries
        self._zip = ZipParts()
        self._open = ExitStack()
        self._responses: IO[bytes] | None = None

    def add(self, response: ImpulseResponse) -> bytes:
        if self._responses is None:
            self._responses = self._begin(response)
        self._responses.write(response.samples.astype("<f4").tobytes())
        return self._zip.take()

    def _begin(self, response: ImpulseResponse) -> IO[bytes]:
        """Write all arrays but the responses, of which only the header."""
        arrays = {
            "scene": np.array(response.scene),
            "level": np.array(response.level),
            "sample_rate": np.array(response.sample_rate),
            "channels": np.array(response.channels),
            "listeners": np.array([each.listener for each in self._queries]),
            "emitters": np.array([each.emitter for each in self._queries]),
            "orientations": np.concatenate([orientations_of(each.heads) for each in self._queries]),
        }
        for name, values in arrays.items():
            content = io.BytesIO()
            np.save(content, values, allow_pickle=False)
            self._zip.write(f"{name}.npy", content.getvalue())
        file = self._open.enter_context(self._zip.file("responses.npy"))
        shape = (len(self._queries), *response.samples.shape)
        np.lib.format.write_array_header_1_0(file, {"descr": "<f4", "fortran_order": False, "shape": shape})
        return file

    def end(self) -> bytes:
        self._open.close()
        return self._zip.end()


class _WavWriter:
    """A WAV file for each pose, named by its number, and `poses.json`, which says what each is."""

    def __init__(self, queries: Sequence[IrQuery]) -> None:
        self._queries = queries
        self._zip = ZipParts()
        self._written = 0

    def add(self, response: ImpulseResponse) -> bytes:
        if not self._written:
            told = [{"file": self._name(number), **query.told()} for number, query in enumerate(self._queries)]
            common = {
                "scene": response.scene,
                "level": response.level,
                "sample_rate": response.sample_rate,
                "channels": response.channels,
            }
            self._zip.write("poses.json", json.dumps({**common, "poses": told}).encode())
        self._zip.write(self._name(self._written), response.encode("wav"))
        self._written += 1
        return self._zip.take()

    def _name(self, number: int) -> str:
        return f"{number:0{len(str(len(self._queries) - 1))}}.wav"

    def end(self) -> bytes:
        return self._zip.end()


class _SofaWriter:
    """A file with a measurement for each pose."""

    def __init__(self, queries: Sequence[IrQuery]) -> None:
        self._queries = queries
        self._has_begun = False

    def add(self, response: ImpulseResponse) -> bytes:
        head = b"" if self._has_begun else response.sofa_head(self._queries)
        self._has_begun = True
        return head + response.sofa_samples()

    def end(self) -> bytes:
        return b""


def _refusal(error: ValidationError) -> RequestError:
    first: dict[str, Any] = dict(error.errors(include_url=False, include_input=False)[0])
    kind, place, reason = first["type"], first["loc"], str(first["msg"])
    field = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in place).removeprefix(".")
    names = [part for part in place if isinstance(part, str)]
    code = "malformed_request"
    if kind == "extra_forbidden":
        known = PosePair.model_fields if names[0] == "poses" else ResponseBatch.model_fields
        reason = f"unknown field{suggestion(names[-1], known)}"
    elif kind == "literal_error":
        code = _CODES[names[-1]]
    elif names and names[-1] in _POSE_FIELDS:
        code = "malformed_pose"
    return RequestError(code, f"{field}: {reason}" if field else f"the body: {reason}", field=field or None)
