"""What a scene looks like from above: the lines in which a horizontal plane cuts it."""

from typing import Annotated, Final, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from server.acoustics.mesh_plan import section
from server.scene.bundle import Bundle

MOST_LINES: Final = 20_000
"""Of more lines, the longest are kept."""


class Section(BaseModel):
    """Each of `lines` is x and y of its one end and of its other, in metres. Those of a floor plan are its walls."""

    model_config = ConfigDict(frozen=True)

    height_m: float
    lines: tuple[Annotated[tuple[float, ...], Field(min_length=4, max_length=4)], ...]

    @classmethod
    def of(cls, bundle: Bundle, height_m: float) -> Self:
        if bundle.mesh is not None:
            lines = section(bundle.mesh, height_m)
        else:
            plan = bundle.floor_plan
            corners = np.asarray(plan.corners, np.float64)
            is_within = plan.floor_m <= height_m <= plan.height_m
            lines = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)[: len(corners) if is_within else 0]
        if len(lines) > MOST_LINES:
            lengths = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=-1)
            lines = lines[np.sort(np.argsort(-lengths, kind="stable")[:MOST_LINES])]
        return cls(height_m=height_m, lines=tuple(map(tuple, np.round(lines.reshape(-1, 4), 3).tolist())))
