"""What the server says about a scene and a stream. Fields that a newer server adds are in `given` only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from nafir_client.errors import ProtocolError
from nafir_client.pose import Position


@dataclass(frozen=True)
class Place:
    """Where a visit begins: metres, and radians counter-clockwise from +x."""

    position: Position
    yaw: float = 0.0


@dataclass(frozen=True)
class Opening:
    """A door or passage between two corners of the floor plan."""

    name: str
    start: tuple[float, float]
    end: tuple[float, float]


@dataclass(frozen=True)
class Scene:
    """A scene of the server. `minimum` and `maximum` are the corners of the box in which positions may lie."""

    id: str
    name: str
    sample_rate: int
    minimum: Position
    maximum: Position
    listener: Place
    emitter: Place
    openings: tuple[Opening, ...]
    directional_levels: tuple[str, ...]
    """Quality levels that know from where sound arrives, so that a stream may be ambisonic."""
    given: Mapping[str, Any]

    @classmethod
    def read(cls, given: Mapping[str, Any]) -> "Scene":
        """Raises ProtocolError."""
        try:
            return cls(
                id=given["id"],
                name=given["name"],
                sample_rate=given["sample_rate"],
                minimum=_position(given["bounds"]["minimum"]),
                maximum=_position(given["bounds"]["maximum"]),
                listener=_place(given["listener"]),
                emitter=_place(given["emitter"]),
                openings=tuple(
                    Opening(each["name"], tuple(each["start"]), tuple(each["end"])) for each in given["openings"]
                ),
                directional_levels=tuple(given.get("directional_levels", ())),
                given=given,
            )
        except (KeyError, TypeError, ValueError) as exc:
            raise ProtocolError(f"the description of a scene cannot be read: {exc!r}") from exc


@dataclass(frozen=True)
class Welcome:
    """What the server has agreed to for a stream. `window` is how many blocks of each listener may be
    unacknowledged, and `max_listeners` how many listeners there may be, if that was asked. `doors` says how far each
    door is open, from 0, shut, to 1."""

    scene: Scene
    sample_rate: int
    block_size: int
    channels: int
    encoding: str
    buffer_blocks: int
    window: int
    ir_samples: int
    hrtf: str
    level: str
    order: int | None
    max_listeners: int | None
    doors: Mapping[str, float]
    given: Mapping[str, Any]

    @classmethod
    def read(cls, given: Mapping[str, Any]) -> "Welcome":
        """Raises ProtocolError."""
        try:
            return cls(
                scene=Scene.read(given["scene"]),
                sample_rate=given["sample_rate"],
                block_size=given["block_size"],
                channels=given["channels"],
                encoding=given["encoding"],
                buffer_blocks=given["buffer_blocks"],
                window=given["window"],
                ir_samples=given["ir_samples"],
                hrtf=given["hrtf"],
                level=given["level"],
                order=given.get("order"),
                max_listeners=given.get("max_listeners"),
                doors=given.get("doors", {}),
                given=given,
            )
        except KeyError as exc:
            raise ProtocolError(f"the welcome has no {exc}") from exc


def _position(numbers: Any) -> Position:
    x, y, z = numbers
    return (x, y, z)


def _place(given: Mapping[str, Any]) -> Place:
    return Place(_position(given["position"]), given.get("yaw", 0.0))
