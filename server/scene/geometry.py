"""The geometry of a scene in scene files and bundles: walls, openings and materials."""

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, field_validator

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FARTHEST_M, FloorPlan
from server.scene.outline import faults_of

Share = Annotated[float, Field(ge=0, le=1)]
PerBand = Annotated[tuple[Share, ...], Field(min_length=len(OCTAVE_BANDS_HZ), max_length=len(OCTAVE_BANDS_HZ))]
Finite = Annotated[float, Field(allow_inf_nan=False)]
# guard: a coordinate of a scene is a place
Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]
PlanPoint = tuple[Coordinate, Coordinate]
Point = tuple[Coordinate, Coordinate, Coordinate]

MOST_CORNERS = 256
"""The most corners of a floor plan. The search for paths around corners compares each corner with every other."""


class Strict(BaseModel):
    """The base of models that refuse unknown keys and cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Material(Strict):
    """Properties of a surface per octave band, 125 Hz to 8 kHz. `absorption` is the share of energy absorbed,
    `scattering` the share of the reflected energy that is scattered. The surface mass determines the transmission loss;
    without one, no sound goes through the wall."""

    absorption: PerBand
    scattering: PerBand
    surface_mass_kg_m2: Annotated[float, Field(gt=0, le=1e6, allow_inf_nan=False)] | None = None


class Materials(Strict):
    walls: Material
    floor: Material
    ceiling: Material

    @property
    def surfaces(self) -> tuple[Material, ...]:
        """The materials in the order in which surfaces of a floor plan are numbered."""
        return self.walls, self.floor, self.ceiling


class Opening(Strict):
    """A passage between rooms, given by the line on the floor over which one steps."""

    name: str
    start: PlanPoint
    end: PlanPoint

    @property
    def centre(self) -> PlanPoint:
        return (self.start[0] + self.end[0]) / 2, (self.start[1] + self.end[1]) / 2


class Geometry(Strict):
    """A floor polygon, counter-clockwise and not crossing itself, extruded to `height_m`."""

    height_m: Annotated[float, Field(gt=0, le=FARTHEST_M, allow_inf_nan=False)]
    corners: Annotated[tuple[PlanPoint, ...], Field(min_length=3, max_length=MOST_CORNERS)]
    openings: tuple[Opening, ...] = ()
    materials: Materials

    @field_validator("corners")
    @classmethod
    def _make_a_polygon(cls, corners: tuple[PlanPoint, ...]) -> tuple[PlanPoint, ...]:
        faults = faults_of(corners)
        if faults:
            raise ValueError("; ".join(faults))
        return corners

    @property
    def floor_plan(self) -> FloorPlan:
        return FloorPlan(self.corners, self.height_m)

    def without_scattering(self) -> "Geometry":
        """The same geometry with specular reflections only."""
        return self.with_scattering(0.0)

    def with_scattering(self, share: float) -> "Geometry":
        """The same geometry with this scattering coefficient at every surface and in all octave bands."""
        scattering = {"scattering": (share,) * len(OCTAVE_BANDS_HZ)}
        names = type(self.materials).model_fields
        materials = Materials(**{name: getattr(self.materials, name).model_copy(update=scattering) for name in names})
        return self.model_copy(update={"materials": materials})
