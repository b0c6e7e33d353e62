"""Which parts of a listener's sound are made: what a plan of effects switches."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from server.acoustics.sound_path import SoundPaths

PathGain = Callable[[SoundPaths], npt.NDArray[np.float64]]
"""How much louder the direct sound of n paths is in each octave band, (n, band) in decibels: beside what distance, air,
edges and directivity do; 0 where it stays as it is."""


@dataclass(frozen=True)
class EmitterEffects:
    """Of one emitter. `early` are the first reflections from geometry, `late` is what the field holds; `path_gains`
    change the direct sound besides."""

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
    """Whether the delay is to stand still even while something moves."""
    path_gains: tuple[PathGain, ...] = ()

    @property
    def has_response(self) -> bool:
        return self.early or self.late

    @property
    def bakes_direct(self) -> bool:
        """Whether the direct sound stands still and is part of the impulse response."""
        return self.direct_path and not self.propagation_delay and self.has_response

    @property
    def path(self) -> tuple[object, ...]:
        """What the path of the direct sound, and its gains, depend on."""
        return self.occlusion, self.diffraction, self.directivity, self.path_gains


ALL_ON = EmitterEffects()
"""All that the renderer does of its own, without path gains."""


@dataclass(frozen=True)
class SharedEffects:
    """Of all that a listener hears: through a `head` or with one ear without; every emitter with a tail of its own;
    responses anew when the head turns."""

    head: bool = True
    own_tails: bool = True
    head_rotation: bool = True

    @property
    def channels(self) -> int:
        return 2 if self.head else 1
