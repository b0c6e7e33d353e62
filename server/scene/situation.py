"""What a plan of effects is made for: a place, the emitters in it, and one listener.

Metres, metres per second; bands are OCTAVE_BANDS_HZ. Energies of responses are relative to that of the direct sound at
one metre, which is 1 in every band.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from server.acoustics.directivity import OMNIDIRECTIONAL, Directivity
from server.acoustics.geometry import FloorPlan, Pose, Vector3
from server.acoustics.reflections import ReflectionFinder, mirror_gain_db
from server.acoustics.sound_path import SoundPathFinder
from server.scene.geometry import Materials

Output = Literal["headphones", "mono"]
Bands = npt.NDArray[np.float64]

WALKING_M_S = 1.4


@dataclass(frozen=True)
class Reverberation:
    """What a field's responses hold of one emitter: the sound after the direct sound and the reflections that are
    computed from geometry, over both ears.

    `energy` (band,); of it the share `early` in the first 50 ms; `late` in what emitters can share a tail of.
    `t60_s` (band,), `early_decay_s`. `late_iacc` is the interaural cross-correlation of the late part. Between two ways the head may be turned, `turn_db` is
    by how much an ear's third-octave spectrum differs and `turn_iacc` by how much the interaural cross-correlation does.
    """

    energy: Bands
    early: float
    late: float
    t60_s: Bands
    late_iacc: float
    turn_db: float
    turn_iacc: float


@dataclass(frozen=True)
class Emitter:
    """Radiates from `pose`; moves at `speed_m_s` at most, 0 at rest."""

    pose: Pose
    directivity: Directivity = OMNIDIRECTIONAL
    gain_db: float = 0.0
    speed_m_s: float = 0.0
    turns: bool = False
    is_live: bool = False
    reverberation: Reverberation | None = None
    """Of this emitter where it is; None where nobody knows, and the place's own stands for it."""


@dataclass(frozen=True)
class Listener:
    pose: Pose
    speed_m_s: float = 0.0
    turns: bool = False
    output: Output = "headphones"


@dataclass(frozen=True, eq=False)
class Place:
    """What stays the same in a scene. `plan` is None in the open, and where nobody measured the walls; `materials`,
    where there are any and the first reflections come from them; `reverberation`, None where the scene has no field.

    Safe to share between threads; two are equal only if they are one.
    """

    minimum: Vector3
    maximum: Vector3
    speed_of_sound: float
    air_db_per_m: Bands
    plan: FloorPlan | None = None
    materials: Materials | None = None
    reverberation: Reverberation | None = None

    @cached_property
    def paths(self) -> SoundPathFinder | None:
        return None if self.plan is None else SoundPathFinder(self.plan, self.speed_of_sound)

    @cached_property
    def reflections(self) -> ReflectionFinder | None:
        if self.plan is None or self.materials is None:
            return None
        surfaces = self.materials.walls, self.materials.floor, self.materials.ceiling
        gains_db = [mirror_gain_db(surface.absorption, surface.scattering) for surface in surfaces]
        return ReflectionFinder(self.plan, gains_db)


@dataclass(frozen=True)
class Situation:
    """`emitters` by id."""

    place: Place
    listener: Listener
    emitters: Mapping[str, Emitter]
