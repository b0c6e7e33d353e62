"""The interface through which a quality level gets responses: computed for each pose, or taken from nodes.

Axes: B poses; responses (B, channel, sample). Metres, radians. Heads are orientations (B, 4) as quaternions x, y, z, w,
or yaws (B,) of level heads.
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
    """A function that computes responses with the network, in a new array."""

    def __call__(self, listeners: Floats, emitters: Floats, heads: Floats, *, remember: bool = False) -> Float32:
        """Compute responses for listeners (B, 3), emitters (B, 3) and heads. With `remember`, a warm phase starts
        from earlier responses."""


class ResponseSource(ABC):
    """The source of responses of one level in one scene. Safe to share between threads."""

    @abstractmethod
    def responses(self, listeners: Floats, emitters: Floats, heads: Floats, *, remember: bool = False) -> Float32:
        """The responses (B, channel, sample), in a new array."""

    @abstractmethod
    def computed_for(self, listeners: Floats, emitters: Floats, heads: Floats) -> tuple[Floats, Floats, Floats]:
        """The poses for which the network is run in place of these."""

    @abstractmethod
    def snap(self, listener: Vector3, emitter: Vector3, yaw: float) -> Snapped:
        """The node that represents a pair of poses: pairs with the same result share a response."""

    @abstractmethod
    def find(self, listener: Vector3, emitter: Vector3, yaw: float) -> tuple[Snapped, Neighbourhood]:
        """As `snap`, and also the other listener poses that certainly have the same result."""

    @abstractmethod
    def response(self, snapped: Snapped) -> Float32:
        """The response (channel, sample) in a new array."""

    @abstractmethod
    def moved(self, rng: np.random.Generator) -> "ResponseSource":
        """The same source with randomly moved nodes, so that errors are measured at typical poses."""
