"""What a scene is made of: walls, openings and materials, as written in scene files and bundles."""

import math
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.geometry import FARTHEST_M, FloorPlan

Share = Annotated[float, Field(ge=0, le=1)]
PerBand = Annotated[tuple[Share, ...], Field(min_length=len(OCTAVE_BANDS_HZ), max_length=len(OCTAVE_BANDS_HZ))]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Coordinate = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M, allow_inf_nan=False)]
PlanPoint = tuple[Coordinate, Coordinate]
Point = tuple[Coordinate, Coordinate, Coordinate]


# Shorter ones are a corner written twice; geometry divides by the length of a wall.
_SHORTEST_WALL_M = 0.001


class Strict(BaseModel):
    """Unknown keys are mistakes, and nothing changes after it was read."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Material(Strict):
    """Energy shares per octave band, 125 Hz to 8 kHz: absorbed, and scattered of what is reflected. Sound goes through
    a wall as its mass lets it; without one stated, not at all."""

    absorption: PerBand
    scattering: PerBand
    surface_mass_kg_m2: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None


class Materials(Strict):
    walls: Material
    floor: Material
    ceiling: Material


class Opening(Strict):
    """A passage between rooms, as the line in plan that one steps over."""

    name: str
    start: PlanPoint
    end: PlanPoint

    @property
    def centre(self) -> PlanPoint:
        return (self.start[0] + self.end[0]) / 2, (self.start[1] + self.end[1]) / 2


class Geometry(Strict):
    """A floor polygon, counter-clockwise and not crossing itself, extruded to `height_m`."""

    height_m: Annotated[float, Field(gt=0, le=FARTHEST_M, allow_inf_nan=False)]
    corners: Annotated[tuple[PlanPoint, ...], Field(min_length=3)]
    openings: tuple[Opening, ...] = ()
    materials: Materials

    @field_validator("corners")
    @classmethod
    def _walls_have_a_length(cls, corners: tuple[PlanPoint, ...]) -> tuple[PlanPoint, ...]:
        for index, corner in enumerate(corners):
            if math.dist(corner, corners[index - 1]) < _SHORTEST_WALL_M:
                raise ValueError(f"corner {index} is where the corner before it is")
        return corners

    @model_validator(mode="after")
    def _turns_counter_clockwise(self) -> "Geometry":
        if self.floor_plan.area_m2 <= 0:
            raise ValueError("corners must run counter-clockwise")
        return self

    @property
    def floor_plan(self) -> FloorPlan:
        return FloorPlan(self.corners, self.height_m)

    def without_scattering(self) -> "Geometry":
        """All that is reflected is mirrored."""
        smooth = {"scattering": (0.0,) * len(OCTAVE_BANDS_HZ)}
        names = type(self.materials).model_fields
        materials = Materials(**{name: getattr(self.materials, name).model_copy(update=smooth) for name in names})
        return self.model_copy(update={"materials": materials})
