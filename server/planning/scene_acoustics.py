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

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.directivity import OMNIDIRECTIONAL
from server.acoustics.geometry import FloorPlan, Pose, Vector3
from server.acoustics.reflections import ReflectionFinder, mirror_gain_db
from server.acoustics.sound_path import SoundPathFinder
from server.acoustics.transmission import PathFinder, TransmittedPaths, transmission_loss_db
from server.responses.emitter_state import EmitterState
from server.scene.geometry import Materials

Output = Literal["headphones", "mono"]
Bands = npt.NDArray[np.float64]

WALKING_M_S = 1.4


@dataclass(frozen=True, eq=False)
class Reverberation:
    """What a field's responses hold of one emitter: the sound after the direct sound and the reflections that are
    computed from geometry, over both ears.

    `energy` (band,), of which the share `early` comes within 50 ms; `t60_s` (band,); `late_iacc` is the interaural
    cross-correlation of the late part. Between two ways the head may be turned the level at an ear differs by up to
    `turn_db`.
    """

    energy: Bands
    early: float
    t60_s: Bands
    late_iacc: float
    turn_db: float


@dataclass(frozen=True)
class Emitter(EmitterState):
    """As plans see it: with all effects on, and how it may move; at `speed_m_s` at most, 0 at rest.

    `reverberation` is of this emitter where it is; None where that is not known, and the place's own stands for it.
    """

    speed_m_s: float = 0.0
    turns: bool = False
    reverberation: Reverberation | None = None

    @property
    def is_omnidirectional(self) -> bool:
        return self.directivity == OMNIDIRECTIONAL


@dataclass(frozen=True)
class Listener:
    pose: Pose
    speed_m_s: float = 0.0
    turns: bool = False
    output: Output = "headphones"


@dataclass(frozen=True, eq=False)
class SceneAcoustics:
    """What stays the same in a scene; two places are equal only if they are one. Safe to share between threads.

    `minimum` and `maximum` bound where anybody can be. Nearer than `nearest_m`, sound gets no louder. `plan` is None in
    the open, and where nobody measured the walls; `materials` are there where first reflections come from geometry;
    `reverberation`, typical of the place, where it has a field; with `holds_direct_sound` that is all there is to hear.
    Where it `transmits`, sound goes through walls whose mass is known, and is heard with the first reflections.
    The late tails that emitters could share begin `tail_start_s` after emission; None where responses are too short to
    share any. `reverberations` are of places all over it: as unlike as emitters of which nothing else is known.
    """

    minimum: Vector3
    maximum: Vector3
    sample_rate: int
    speed_of_sound: float
    air_db_per_m: Bands
    nearest_m: float
    plan: FloorPlan | None = None
    materials: Materials | None = None
    reverberation: Reverberation | None = None
    holds_direct_sound: bool = False
    transmits: bool = False
    tail_start_s: float | None = None
    reverberations: tuple[Reverberation, ...] = ()

    @cached_property
    def paths(self) -> SoundPathFinder | None:
        """None where nothing can stand in the way."""
        if self.plan is None or not len(self.plan.bend_corners):
            return None
        return SoundPathFinder(self.plan, self.speed_of_sound)

    @cached_property
    def reflections(self) -> PathFinder | None:
        """With them what goes straight through walls, where it does."""
        if self.plan is None or self.materials is None:
            return None
        surfaces = self.materials.walls, self.materials.floor, self.materials.ceiling
        gains_db = [mirror_gain_db(surface.absorption, surface.scattering) for surface in surfaces]
        finder, mass = ReflectionFinder(self.plan, gains_db), self.materials.walls.surface_mass_kg_m2
        if not self.transmits or mass is None:
            return finder
        return TransmittedPaths(finder, self.plan, transmission_loss_db(mass, OCTAVE_BANDS_HZ))

    @cached_property
    def band_shares(self) -> Bands:
        """(band,) of the energy of an impulse: the first band reaches down to 0 Hz, the last up to all there is."""
        edges = np.asarray(OCTAVE_BANDS_HZ[1:]) / np.sqrt(2)
        return np.asarray(np.diff(np.clip([0.0, *edges, np.inf], 0, self.sample_rate / 2)) / (self.sample_rate / 2))


@dataclass(frozen=True)
class Situation:
    """`emitters` by id."""

    place: SceneAcoustics
    listener: Listener
    emitters: Mapping[str, Emitter]
