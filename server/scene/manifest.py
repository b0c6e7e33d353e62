"""`scene.json`, the manifest of a scene bundle.

A field predicts what arrives at the ears of one head, or what arrives from each direction, from which the server
computes what any head hears. Bundles with a mesh have format 4; of the others, those with a field of directions have
format 3, and all the rest have format 2.

The fields of a bundle hold the reflected field only, and the server computes the direct sound from geometry. With
`image_order` 1 the server also computes the early reflections, and the fields hold only the late reverberation.
Responses that were measured cannot be separated like that: with `direct_sound` "field" the fields hold everything, for
one microphone or two ears. If the walls of such a place are unknown, there is no `geometry`, and the place is the box
of `bounds`.
"""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import (
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    field_validator,
    model_serializer,
    model_validator,
)

from server.acoustics.air import absorption_db_per_m
from server.acoustics.bands import FILTER_BANDS_HZ, OCTAVE_BANDS_HZ
from server.acoustics.cells import Axis
from server.acoustics.codec import Codec
from server.acoustics.geometry import FloorPlan
from server.acoustics.mesh import MOST_MATERIALS
from server.acoustics.spherical_harmonics import HIGHEST_ORDER
from server.scene.door import MOST_DOORS, Door, DoorName
from server.scene.effects import EffectName
from server.scene.geometry import Finite, Geometry, Material, Point, Strict
from server.scene.limits import FEWEST_SAMPLES, HIGHEST_RATE_HZ, LOWEST_RATE_HZ, MOST_SAMPLES

ARRAYS_FILE = "arrays.npz"
NO_FIELD = "none"
"""Name of the field in the only level of a scene without fields."""
EARS_FORMAT: Literal[2] = 2
DIRECTIONS_FORMAT: Literal[3] = 3
"""The format of a bundle with a field that predicts directions."""
MESH_FORMAT: Literal[4] = 4
"""The format of a bundle whose surfaces are a mesh."""

FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


class Bounds(Strict):
    """The box of positions that the fields were trained for, in metres."""

    minimum: Point
    maximum: Point

    @model_validator(mode="after")
    def _is_a_box(self) -> "Bounds":
        if any(low >= high for low, high in zip(self.minimum, self.maximum, strict=True)):
            raise ValueError("minimum must lie below maximum on every axis")
        return self


class SceneMesh(Strict):
    """Surfaces as triangles. `file` is an archive of arrays: `vertices_m` (vertex, 3) float64; `triangles` (triangle,
    3) int32, counter-clockwise as seen from the air; `surfaces` (triangle,) int32, the number of each triangle's
    material in `materials`, (material,) names. What these names are made of is in `materials` here. With `open_sky`,
    the surfaces enclose no air, and sound may leave. The leaves of `doors` are apart from the rest, at most eight."""

    file: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*\.npz$")]
    materials: Annotated[dict[str, Material], Field(min_length=1, max_length=MOST_MATERIALS)]
    open_sky: bool = False
    doors: tuple[Door, ...] = ()

    @field_validator("doors")
    @classmethod
    def _are_few_and_have_names_of_their_own(cls, doors: tuple[Door, ...]) -> tuple[Door, ...]:
        if len(doors) > MOST_DOORS:
            raise ValueError(
                f"there are {len(doors)}, and a scene has at most {MOST_DOORS}: leave those that never move in the mesh"
            )
        for what in ("name", "mesh"):
            given = [getattr(door, what) for door in doors]
            if twice := [each for each in given if given.count(each) > 1]:
                raise ValueError(f"two have the {what} {twice[0]!r}")
        return doors

    @model_serializer(mode="wrap")
    def _without_doors_that_are_none(self, write: SerializerFunctionWrapHandler) -> dict[str, object]:
        document: dict[str, object] = write(self)
        if not self.doors:
            document.pop("doors", None)
        return document


class Start(Strict):
    """Poses of listener and emitter at the beginning of a visit."""

    listener: Point
    listener_yaw_deg: Finite = 0.0
    emitter: Point


class Air(Strict):
    """Temperature and humidity of the air, which decide its absorption. The speed of sound is a separate value."""

    temperature_c: Annotated[float, Field(ge=-20, le=50)] = 20.0
    relative_humidity: Annotated[float, Field(ge=0.05, le=1)] = 0.5

    @property
    def absorption_db_per_m(self) -> npt.NDArray[np.float64]:
        """(band,) absorption at OCTAVE_BANDS_HZ."""
        return self._absorption_db_per_m(OCTAVE_BANDS_HZ)

    @property
    def filter_db_per_m(self) -> npt.NDArray[np.float64]:
        """(band,) absorption at FILTER_BANDS_HZ, for filters of paths."""
        return self._absorption_db_per_m(FILTER_BANDS_HZ)

    def _absorption_db_per_m(self, frequencies_hz: tuple[float, ...]) -> npt.NDArray[np.float64]:
        return absorption_db_per_m(
            frequencies_hz, temperature_c=self.temperature_c, relative_humidity=self.relative_humidity
        )


class CodecParameters(Strict):
    """Parameters of a field's spectrograms.

    `samples` is the length of a response after alignment: at sample `lead_samples` sound can first arrive.
    `known_frames` is the number of frames whose phase the field predicts. `frame_cells` gives the number of frames that
    each column of log-magnitude and coherence stands for. A column is the value at the centre of its frames; between
    centres values are interpolated linearly. Without `frame_cells` every frame has its own column.
    """

    sample_rate: Annotated[int, Field(ge=LOWEST_RATE_HZ, le=HIGHEST_RATE_HZ)]
    n_fft: Annotated[int, Field(ge=64, le=4096)]
    hop: Annotated[int, Field(ge=16)]
    samples: Annotated[int, Field(ge=FEWEST_SAMPLES, le=MOST_SAMPLES)]
    lead_samples: Annotated[int, Field(ge=0)]
    known_frames: Annotated[int, Field(ge=0)]
    log_floor: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    frame_cells: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(max_length=2048)] | None = None

    @model_validator(mode="after")
    def _overlaps_four_times(self) -> "CodecParameters":
        if self.n_fft != 4 * self.hop:
            raise ValueError("hop must be a quarter of n_fft")
        return self

    @model_validator(mode="after")
    def _counts_within_a_response(self) -> "CodecParameters":
        if self.samples < self.n_fft:
            raise ValueError(f"samples must not be below n_fft, {self.n_fft}")
        if self.lead_samples >= self.samples:
            raise ValueError(f"lead_samples must be below samples, {self.samples}")
        if self.known_frames > self.codec.frames:
            raise ValueError(f"known_frames must not exceed the {self.codec.frames} frames of a response")
        if self.frame_cells is not None and sum(self.frame_cells) != self.codec.frames:
            raise ValueError(f"frame_cells must cover the {self.codec.frames} frames of a response")
        return self

    @property
    def frame_axis(self) -> Axis | None:
        """The cells of frames; None if every frame has its own column."""
        return None if self.frame_cells is None else Axis(np.cumsum([0, *self.frame_cells]))

    @property
    def columns(self) -> int:
        """Number of columns of log-magnitude: frames, or cells of frames."""
        return self.codec.frames if self.frame_cells is None else len(self.frame_cells)

    @property
    def codec(self) -> Codec:
        return Codec(self.sample_rate, self.n_fft, self.hop, self.samples, self.log_floor)


class FieldFile(Strict):
    """One trained network: its ONNX file, the rank of its output basis if it has one, and its `codec` if that differs
    from the bundle's.

    ears: the field predicts spectrograms at the ears of one head, or its response. directions: it predicts the power
    that arrives per octave band, and from where, in spherical harmonics up to `order`.

    `doors` are the doors whose openness the network takes, in this order. A field without any knows no doors: what
    reverberates is then the same in all states, and the way of its first sound is not.
    """

    file: FileName
    architecture: str
    rank: Annotated[int, Field(ge=1)] | None = None
    codec: CodecParameters | None = None
    predicts: Literal["ears", "directions"] = "ears"
    order: Annotated[int, Field(ge=0, le=HIGHEST_ORDER)] | None = None
    doors: tuple[DoorName, ...] = ()

    @field_validator("doors")
    @classmethod
    def _are_told_once(cls, doors: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(doors)) < len(doors):
            raise ValueError("one is there twice: name each door once")
        return doors

    @model_validator(mode="after")
    def _has_an_order_if_it_has_directions(self) -> "FieldFile":
        if (self.predicts == "directions") != (self.order is not None):
            raise ValueError("order: a field that predicts directions has one, any other has none")
        return self

    @model_serializer(mode="wrap")
    def _without_what_format_2_lacks(self, write: SerializerFunctionWrapHandler) -> dict[str, object]:
        document: dict[str, object] = write(self)
        if self.predicts == "ears":
            document.pop("predicts", None)
            document.pop("order", None)
        if not self.doors:
            document.pop("doors", None)
        return document


class Phase(Strict):
    """The source of the phase that a field does not predict.

    frozen: one noise signal per scene, mixed to the predicted interaural coherence. integrated: the predicted
    instantaneous frequency, summed over all frames that have one. griffin_lim: `iterations` of the Griffin-Lim
    algorithm, from zero phase or, if `warm`, from the phase last found near the pose.
    """

    kind: Literal["frozen", "integrated", "griffin_lim"] = "frozen"
    iterations: Annotated[int, Field(ge=0, le=256)] = 0
    warm: bool = False

    @model_validator(mode="after")
    def _iterates_where_that_means_something(self) -> "Phase":
        if (self.kind == "griffin_lim") != (self.iterations > 0):
            raise ValueError("iterations: griffin_lim has one at least, any other kind none")
        if self.warm and self.kind != "griffin_lim":
            raise ValueError("warm: only griffin_lim starts from somewhere")
        return self


class Accuracy(Strict):
    """Mean errors by metric over `pairs` held-out pairs, each at `yaws` head orientations, and the repeatability floor.
    `steps` are the largest changes between poses a centimetre apart, by metric, in just-noticeable differences."""

    pairs: int
    yaws: int
    errors: dict[str, Finite]
    floor: dict[str, Finite]
    steps: Annotated[dict[str, Finite], Field(default_factory=dict)]


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


def _without_filled(schema: dict[str, Any]) -> None:
    """Say in the schema of `Cost` that what is filled in may be missing."""
    schema["required"] = [name for name in schema["required"] if name not in {"ms_mean", "ms_miss"}]


class Cost(Strict):
    """Time on one core of `host` from a pose until its binaural response is ready to be convolved.

    `ms_p50`, `ms_p99` and `ms_mean` are over the poses of a walk. `ms_miss` is the median over poses for which no kept
    response could be reused; deadlines have to allow for it. If `ms_mean` or `ms_miss` was not measured, it equals
    `ms_p50`. `ms_turn` is the median over poses of a head that has only turned, next to nothing with a bus. All these
    are per emitter. `block_us` is the time in microseconds to render a block of 256 samples in which nothing changes,
    per emitter of four. `ms_turn` and `block_us` are absent if they were not measured. `storage_mb` is the size of the
    field's file, `memory_mb` the memory that serving it adds to a process.
    """

    model_config = ConfigDict(json_schema_extra=_without_filled)

    ms_p50: Positive
    ms_p99: Positive
    ms_mean: Positive
    ms_miss: Positive
    ms_turn: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = None
    block_us: Positive | None = None
    storage_mb: Positive
    memory_mb: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    host: str

    @model_validator(mode="before")
    @classmethod
    def _takes_as_long_every_time(cls, values: object) -> object:
        if isinstance(values, dict) and "ms_p50" in values:
            return {"ms_mean": values["ms_p50"], "ms_miss": values["ms_p50"], **values}
        return values

    @model_serializer(mode="wrap")
    def _without_what_was_not_measured(self, write: SerializerFunctionWrapHandler) -> dict[str, object]:
        document: dict[str, object] = write(self)
        return {name: value for name, value in document.items() if value is not None}


class Reuse(Strict):
    """Reuse of responses. They are computed only at the nodes of a lattice and kept; a pose gets the response of its
    nearest node.

    Nodes are at most `spacing_m` apart along each axis, for listener and emitter alike, and headings at most
    `turn_deg`. Early reflections computed from geometry are those of the `pose` itself, or those of its `node` and kept
    with the response. The direct sound is always that of the pose itself.
    """

    spacing_m: Positive
    turn_deg: Annotated[float, Field(gt=0, le=360)]
    first_reflections: Literal["pose", "node"] = "pose"


class QualityLevel(Strict):
    """A point on the accuracy-cost frontier. `accuracy` and `cost` are absent until they are measured.

    With `frames` only that many frames of a response are computed, and the rest is silent. An emitter gets at most
    `ir_rate_hz` responses per second or, without that, one for every pose. With `shared_tail` all emitters of a
    listener share one late reverberation. With `reuse` poses near each other share responses. `tail` is how the end of
    a response is made: as its beginning, by an inverse transform of spectrograms (stft), or from frozen noises in
    octave bands, whose gains follow the prediction (bands; for fields of directions). `order` is the highest order of
    the directions' harmonics that is used; by default, all are. With `bus` (for fields of directions) headphones hear
    reflected sound as ambisonic channels of this order, mixed of all emitters and turned with the head: a turn asks for
    no response. By default each emitter has a response of two ears.
    """

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$")]
    field: str
    phase: Phase = Phase()
    frames: Annotated[int, Field(ge=1)] | None = None
    reuse: Reuse | None = None
    ir_rate_hz: Positive | None = None
    shared_tail: bool = False
    tail: Literal["stft", "bands"] = "stft"
    order: Annotated[int, Field(ge=0, le=HIGHEST_ORDER)] | None = None
    bus: Annotated[int, Field(ge=1, le=HIGHEST_ORDER)] | None = None
    accuracy: Accuracy | None = None
    cost: Cost | None = None

    @model_serializer(mode="wrap")
    def _without_what_format_2_lacks(self, write: SerializerFunctionWrapHandler) -> dict[str, object]:
        document: dict[str, object] = write(self)
        if self.tail == "stft":
            document.pop("tail", None)
        for name in ("order", "bus"):
            if getattr(self, name) is None:
                document.pop(name, None)
        return document


class FrontierPoint(Strict):
    """A level that was measured but is not offered. Its field, of this `architecture` and `rank`, need not be in the
    bundle."""

    level: QualityLevel
    architecture: str
    rank: Annotated[int, Field(ge=1)] | None = None


class DataReference(Strict):
    """Measurements of the responses that a scene's fields were trained on, made as `nafir check` measures fields. If
    these responses rise, or are louder than a diffuse field could be, the fields may do the same.

    `rises_db` are the greatest rises, over all responses, that end in each window of `window_s`. `energy_excess_db` is
    the greatest energy of any response, relative to the energy that the walls' absorption allows.
    """

    responses: Annotated[int, Field(ge=1)]
    window_s: Positive
    rises_db: Annotated[tuple[Annotated[float, Field(ge=0, allow_inf_nan=False)], ...], Field(max_length=65536)]
    energy_excess_db: Finite | None = None


class AcceptedLaw(Strict):
    """A law of `nafir check` that the fields break, and the reason why the scene is offered all the same."""

    law: str
    reason: Annotated[str, Field(min_length=1, max_length=1000)]


class Manifest(Strict):
    """The content of `scene.json`."""

    format_version: Literal[2, 3, 4] = EARS_FORMAT
    """4 if there is a mesh, else 3 if a field predicts directions, else 2."""
    id: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]
    """Identifier by which clients ask for the scene."""
    name: str
    """Name shown on the page."""
    description: str = ""
    geometry: Geometry | None = None
    """Walls, openings and materials; absent if they are unknown, as of measured places, or given as a mesh."""
    mesh: SceneMesh | None = None
    """Surfaces as triangles with their materials, in place of a floor plan."""
    bounds: Bounds
    speed_of_sound: Annotated[float, Field(gt=100, lt=1000)]
    """Metres per second."""
    air: Air = Air()
    """Temperature and humidity, from which the absorption by air is computed."""
    image_order: Literal[0, 1] = 0
    """Order of the reflections that the server computes from geometry and the fields do not hold: none, or those from
    one surface."""
    transmission: bool = False
    """Whether the server renders sound through walls, by their surface mass. Otherwise no sound goes through them."""
    start: Start
    """Poses at the beginning of a visit."""
    direct_sound: Literal["geometry", "field"] = "geometry"
    """Whether the direct sound is computed from geometry or held by the fields' responses."""
    reference_level_db: Finite = 0.0
    """Level of the direct sound one metre from an emitter, in the unit of the fields' responses. Sound and maps are
    rendered as if it were 0."""
    channels: tuple[Literal["left"], Literal["right"]] | tuple[Literal["mono"]] = ("left", "right")
    """Channels of the fields' responses: two ears or one microphone."""
    codec: CodecParameters
    """Parameters of the fields' spectrograms, unless a field has its own."""
    fields: dict[str, FieldFile]
    """The trained networks by name; empty if there is no reverberation, as outdoors."""
    levels: Annotated[tuple[QualityLevel, ...], Field(min_length=1)]
    """The quality levels on offer, the default first."""
    frontier: tuple[FrontierPoint, ...] = ()
    """Measured levels on the frontier that are not offered because they are too near one of `levels`."""
    effects: Mapping[EffectName, bool] = Field(default_factory=dict)
    """Effects that are always on or always off. The planner decides about all others."""
    reference: DataReference | None = None
    """Measurements of the responses that the fields were trained on; absent if there are none."""
    accepted: tuple[AcceptedLaw, ...] = ()
    """Laws of `nafir check` that the scene breaks for a stated reason."""
    files: dict[FileName, Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]]
    """SHA-256 of every other file of the bundle."""

    @field_validator("format_version", mode="before")
    @classmethod
    def _is_of_this_format(cls, version: object) -> object:
        if version == 1:
            raise ValueError("is 1, whose fields hold the direct sound too: simulate, train and export the scene anew")
        return version

    @model_validator(mode="after")
    def _refers_to_what_exists(self) -> "Manifest":
        for name, field in self.fields.items():
            if field.file not in self.files:
                raise ValueError(f"fields.{name}.file: {field.file} is not listed in files")
            if field.codec is not None and field.codec.sample_rate != self.codec.sample_rate:
                raise ValueError(f"fields.{name}.codec.sample_rate: must be the scene's, {self.codec.sample_rate}")
            if field.predicts == "directions" and (field.codec or self.codec).known_frames:
                raise ValueError(f"fields.{name}.codec.known_frames: must be 0, directions have no phase")
        has_directions = any(field.predicts == "directions" for field in self.fields.values())
        expected = MESH_FORMAT if self.mesh else DIRECTIONS_FORMAT if has_directions else EARS_FORMAT
        if self.format_version != expected:
            what = "a mesh makes" if self.mesh else "fields like these make"
            raise ValueError(f"format_version: is {self.format_version}, but {what} it {expected}")
        if has_directions and (len(self.channels) == 1 or self.direct_sound == "field"):
            raise ValueError("fields: directions are those of late reverberation; the direct sound is from geometry")
        if has_directions and self.image_order == 0:
            raise ValueError(
                "image_order: must be 1: fields of directions hold what follows the first reflections; the server "
                "computes these"
            )
        if not self.fields:
            return self._has_no_field()
        for level in self.levels:
            if level.field not in self.fields:
                raise ValueError(f"levels.{level.name}.field: there is no field {level.field}")
            field = self.fields[level.field]
            if field.predicts == "directions" and (level.reuse is not None or level.phase.kind == "integrated"):
                raise ValueError(
                    f"levels.{level.name}: a field of directions is heard anew at every pose and predicts no phase; "
                    "leave out reuse, and take another phase than integrated"
                )
            if level.bus is not None and field.predicts != "directions":
                raise ValueError(f"levels.{level.name}.bus: is for fields of directions")
            if level.order is not None and (field.order is None or level.order > field.order):
                has = "no directions" if field.order is None else f"order {field.order}"
                raise ValueError(f"levels.{level.name}.order: is {level.order}, but field {level.field} has {has}")
            if level.tail == "bands" and (
                field.predicts == "ears" or level.frames is not None or level.phase.kind != "frozen"
            ):
                raise ValueError(
                    f"levels.{level.name}.tail: bands are for fields of directions, with frozen phase and all frames"
                )
            codec = (field.codec or self.codec).codec
            if level.frames is not None and level.frames > codec.frames:
                raise ValueError(f"levels.{level.name}.frames: the field has {codec.frames}")
        if len({level.name for level in self.levels}) < len(self.levels):
            raise ValueError("levels: two have the same name")
        if ARRAYS_FILE not in self.files:
            raise ValueError(f"files: {ARRAYS_FILE} is not listed")
        return self

    def _has_no_field(self) -> "Manifest":
        if len(self.levels) > 1 or self.levels[0].field != NO_FIELD or self.levels[0].reuse is not None:
            raise ValueError(f"levels: a scene without fields has one level, of field {NO_FIELD!r}")
        if self.levels[0].tail != "stft":
            raise ValueError(f"levels.{self.levels[0].name}.tail: bands are for fields of directions")
        if self.levels[0].bus is not None:
            raise ValueError(f"levels.{self.levels[0].name}.bus: is for fields of directions")
        if self.levels[0].order is not None:
            raise ValueError(f"levels.{self.levels[0].name}.order: a scene without fields has no directions")
        if self.direct_sound == "field":
            raise ValueError("direct_sound: there is no field that could hold it")
        return self

    @model_validator(mode="after")
    def _has_a_mesh_or_a_plan(self) -> "Manifest":
        if self.mesh is None:
            return self
        if self.geometry is not None:
            raise ValueError("mesh: there is a floor plan in geometry too: leave one of them out")
        if self.mesh.file == ARRAYS_FILE:
            raise ValueError(f"mesh.file: {ARRAYS_FILE} is for frozen_noise: give the mesh a file of its own")
        if self.mesh.file not in self.files:
            raise ValueError(f"mesh.file: {self.mesh.file} is not listed in files")
        for door in self.mesh.doors:
            if door.mesh in (ARRAYS_FILE, self.mesh.file) or door.mesh not in self.files:
                raise ValueError(
                    f"mesh.doors.{door.name}.mesh: give the leaf a file of its own that is listed in files"
                )
        for level in self.levels:
            if level.reuse is not None:
                raise ValueError(f"levels.{level.name}.reuse: is for floor plans: leave it out where there is a mesh")
        return self

    @model_validator(mode="after")
    def _has_the_doors_that_its_fields_know(self) -> "Manifest":
        names = [] if self.mesh is None else [door.name for door in self.mesh.doors]
        for field, entry in self.fields.items():
            if unknown := [name for name in entry.doors if name not in names]:
                known = ", ".join(names) or "none"
                raise ValueError(f"fields.{field}.doors: {unknown[0]!r} is not in mesh.doors, which are {known}")
        return self

    @model_validator(mode="after")
    def _computes_what_can_be_computed(self) -> "Manifest":
        if self.image_order > 0 and self.geometry is None and self.mesh is None:
            raise ValueError("image_order: reflections cannot be computed without geometry")
        if self.image_order > 0 and self.direct_sound == "field":
            raise ValueError("image_order: fields that hold the direct sound hold the first reflections too")
        if self.direct_sound == "field" and any(level.reuse is not None for level in self.levels):
            raise ValueError("levels: responses that hold the direct sound cannot be those of another place (reuse)")
        if len(self.channels) == 1 and self.direct_sound == "geometry":
            raise ValueError(
                "direct_sound: responses of one microphone have to hold it; it is computed for two ears only"
            )
        return self

    @property
    def floor_plan(self) -> FloorPlan:
        """The floor plan of the geometry or, without one, the empty box of the bounds. Sound in a mesh is not computed
        by it."""
        if self.geometry is not None:
            return self.geometry.floor_plan
        (west, south, low), (east, north, high) = self.bounds.minimum, self.bounds.maximum
        return FloorPlan(((west, south), (east, south), (east, north), (west, north)), high, low)

    @model_serializer(mode="wrap")
    def _without_what_format_3_lacks(self, write: SerializerFunctionWrapHandler) -> dict[str, object]:
        document: dict[str, object] = write(self)
        if self.mesh is None:
            document.pop("mesh", None)
        return document

    @model_validator(mode="after")
    def _fits_into_the_room(self) -> "Manifest":
        plan = self.floor_plan
        room = (*np.min(plan.corners, axis=0), plan.floor_m), (*np.max(plan.corners, axis=0), plan.height_m)
        if not _within(self.bounds.minimum, *room) or not _within(self.bounds.maximum, *room):
            raise ValueError("bounds: must lie in the box around geometry.corners, up to geometry.height_m")
        for name, position in (("listener", self.start.listener), ("emitter", self.start.emitter)):
            in_bounds = _within(position, self.bounds.minimum, self.bounds.maximum)
            if not in_bounds or not plan.contains(np.array(position)):
                raise ValueError(f"start.{name}: must be within bounds and not inside a wall")
        return self


def _within(position: Point, low: Point, high: Point) -> bool:
    return all(least <= at <= most for least, at, most in zip(low, position, high, strict=True))
