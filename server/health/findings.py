"""Laws of the health check, each with its bound and the reason for it, and findings.

A law holds if its value is at most the bound. A value that is not a number breaks the law.
"""

import math
from dataclasses import dataclass

from server.acoustics.geometry import Vector3
from server.health.poses import Poses
from server.rendering.direct_path import NEAR_LIMIT_M


@dataclass(frozen=True)
class Law:
    """A law that holds for every sound field, or for every computation, at any pose."""

    name: str
    label: str
    unit: str
    bound: float
    reason: str
    remedy: str = ""
    """What the trainer of the field can do about it; empty if the program is at fault."""

    @property
    def can_be_accepted(self) -> bool:
        """Whether a scene may break the law for a stated reason. It may not if the program is at fault."""
        return bool(self.remedy)


_MORE_DATA = "place probes nearer to each other (probes.spacing_m), or train for longer (--epochs)"
FINITE = Law(
    "finite", "answers that are not finite", "", 0.0, "one of them would stay in a convolver for a response's length"
)
ENERGY = Law(
    "energy",
    "energy above what the walls let remain",
    "dB",
    0.0,
    "walls absorb: beside a diffuse field, a corner has eight times the energy and the nearer ear twice; or 3 dB more "
    "than the loudest response that the field was trained on",
    f"{_MORE_DATA}; of measured responses, import them with the gain that they were measured with",
)
PEAK = Law(
    "peak",
    "largest sample",
    "",
    1 / NEAR_LIMIT_M,
    f"no reflection is louder than the direct sound can be, at {NEAR_LIMIT_M:g} m",
    _MORE_DATA,
)
_TWO_JND = (
    "twice the just-noticeable difference of level (ISO 3382-1:2009, table A.1): no smaller move may be heard as a pop"
)
_ONE_REFLECTION = "as much as it makes when a reflection with half of a band's energy comes into sight"
_BESIDE_DISTANCE = "; where fields hold the direct sound, beside what it gains by coming nearer (20 lg r)"
LEVEL_PER_CM = Law(
    "level_per_cm", "change of level per centimetre", "dB", 2.0, f"{_TWO_JND}{_BESIDE_DISTANCE}", _MORE_DATA
)
LEVEL_PER_DEGREE = Law("level_per_degree", "change of level per degree of the head", "dB", 2.0, _TWO_JND, _MORE_DATA)
SPECTRUM_PER_CM = Law(
    "spectrum_per_cm",
    "change of an octave band per centimetre",
    "dB",
    3.0,
    f"{_ONE_REFLECTION}{_BESIDE_DISTANCE}",
    _MORE_DATA,
)
SPECTRUM_PER_DEGREE = Law(
    "spectrum_per_degree", "change of an octave band per degree of the head", "dB", 3.0, _ONE_REFLECTION, _MORE_DATA
)
DECAY = Law(
    "decay",
    "rise within 60 dB of decay",
    "dB",
    3.0,
    "without a source, what is left of a sound does not grow, but where the responses that the field learned from do: "
    "between parallel walls, or where a corridor comes back; a doubled energy beside that is a second event",
    "train for longer (--epochs); where simulated responses rise, more rays (simulation.rays) make late sound smoother",
)
BRANCH_CUT = Law(
    "branch_cut",
    "advances of phase at the branch cut",
    "%",
    10.0,
    "3 % would be chance; a field whose bin centres were not taken off has 25 %, and what it predicts there is noise",
    "train for longer (--epochs)",
)
REPEATABLE = Law(
    "repeatable", "difference of a rerun", "", 0.0, "the same request has the same answer, to the last bit"
)
BATCH = Law(
    "batch",
    "difference that other poses in the same call make",
    "dB",
    -20.0,
    "the level is then the same to 0.1 just-noticeable differences; graphs in eight bits share one scale in a call",
)
DOUBLE = Law("double", "difference from double precision", "dB", -90.0, "beneath what 16 bits can hold")
ITERATED = Law(
    "double",
    DOUBLE.label,
    "dB",
    -50.0,
    "iterations from zero phase decide at bins where next to nothing is which way to turn; beneath what masks it",
)


LAWS = (
    FINITE,
    ENERGY,
    PEAK,
    LEVEL_PER_CM,
    LEVEL_PER_DEGREE,
    SPECTRUM_PER_CM,
    SPECTRUM_PER_DEGREE,
    DECAY,
    BRANCH_CUT,
    REPEATABLE,
    BATCH,
    DOUBLE,
)


@dataclass(frozen=True)
class Situation:
    """A listener with its heading, and an emitter; in metres and radians."""

    listener: Vector3
    emitter: Vector3
    yaw: float

    @classmethod
    def of(cls, pose: Poses) -> "Situation":
        """The situation of one pose (7,)."""
        x, y, z, ex, ey, ez, yaw = (float(value) for value in pose)
        return cls((x, y, z), (ex, ey, ez), yaw)

    def __str__(self) -> str:
        listener, emitter = (",".join(f"{part:.2f}" for part in end) for end in (self.listener, self.emitter))
        return f"listener {listener} facing {math.degrees(self.yaw):.0f}°, emitter {emitter}"


@dataclass(frozen=True, eq=False)
class Finding:
    """The worst `value` of a law for a field or quality level, over `poses` poses, with its `pose` (7,) if there is
    one."""

    law: Law
    of: str
    value: float
    poses: int
    pose: Poses | None = None
    moving: str | None = None
    """What moved: listener, emitter or yaw."""
    accepted: str | None = None
    """The manifest's reason for accepting that the law is broken; None if it is not accepted."""

    @property
    def holds(self) -> bool:
        return self.value <= self.law.bound

    @property
    def where(self) -> Situation | None:
        return None if self.pose is None else Situation.of(self.pose)
