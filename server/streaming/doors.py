"""How what a session hears follows the doors of its scene.

Finding what a state of doors does to sound takes too long for the audio thread. So there are two requests, for workers:
a quick one, for who sees whom, which a door that moves makes again and again, and a whole one, for the ways round edges
too. While that is under way, sound takes the ways of the last state for which they are known, as far as nothing stands
in them now.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from server.acoustics.doors import MeshWithDoors, Openness
from server.acoustics.surroundings import MeshSurroundings
from server.field.fields_by_level import FieldsByLevel
from server.responses.direct_sound import DirectSound
from server.scene.door import read_openness


@dataclass(frozen=True)
class DoorsMoved:
    """What a session computes sound with while its doors are in one state. With `before`, the ways round edges are
    those of that earlier state, since finding them takes long; all else is of this one."""

    openness: Openness
    surroundings: MeshSurroundings
    direct_sound: DirectSound
    levels: FieldsByLevel
    before: MeshSurroundings | None


@dataclass(frozen=True)
class DoorRequest:
    """A state of doors to prepare. With `before`, it keeps the ways round edges of that state, and takes a few
    milliseconds. Without it, it finds them too, and takes tens of milliseconds or more."""

    moving: MeshWithDoors
    openness: Openness
    levels: FieldsByLevel
    direct_sound: DirectSound
    before: MeshSurroundings | None

    def prepare(self) -> DoorsMoved:
        if self.before is None:
            surroundings, levels = self.moving.at(self.openness), self.levels.with_doors(self.openness)
        else:
            surroundings = self.moving.soon_at(self.openness, self.before)
            levels = self.levels.soon_with_doors(self.openness, surroundings)
        direct_sound = self.direct_sound.within(surroundings)
        return DoorsMoved(self.openness, surroundings, direct_sound, levels, self.before)


class FollowedDoors:
    """The doors of one session, which begin as the bundle of `levels` has them unless `wanted` says otherwise. Raises
    RequestError unknown_door.

    All is for the session's thread, but for `DoorRequest.prepare`.
    """

    def __init__(
        self, moving: MeshWithDoors, levels: FieldsByLevel, direct_sound: DirectSound, wanted: Mapping[str, float]
    ) -> None:
        self._doors = levels.bundle.doors
        self._moving, self._levels, self._direct_sound = moving, levels, direct_sound
        self.openness = read_openness(self._doors, wanted)
        """How far doors are to be open."""
        self._heard = self._ways_are_of = levels.bundle.openness
        surroundings = levels.bundle.surroundings  # which are there already
        assert isinstance(surroundings, MeshSurroundings)
        self._ways = surroundings
        self._are_newest_ways_heard = True
        self._soon_in_flight = self._whole_in_flight = False
        self.is_heard = self._heard == self.openness
        """Whether the state in which the session began is heard. Nobody should hear another before."""

    @property
    def by_name(self) -> dict[str, float]:
        return {door.name: share for door, share in zip(self._doors, self.openness, strict=True)}

    def set(self, name: str, share: float) -> None:
        """Raises RequestError unknown_door."""
        self.openness = read_openness(self._doors, {name: share}, self.openness)

    def follow(self, other: "FollowedDoors") -> None:
        """Have the doors as those of the session of another listener of the stream are."""
        self.openness = other.openness

    def take_requests(self) -> list[DoorRequest]:
        """What to prepare now: at most one request of each kind is unanswered."""
        requests = []
        if not self._soon_in_flight and not (self._heard == self.openness and self._are_newest_ways_heard):
            self._soon_in_flight = True
            requests.append(self._request(self._ways))
        if not self._whole_in_flight and self._ways_are_of != self.openness:
            self._whole_in_flight = True
            requests.append(self._request(None))
        return requests

    def _request(self, before: MeshSurroundings | None) -> DoorRequest:
        return DoorRequest(self._moving, self.openness, self._levels, self._direct_sound, before)

    def accept(self, moved: DoorsMoved) -> bool:
        """Take an answer. Returns whether it is to be heard: a whole one that comes too late only brings its ways."""
        if moved.before is not None:
            self._soon_in_flight = False
            if self._ways_are_of == self._heard == moved.openness:
                return False  # the whole was quicker
            self._are_newest_ways_heard = moved.before is self._ways
        else:
            self._whole_in_flight = False
            self._ways, self._ways_are_of = moved.surroundings, moved.openness
            self._are_newest_ways_heard = moved.openness == self.openness
            if not self._are_newest_ways_heard:
                return False
        self._heard, self.is_heard = moved.openness, True
        return True

    def give_up(self, request: DoorRequest) -> None:
        """Note that a request failed: doors stay as they are heard."""
        if request.before is None:
            self._whole_in_flight, self._ways_are_of = False, self._heard  # not again before they move
        else:
            self._soon_in_flight, self._are_newest_ways_heard = False, True
        self.openness, self.is_heard = self._heard, True
