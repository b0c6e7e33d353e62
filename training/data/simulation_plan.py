"""What a simulation computes, and why: an effect is called for where leaving it out would change what is heard.

The names are those of the catalogue in `server.scene.effects` where both have the effect, so that one override in a
scene file speaks to simulation and rendering alike.
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
"""On or off whatever the prediction says."""


def overrides_among(effects: Mapping[str, bool]) -> dict[SimulatedEffect, bool]:
    """Those that simulations know, of effects by name; the others are rendering's."""
    return {SimulatedEffect(name): is_on for name, is_on in effects.items() if name in list(SimulatedEffect)}


@dataclass(frozen=True)
class SimulationDecision(Decision[SimulatedEffect]):
    """`cost_s` are seconds of one core for the whole scene that the effect takes, or saves where it is off; None where
    it costs next to nothing or nobody measured."""

    cost_s: float | None = None


@dataclass(frozen=True)
class SimulationPlan:
    """`rays` per emitter, 0 for none; mirrored paths of up to `image_order` reflections are images.

    From `tail_start_s` after emission on all receivers hear one tail, of which `tail_rays` tell the decay; None where
    each has its own.
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
    """Seconds of one core that the whole simulation was predicted to take."""
    notes: tuple[str, ...] = ()
    """What the scene file asks for and will not get, in sentences."""

    @classmethod
    def everything(
        cls, image_order: int, rays: int, *, diffraction: bool = True, transmission: bool = False
    ) -> "SimulationPlan":
        """Nothing is left out, and every pair has its own tail."""
        return cls(image_order, rays, None, 0, True, True, diffraction, transmission)

    @property
    def settings(self) -> tuple[object, ...]:
        """What data depend on; two plans may agree on it for different reasons."""
        return tuple(value for name, value in vars(self).items() if name not in {"decisions", "cost_s", "notes"})

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> "SimulationPlan":
        """Raises KeyError, TypeError or ValueError for anything but what `to_json` returns."""
        decisions = tuple(
            SimulationDecision(**{**decision, "name": SimulatedEffect(decision["name"])})
            for decision in content["decisions"]
        )
        return cls(**{**content, "decisions": decisions, "notes": tuple(content.get("notes", ()))})
