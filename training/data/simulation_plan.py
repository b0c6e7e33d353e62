"""A plan of what a simulation computes, and why: an effect is called for if leaving it out would audibly change the
sound.

Effects that also exist in the catalogue in `server.scene.effects` have the same names, so that one override in a scene
file applies to both simulation and rendering.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from server.planning.decision import Decision


class SimulatedEffect(StrEnum):
    EARLY_REFLECTIONS = "early_reflections"
    LATE_REVERBERATION = "late_reverberation"
    SCATTERING = "scattering"
    PER_SOURCE_TAIL = "per_source_tail"
    AIR_ABSORPTION = "air_absorption"
    DIFFRACTION = "diffraction"
    TRANSMISSION = "transmission"
    DIRECTIVITY = "directivity"


Overrides = Mapping[SimulatedEffect, bool]
"""Effects that are on or off regardless of the prediction."""


def overrides_among(effects: Mapping[str, bool]) -> dict[SimulatedEffect, bool]:
    """Select the effects that simulations have from effects by name; the others belong to rendering."""
    return {SimulatedEffect(name): is_on for name, is_on in effects.items() if name in list(SimulatedEffect)}


@dataclass(frozen=True)
class SimulationDecision(Decision[SimulatedEffect]):
    """The decision about one effect. `cost_s` are seconds of one core for the whole scene that the effect takes, or
    saves if it is off; None if they are negligible or were not measured."""

    cost_s: float | None = None


@dataclass(frozen=True)
class SimulationPlan:
    """The plan of a simulation: `rays` per emitter, 0 for none; specular paths of up to `image_order` reflections are
    computed as images.

    From `tail_start_s` after emission on, all receivers share one tail, whose decay is measured with `tail_rays` rays;
    None if each receiver has its own tail.
    """

    image_order: int
    rays: int
    tail_start_s: float | None
    tail_rays: int
    scattering: bool
    air_absorption: bool
    diffraction: bool
    transmission: bool
    decisions: tuple[SimulationDecision, ...] = ()
    cost_s: float | None = None
    """The predicted time of the whole simulation, in seconds of one core."""
    notes: tuple[str, ...] = ()
    """Sentences about requests of the scene file that the simulation cannot fulfil."""

    @classmethod
    def everything(
        cls, image_order: int, rays: int, *, diffraction: bool = True, transmission: bool = False
    ) -> "SimulationPlan":
        """A plan that leaves nothing out, in which every pair has its own tail."""
        return cls(image_order, rays, None, 0, True, True, diffraction, transmission)

    @property
    def settings(self) -> tuple[object, ...]:
        """Everything on which the data depend; two plans may have equal settings for different reasons."""
        return tuple(value for name, value in vars(self).items() if name not in {"decisions", "cost_s", "notes"})

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> "SimulationPlan":
        """Read a plan from the result of `to_json`. Raises KeyError, TypeError or ValueError for anything else."""
        decisions = tuple(
            SimulationDecision(**{**decision, "name": SimulatedEffect(decision["name"])})
            for decision in content["decisions"]
        )
        return cls(**{**content, "decisions": decisions, "notes": tuple(content.get("notes", ()))})
