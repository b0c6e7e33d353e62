"""The parts of a listener's sound that are rendered, which a plan of effects switches."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.sound_path import SoundPaths

PathGain = Callable[[SoundPaths], npt.NDArray[np.float64]]
"""Returns the gain (n, band) in decibels of the direct sound along n paths, besides distance, air, edges and
directivity; 0 leaves it unchanged."""


@dataclass(frozen=True)
class EmitterEffects:
    """The parts of one emitter's sound that are rendered. `early` stands for the first reflections from geometry,
    `late` for the field's responses; `path_gains` change the direct sound in addition."""

    direct_path: bool = True
    propagation_delay: bool = True
    distance_attenuation: bool = True
    air_absorption: bool = True
    occlusion: bool = True
    diffraction: bool = True
    directivity: bool = True
    early: bool = True
    late: bool = True
    holds_still: bool = False
    """Whether the delay stays fixed even while something moves."""
    path_gains: tuple[PathGain, ...] = ()

    @property
    def has_response(self) -> bool:
        return self.early or self.late

    @property
    def bakes_direct(self) -> bool:
        """Whether the direct sound has a fixed delay and is part of the impulse response."""
        return self.direct_path and not self.propagation_delay and self.has_response

    @property
    def path(self) -> tuple[object, ...]:
        """The flags on which the path of the direct sound and its gains depend."""
        return self.occlusion, self.diffraction, self.directivity, self.path_gains


ALL_ON = EmitterEffects()
"""All parts of the renderer on, without path gains."""


@dataclass(frozen=True)
class SharedEffects:
    """The shared parts of a listener's sound: with a `head` or in mono; with a late tail for each emitter (`own_tails`)
    or one for all; with new responses when the head turns (`head_rotation`) or not."""

    head: bool = True
    own_tails: bool = True
    head_rotation: bool = True

    @property
    def channels(self) -> int:
        return 2 if self.head else 1
