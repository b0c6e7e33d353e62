"""Where a quality level takes the responses of poses from: computed anew for each, or from elsewhere.

Axes: B poses; responses (B, channel, sample). Metres, radians.
"""

from abc import ABC, abstractmethod
from typing import Protocol

import numpy as np
import numpy.typing as npt

from server.acoustics.geometry import Vector3
from server.field.lattice import Neighbourhood, Snapped

Float32 = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]


class Compute(Protocol):
    """Has the network compute responses, in an array of their own."""

    def __call__(self, listeners: Floats, emitters: Floats, yaws: Floats, *, remember: bool = False) -> Float32:
        """Listeners (B, 3), emitters (B, 3), yaws (B,). With `remember`, a warm phase starts from the ones before."""


class ResponseSource(ABC):
    """One level's, in one scene. Safe to share between threads."""

    @abstractmethod
    def responses(self, listeners: Floats, emitters: Floats, yaws: Floats, *, remember: bool = False) -> Float32:
        """(B, channel, sample), an array of their own."""

    @abstractmethod
    def computed_for(self, listeners: Floats, emitters: Floats, yaws: Floats) -> tuple[Floats, Floats, Floats]:
        """The poses that the network is asked for in place of these."""

    @abstractmethod
    def snap(self, listener: Vector3, emitter: Vector3, yaw: float) -> Snapped:
        """What stands for a pair of poses: those that have the same share a response."""

    @abstractmethod
    def find(self, listener: Vector3, emitter: Vector3, yaw: float) -> tuple[Snapped, Neighbourhood]:
        """As `snap`, and which other listeners are sure to have the same."""

    @abstractmethod
    def response(self, snapped: Snapped) -> Float32:
        """(channel, sample), an array of its own."""

    @abstractmethod
    def moved(self, rng: np.random.Generator) -> "ResponseSource":
        """With what stands for poses elsewhere, so that errors are measured at poses like any other."""
