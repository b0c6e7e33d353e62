"""The input of a plan of effects: a place, its emitters, and one listener.

Lengths are in metres, speeds in metres per second; bands are OCTAVE_BANDS_HZ. Energies of responses are relative to
that of the direct sound at one metre, which is 1 in every band.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import FILTER_BANDS_HZ
from server.acoustics.directivity import OMNIDIRECTIONAL
from server.acoustics.geometry import Pose, Vector3
from server.acoustics.sound_path import SoundPathFinder
from server.acoustics.surroundings import Surroundings
from server.acoustics.transmission import PathFinder
from server.responses.emitter_state import EmitterState
from server.scene.geometry import Material
from server.scene.surfaces import mirror_gains_db, wall_losses_db

Output = Literal["headphones", "mono", "ambisonics"]
"""Where the sound goes: to two ears, to one loudspeaker, or to a client that decodes ambisonic channels."""
Bands = npt.NDArray[np.float64]

WALKING_M_S = 1.4


def turns_with_head(output: Output) -> bool:
    """Whether what is rendered for an output turns with the head: one microphone has no front, and a client turns
    ambisonic channels itself."""
    return output == "headphones"


@dataclass(frozen=True, eq=False)
class Reverberation:
    """The reverberation of one emitter in a field's responses, over both ears: all sound but the direct sound and the
    reflections that are computed from geometry.

    `energy` (band,), of which the share `early` arrives within 50 ms; `t60_s` (band,); `late_iacc` is the interaural
    cross-correlation of the late part. `turn_db` is the greatest difference in level at one ear between two
    orientations of the head.
    """

    energy: Bands
    early: float
    t60_s: Bands
    late_iacc: float
    turn_db: float


@dataclass(frozen=True)
class Emitter(EmitterState):
    """An emitter as plans see it: all effects on, and how it may move (at most at `speed_m_s`, 0 at rest).
    `reverberation` is what it excites at its position; if None (unknown), that of the place is used."""

    speed_m_s: float = 0.0
    turns: bool = False
    reverberation: Reverberation | None = None

    @property
    def is_omnidirectional(self) -> bool:
        return self.directivity == OMNIDIRECTIONAL


@dataclass(frozen=True)
class Listener:
    """A listener who moves at most at `speed_m_s` and whose head may turn. With a `bus`, the order of a quality level's
    bus, headphones hear the reflected sound by it (`server.rendering.bus`)."""

    pose: Pose
    speed_m_s: float = 0.0
    turns: bool = False
    output: Output = "headphones"
    bus: int | None = None

    @property
    def hears_turns(self) -> bool:
        """Whether the head turns, and what is rendered turns with it."""
        return self.turns and turns_with_head(self.output)

    @property
    def turns_responses(self) -> bool:
        """Whether turns of the head call for new responses: those of two ears are of one orientation, while a bus turns
        what it has."""
        return self.hears_turns and self.bus is None


@dataclass(frozen=True, eq=False)
class SceneAcoustics:
    """The acoustics of a scene, which never change. Two places are equal only if they are the same object. Safe to
    share between threads.

    `minimum` and `maximum` bound all positions. Nearer than `nearest_m`, sound gets no louder. `surroundings` are None
    in the open, and where the walls are unknown; the materials of their `surfaces` are set where first reflections come
    from geometry.
    `reverberation` is typical of the place and set where it has a field; with `holds_direct_sound` the field's
    responses contain all sound. If the scene `transmits`, sound also goes through walls whose mass is known, and is
    rendered with the first reflections. The late tails that emitters could share begin `tail_start_s` after emission;
    None where responses are too short to share any. `reverberations` are from positions all over the place: they differ
    as much as those of emitters about which nothing else is known.
    """

    minimum: Vector3
    maximum: Vector3
    sample_rate: int
    speed_of_sound: float
    air_db_per_m: Bands
    nearest_m: float
    surroundings: Surroundings | None = None
    surfaces: tuple[Material, ...] | None = None
    reverberation: Reverberation | None = None
    holds_direct_sound: bool = False
    transmits: bool = False
    tail_start_s: float | None = None
    reverberations: tuple[Reverberation, ...] = ()

    @cached_property
    def paths(self) -> SoundPathFinder | None:
        """The path finder of the direct sound; None where nothing can block it."""
        if self.surroundings is None or not self.surroundings.has_obstacles:
            return None
        return self.surroundings.sound_paths(self.speed_of_sound)

    @cached_property
    def reflections(self) -> PathFinder | None:
        """The path finder of first reflections and, where the scene transmits, of sound straight through walls; None
        without materials."""
        if self.surroundings is None or self.surfaces is None:
            return None
        losses_db = wall_losses_db(self.surfaces) if self.transmits else None
        return self.surroundings.first_reflections(mirror_gains_db(self.surfaces), losses_db)

    @cached_property
    def band_shares(self) -> Bands:
        """(band,) share of an impulse's energy in each of FILTER_BANDS_HZ: the first band reaches down to 0 Hz, the
        last up to half the sample rate."""
        edges = np.asarray(FILTER_BANDS_HZ[1:]) / np.sqrt(2)
        return np.asarray(np.diff(np.clip([0.0, *edges, np.inf], 0, self.sample_rate / 2)) / (self.sample_rate / 2))


@dataclass(frozen=True)
class Situation:
    """A place, its listener, and its `emitters` by id."""

    place: SceneAcoustics
    listener: Listener
    emitters: Mapping[str, Emitter]
