"""States of doors in a dataset: how far the doors are open while each emitter is simulated, and which states no field
is trained on."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.doors import MeshWithDoors, Openness
from training.data.levels.level_scene import LevelScene
from training.data.simulated_scene import SimulatedScene

_Floats = npt.NDArray[np.float64]
_Flags = npt.NDArray[np.bool_]

_MOST_STATES, _FEWEST_STATES, _MOST_TRIANGLES = 256, 32, 2_000_000
"""The geometry of each state is kept in memory while a dataset is read. So the meshes of all states together have at
most so many triangles, unless the states are the fewest already."""
_DECIMALS = 6
_SHUT_OR_OPEN = 0.25
"""The share of states in which a door is shut, and of those in which it is open; it is ajar in the others."""


@dataclass(frozen=True)
class DoorStates:
    """`openness` (emitter, door) is how far doors are open while an emitter is simulated, from 0, shut, to 1, in the
    order of the level. The emitters that are `unseen` (emitter,) have states that no other emitter has: no field is
    trained on them. Scenes without doors have none, and no emitter is unseen."""

    openness: _Floats
    unseen: _Flags

    @classmethod
    def none(cls, emitters: int) -> "DoorStates":
        return cls(np.zeros((emitters, 0)), np.zeros(emitters, dtype=bool))

    @classmethod
    def of(cls, scene: SimulatedScene, emitters: int, seed: int) -> "DoorStates":
        """States drawn at random, the same for the same seed; of a scene without doors, none."""
        doors = len(scene.doors) if isinstance(scene, LevelScene) else 0
        if not doors:
            return cls.none(emitters)
        rng = np.random.default_rng([seed, 14])
        count = min(_most_states(scene), emitters)
        openness, kind = rng.uniform(size=(count, doors)), rng.uniform(size=(count, doors))
        openness[kind < _SHUT_OR_OPEN] = 0.0
        openness[kind > 1 - _SHUT_OR_OPEN] = 1.0
        unseen = max(1, round(scene.simulation.held_out_share * count))
        # A state with a door ajar is no other; one without may be.
        for state in openness[:unseen]:
            if np.isin(state, (0, 1)).all():
                state[rng.integers(doors)] = rng.uniform(0.1, 0.9)
        states = rng.permutation(emitters) % count
        return cls(openness[states], states < unseen)

    def held_out(self, rng: np.random.Generator) -> _Flags:
        """(emitter, listener) True for pairs of half of the couples of which one end is unseen, while that end is the
        emitter: so neither the state nor the couple is known."""
        first, second = np.triu_indices(len(self.unseen), 1)
        touching = np.flatnonzero(self.unseen[first] | self.unseen[second])
        chosen = rng.choice(touching, max(1, len(touching) // 2), replace=False)
        held_out = np.zeros((len(self.unseen), len(self.unseen)), dtype=bool)
        held_out[first[chosen], second[chosen]] = held_out[second[chosen], first[chosen]] = True
        return held_out & self.unseen[:, None]


@dataclass(frozen=True)
class EmitterScenes:
    """A scene as each emitter finds it, with its doors in their `states`. Several threads may use one."""

    scene: SimulatedScene
    states: DoorStates
    _by_state: dict[Openness, LevelScene] = field(default_factory=dict)

    def of(self, emitter: int) -> SimulatedScene:
        return self.at(self.states.openness[emitter])

    def at(self, openness: npt.NDArray[np.floating]) -> SimulatedScene:
        """The scene with its doors so far open; as it is, for no doors."""
        if not len(openness):
            return self.scene
        assert isinstance(self.scene, LevelScene)
        # In single precision, as a field is told of it, a state is the same.
        state = tuple(np.round(openness.astype(np.float64), _DECIMALS).tolist())
        if state not in self._by_state:
            self._by_state.setdefault(state, self.scene.with_doors(state, self._mesh))
        return self._by_state[state]

    @cached_property
    def _mesh(self) -> MeshWithDoors:
        assert isinstance(self.scene, LevelScene)
        return self.scene.mesh_with_doors()

    def groups(self, emitters: npt.NDArray[np.integer]) -> Mapping[int, npt.NDArray[np.int64]]:
        """Where in `emitters` (n,) those of each state are, by one emitter of that state."""
        return {int(emitters[here[0]]): here for here in alike(self.states.openness[emitters])}


def _most_states(level: SimulatedScene) -> int:
    assert isinstance(level, LevelScene)
    return max(_FEWEST_STATES, min(_MOST_STATES, _MOST_TRIANGLES // len(level.place.mesh.triangles)))


def alike(openness: npt.NDArray[np.floating]) -> list[npt.NDArray[np.int64]]:
    """Where each of the states in `openness` (n, door) is."""
    if not openness.size:
        return [np.arange(len(openness))] if len(openness) else []
    _, which = np.unique(openness, axis=0, return_inverse=True)
    return [np.flatnonzero(which.reshape(-1) == number) for number in range(which.max() + 1)]
