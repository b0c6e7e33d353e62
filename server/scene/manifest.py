"""`scene.json`: what a scene bundle says of itself.

Since format 2 the responses of a bundle's fields hold what follows the direct sound and not the direct sound itself,
which the server computes from geometry. With `image_order` 1 it computes the first reflections too, and the fields hold
what follows those. Where responses were measured nobody can take the direct sound out of them: `direct_sound` says that
the fields hold all of it, through one microphone or two ears. Of such a place often no walls are known either; then
there is no `geometry`, and the place is what lies within `bounds`.
"""

from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, field_validator, model_validator

from server.acoustics.air import absorption_db_per_m
from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.cells import Axis
from server.acoustics.codec import Codec
from server.acoustics.geometry import FloorPlan
from server.scene.effects import EffectName
from server.scene.geometry import Finite, Geometry, Point, Strict
from server.scene.limits import FEWEST_SAMPLES, HIGHEST_RATE_HZ, LOWEST_RATE_HZ, MOST_SAMPLES

ARRAYS_FILE = "arrays.npz"
NO_FIELD = "none"
"""What the level of a scene without fields is of."""
FORMAT_VERSION: Literal[2] = 2

FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]


class Bounds(Strict):
    """The box of positions the field was trained for, metres."""

    minimum: Point
    maximum: Point

    @model_validator(mode="after")
    def _is_a_box(self) -> "Bounds":
        if any(low >= high for low, high in zip(self.minimum, self.maximum, strict=True)):
            raise ValueError("minimum must lie below maximum on every axis")
        return self


class Start(Strict):
    """Where a visitor finds listener and emitter."""

    listener: Point
    listener_yaw_deg: Finite = 0.0
    emitter: Point


class Air(Strict):
    """How much sound the air absorbs on the way; the speed of sound is stated on its own."""

    temperature_c: Annotated[float, Field(ge=-20, le=50)] = 20.0
    relative_humidity: Annotated[float, Field(ge=0.05, le=1)] = 0.5

    @property
    def absorption_db_per_m(self) -> npt.NDArray[np.float64]:
        """(band,) at OCTAVE_BANDS_HZ."""
        return absorption_db_per_m(
            OCTAVE_BANDS_HZ, temperature_c=self.temperature_c, relative_humidity=self.relative_humidity
        )


class CodecParameters(Strict):
    """How the field's spectrograms are to be read.

    `samples` is the length of a response after alignment: sample `lead_samples` is the moment sound can first arrive.
    `known_frames` is the number of frames whose phase the field predicts. Where there are `frame_cells`, each column of
    log-magnitude and coherence stands for so many frames in place of one: it is what their centre has, and values
    between two centres go linearly from one to the other.
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
        """Of the cells of frames; None where every frame is told."""
        return None if self.frame_cells is None else Axis(np.cumsum([0, *self.frame_cells]))

    @property
    def columns(self) -> int:
        """That log-magnitude has: frames, or cells of them."""
        return self.codec.frames if self.frame_cells is None else len(self.frame_cells)

    @property
    def codec(self) -> Codec:
        return Codec(self.sample_rate, self.n_fft, self.hop, self.samples, self.log_floor)


class FieldFile(Strict):
    """One trained network: an ONNX file, the rank of its output basis where it has one, and its own `codec` where that
    differs from the bundle's."""

    file: FileName
    architecture: str
    rank: Annotated[int, Field(ge=1)] | None = None
    codec: CodecParameters | None = None


class Phase(Strict):
    """Where the phase comes from that a field does not know.

    frozen: noise that stands still, one per scene, mixed to the predicted interaural coherence. integrated: the
    predicted instantaneous frequency, summed up over all frames it was predicted for. griffin_lim: `iterations` of
    Griffin and Lim's, from zero phase or, `warm`, from the phase last found near the pose.
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
    """Mean errors over `pairs` held-out pairs, each heard at `yaws` head orientations, by metric, and the
    repeatability floor. `steps` are the largest changes seen between poses a centimetre apart, by metric, in
    just-noticeable differences."""

    pairs: int
    yaws: int
    errors: dict[str, Finite]
    floor: dict[str, Finite]
    steps: Annotated[dict[str, Finite], Field(default_factory=dict)]


Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Cost(Strict):
    """What a pose takes on one core of `host` until its binaural response is ready to be convolved.

    `ms_p50`, `ms_p99` and `ms_mean` are over the poses of a walk; `ms_miss` is the median of those that found nothing
    kept to reuse, which is what a deadline has to bear. The last two are the median where they were not measured.
    `storage_mb` is that of the field's file, `memory_mb` what serving it adds to a process.
    """

    ms_p50: Positive
    ms_p99: Positive
    ms_mean: Positive
    ms_miss: Positive
    storage_mb: Positive
    memory_mb: Annotated[float, Field(ge=0, allow_inf_nan=False)]
    host: str

    @model_validator(mode="before")
    @classmethod
    def _takes_as_long_every_time(cls, values: object) -> object:
        if isinstance(values, dict) and "ms_p50" in values:
            return {"ms_mean": values["ms_p50"], "ms_miss": values["ms_p50"], **values}
        return values


class Reuse(Strict):
    """Responses are computed for the nodes of a lattice alone and kept: poses near a node have its response.

    Nodes are `spacing_m` apart at most along each axis, for listener and emitter alike, and headings at most
    `turn_deg`. The first reflections that geometry computes are those of the `pose` itself, or, kept with all else,
    those of its `node`. The direct sound is always the pose's own.
    """

    spacing_m: Positive
    turn_deg: Annotated[float, Field(gt=0, le=360)]
    first_reflections: Literal["pose", "node"] = "pose"


class QualityLevel(Strict):
    """A point on the accuracy-cost frontier; `accuracy` and `cost` are absent until they were measured.

    Of the response all is computed, or only the first `frames`, and the rest is silent; an emitter gets `ir_rate_hz`
    responses per second at most, or one with every pose; with `shared_tail` all emitters of a listener share one late
    tail; with `reuse` poses near each other share responses.
    """

    name: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9._-]*$")]
    field: str
    phase: Phase = Phase()
    frames: Annotated[int, Field(ge=1)] | None = None
    reuse: Reuse | None = None
    ir_rate_hz: Positive | None = None
    shared_tail: bool = False
    accuracy: Accuracy | None = None
    cost: Cost | None = None


class FrontierPoint(Strict):
    """A level that was measured and is not offered; what it would take of `architecture` and `rank` need not be in the
    bundle."""

    level: QualityLevel
    architecture: str
    rank: Annotated[int, Field(ge=1)] | None = None


class DataReference(Strict):
    """What the responses that a scene's fields were trained on do themselves, as `nafir check` measures fields: where a
    room's own responses rise, or are louder than a diffuse field could be, so may its fields.

    `rises_db` are the greatest rises that end in each window of `window_s`, of all responses measured;
    `energy_excess_db` is the most energy that any has, re what the walls let remain.
    """

    responses: Annotated[int, Field(ge=1)]
    window_s: Positive
    rises_db: Annotated[tuple[Annotated[float, Field(ge=0, allow_inf_nan=False)], ...], Field(max_length=65536)]
    energy_excess_db: Finite | None = None


class AcceptedLaw(Strict):
    """A law of health that the fields break, and why whoever exported them offers them all the same."""

    law: str
    reason: Annotated[str, Field(min_length=1, max_length=1000)]


class Manifest(Strict):
    """All of `scene.json`; `files` maps every other file of the bundle to its SHA-256."""

    format_version: Literal[2] = FORMAT_VERSION
    id: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]*$")]
    """What clients ask for the scene by."""
    name: str
    """What the page calls it."""
    description: str = ""
    geometry: Geometry | None = None
    """Walls, openings and materials; absent where they are not known, as of measured places."""
    bounds: Bounds
    speed_of_sound: Annotated[float, Field(gt=100, lt=1000)]
    """Metres per second."""
    air: Air = Air()
    """What the absorption by air is computed from."""
    image_order: Literal[0, 1] = 0
    """The server computes reflections from so many surfaces from geometry, and the fields do not hold them."""
    transmission: bool = False
    """Whether the server lets sound go straight through walls, as far as their mass lets it; else they are solid."""
    start: Start
    """Where a visitor begins."""
    direct_sound: Literal["geometry", "field"] = "geometry"
    """Whether the direct sound is computed from geometry or held by the fields' responses."""
    reference_level_db: Finite = 0.0
    """Level of the direct sound one metre from an emitter, in the unit of the fields' responses. Sound is heard, and
    maps are drawn, as if it were 0."""
    channels: tuple[Literal["left"], Literal["right"]] | tuple[Literal["mono"]] = ("left", "right")
    """Channels of the fields' responses: two ears or one microphone."""
    codec: CodecParameters
    """How the fields' spectrograms are read, unless a field has a codec of its own."""
    fields: dict[str, FieldFile]
    """The trained networks by name; empty where nothing reverberates, as in the open."""
    levels: Annotated[tuple[QualityLevel, ...], Field(min_length=1)]
    """The quality levels on offer, the default first."""
    frontier: tuple[FrontierPoint, ...] = ()
    """Levels that are worth their time, but so near one of `levels` that they are not offered."""
    effects: Mapping[EffectName, bool] = Field(default_factory=dict)
    """Effects that are on or off whatever the planner would decide; the planner decides about all others."""
    reference: DataReference | None = None
    """What the responses are like that the fields were trained on; absent where that is not known."""
    accepted: tuple[AcceptedLaw, ...] = ()
    """Laws of health that the scene breaks with a stated reason."""
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
        if not self.fields:
            return self._has_no_field()
        for level in self.levels:
            if level.field not in self.fields:
                raise ValueError(f"levels.{level.name}.field: there is no field {level.field}")
            codec = (self.fields[level.field].codec or self.codec).codec
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
        if self.direct_sound == "field":
            raise ValueError("direct_sound: there is no field that could hold it")
        return self

    @model_validator(mode="after")
    def _computes_what_can_be_computed(self) -> "Manifest":
        if self.image_order > 0 and self.geometry is None:
            raise ValueError("image_order: reflections cannot be computed without geometry")
        if self.image_order > 0 and self.direct_sound == "field":
            raise ValueError("image_order: fields that hold the direct sound hold the first reflections too")
        if self.direct_sound == "field" and any(level.reuse is not None for level in self.levels):
            raise ValueError("levels: responses that hold the direct sound cannot be those of another place (reuse)")
        if len(self.channels) == 1 and self.direct_sound == "geometry":
            raise ValueError("direct_sound: what one microphone heard holds it; it is computed for two ears only")
        return self

    @property
    def floor_plan(self) -> FloorPlan:
        """Where sound travels: that of the geometry, or the box of the bounds, in which all see each other."""
        if self.geometry is not None:
            return self.geometry.floor_plan
        (west, south, low), (east, north, high) = self.bounds.minimum, self.bounds.maximum
        return FloorPlan(((west, south), (east, south), (east, north), (west, north)), high, low)

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
