"""Plans of effects on request, made in the same way for HTTP and for the command line.

Lengths are in metres. Angles are in degrees, since people write and read them.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Self

from pydantic import BaseModel, ConfigDict

from server.acoustics.geometry import Pose, Vector3
from server.core.errors import RequestError
from server.field.field import AcousticField
from server.planning.catalogue import CATALOGUE
from server.planning.cost import Costs
from server.planning.effect_costs import measured_costs
from server.planning.places import place_of_field, reverberation_of
from server.planning.plan import Plan, RenderingDecision
from server.planning.planner import make_plan
from server.planning.scene_acoustics import WALKING_M_S, Emitter, Listener, Output, Situation
from server.scene.effects import EffectName, read_overrides

EFFECT_PATTERN = f"^({'|'.join(EffectName)})=(on|off)$"
"""The texts that `parse_effects` accepts, as a regular expression of JSON Schema."""
OUTPUTS: tuple[Output, ...] = ("headphones", "mono", "ambisonics")


class Decided(BaseModel):
    """Whether one effect is on, for one emitter or, with `emitter` null, for all that is heard.

    `change_jnd` is what leaving the effect out would change, in just-noticeable differences of `parameter`. `cost_us`
    per block of 256 samples and `memory_bytes` are what the effect costs on the answering host where it is on, and
    saves where it is off.
    """

    model_config = ConfigDict(frozen=True)

    name: EffectName
    title: str
    emitter: str | None
    called_for: bool
    change_jnd: float
    parameter: str
    cost_us: float | None
    memory_bytes: int | None
    reason: str
    overridden: bool

    @classmethod
    def of(cls, decision: RenderingDecision) -> Self:
        return cls(title=CATALOGUE[decision.name].title, **asdict(decision))


class PlanDocument(BaseModel):
    """The effects that a situation calls for. `cost_us` is the sum over effects that are on, `saved_us` over those that
    are off."""

    model_config = ConfigDict(frozen=True)

    scene: str
    cost_us: float
    saved_us: float
    decisions: tuple[Decided, ...]

    @classmethod
    def of(cls, scene: str, plan: Plan) -> Self:
        decisions = tuple(Decided.of(decision) for decision in plan.decisions)
        return cls(scene=scene, cost_us=plan.cost_us, saved_us=plan.saved_us, decisions=decisions)


@dataclass(frozen=True)
class PlanQuery:
    """A situation in a scene. Without emitters there is one at the scene's start, and so is a listener without a
    position. A listener that `walks` also turns its head; emitters that `move` do so at walking pace."""

    listener: Vector3 | None = None
    yaw_deg: float = 0.0
    emitters: Sequence[Vector3] = ()
    walks: bool = True
    move: bool = False
    output: str = "headphones"
    effects: Mapping[str, bool] = field(default_factory=dict)

    def check(self, scene: AcousticField) -> Output:
        """Return the output. Raises RequestError for a position outside the scene and for an unknown name."""
        output = next((known for known in OUTPUTS if known == self.output), None)
        if output is None:
            raise RequestError("unknown_output", f"{self.output!r} is none of {', '.join(OUTPUTS)}", field="output")
        if not math.isfinite(self.yaw_deg):
            raise RequestError("malformed_pose", "yaw-deg is not finite", field="yaw_deg")
        read_overrides(self.effects)
        if self.listener is not None:
            scene.bundle.require_inside(self.listener, "listener")
        for place in self.emitters:
            scene.bundle.require_inside(place, "emitter")
        return output

    def situation(self, scene: AcousticField) -> Situation:
        """Compute the reverberation of each emitter with the scene's field, and return the situation. Raises
        RequestError, as `check`."""
        output, start, bundle = self.check(scene), scene.bundle.manifest.start, scene.bundle
        yaw_deg = start.listener_yaw_deg if self.listener is None else self.yaw_deg
        listener = Pose.from_yaw(self.listener or start.listener, math.radians(yaw_deg))
        places = list(self.emitters) or [start.emitter]
        speed_m_s = WALKING_M_S if self.move else 0.0
        held = reverberation_of(scene, listener, places) if bundle.manifest.fields else [None] * len(places)
        return Situation(
            place_of_field(scene),
            Listener(
                listener,
                speed_m_s=WALKING_M_S if self.walks else 0.0,
                turns=self.walks,
                output=output,
                bus=scene.level.bus,
            ),
            {
                str(number): Emitter(Pose(place), speed_m_s=speed_m_s, reverberation=rest)
                for number, (place, rest) in enumerate(zip(places, held, strict=True), start=1)
            },
        )

    def plan(self, scene: AcousticField, costs: Costs | None = None) -> Plan:
        """Make the plan; `costs` are measured on this host if None. Raises RequestError, as `check`."""
        overrides = {**scene.bundle.manifest.effects, **read_overrides(self.effects)}
        situation = self.situation(scene)
        if costs is None:
            costs = measured_costs(scene)
        return make_plan(situation, overrides=overrides, costs=costs)


def parse_effects(texts: Sequence[str]) -> dict[str, bool]:
    """Parse texts `NAME=on` or `NAME=off`. Raises RequestError `unknown_effect`, or `doubled_effect` for a name
    twice."""
    effects = {}
    for text in texts:
        name, _, state = text.partition("=")
        if state not in {"on", "off"}:
            raise RequestError("unknown_effect", f"effect {text!r} is not NAME=on or NAME=off", field="effects")
        if name in effects:
            raise RequestError("doubled_effect", f"effect {name!r} is there twice", field="effect", status=409)
        effects[name] = state == "on"
    return effects


def rounded(plan: PlanDocument) -> str:
    """Return the plan as JSON, with numbers rounded to four significant digits."""
    document = plan.model_dump(mode="json")

    def short(value: object) -> object:
        if isinstance(value, float):
            return float(f"{value:.4g}")
        if isinstance(value, dict):
            return {key: short(each) for key, each in value.items()}
        return [short(each) for each in value] if isinstance(value, list) else value

    return json.dumps(short(document))
