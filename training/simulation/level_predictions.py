"""Predictions for levels, by trials alone: rooms, storeys and doors leave little to formulas of one room.

A dataset has the doors in many states. So the trials are of three: as at the beginning, all open and all shut. The
largest change decides.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.mesh_reflections import MeshWallLosses
from server.acoustics.sound_path import SoundPaths
from server.scene.surfaces import wall_losses_db
from training.data.dataset import SPEED_OF_SOUND
from training.data.levels.level_scene import LevelScene
from training.data.simulation_plan import SimulatedEffect
from training.simulation.predictions import Fixed, HeardPairs, Prediction, Predictions, TailNeeds
from training.simulation.trial import Trial
from training.simulation.walked_room import WalkedRoom

_Floats = npt.NDArray[np.float64]

# Late sound of places in one room is much the same from here on after the direct sound (Lindau et al. 2012).
_MIXED_S = 0.05


@dataclass(frozen=True)
class LevelPredictions(Predictions):
    """Predictions for one level and its probes (probe, xyz)."""

    scene: LevelScene
    probes: _Floats

    @property
    def orders(self) -> range:
        return range(0)

    @property
    def no_orders(self) -> str:
        return "rays trace what more than one surface mirrors"

    @cached_property
    def states(self) -> Mapping[str, LevelScene]:
        """The level with its doors in each state that is tried, by that state in words."""
        if not self.scene.doors:
            return {"": self.scene}
        doors = self.scene.file.geometry.doors
        began = tuple(door.openness for door in doors)
        wanted = {"all doors open": (1.0,) * len(doors), "all doors shut": (0.0,) * len(doors)}
        if began not in wanted.values():
            wanted["doors as at the beginning"] = began
        mesh = self.scene.mesh_with_doors()
        return {name: self.scene.with_doors(openness, mesh) for name, openness in wanted.items()}

    @cached_property
    def trials(self) -> Mapping[str, Trial]:
        return {
            name: Trial.of_level(level, self.probes, WalkedRoom.of(level, self.probes))
            for name, level in self.states.items()
        }

    @cached_property
    def longest_way_s(self) -> float:
        start = self.scene.file.start
        lengths_m = [
            level.path_length_m(self.probes[[emitter for emitter, _ in self.trials[name].pairs], None], self.probes)
            for name, level in self.states.items()
        ]
        lengths_m += [
            level.path_length_m(np.array(start.emitter), np.array(start.listener)) for level in self.states.values()
        ]
        return max(float(each.max()) for each in lengths_m) / SPEED_OF_SOUND

    @property
    def largest_scattering(self) -> float:
        return float(self.scene.place.of_surfaces("scattering").max())

    @property
    def no_mass(self) -> str:
        if self.scene.has_mass:
            return ""
        return "needs surface_mass_kg_m2 of a material (geometry.materials) or of a door (geometry.doors)"

    @property
    def fixed(self) -> Mapping[SimulatedEffect, Fixed]:
        images = "cannot be on in a level, where rays trace what more than one surface mirrors: leave it out"
        tail = "cannot be off in a level, whose rooms and storeys sound different: leave it out"
        return {
            **super().fixed,
            SimulatedEffect.EARLY_REFLECTIONS: Fixed(False, images),
            SimulatedEffect.PER_SOURCE_TAIL: Fixed(True, tail),
        }

    def early_reflections(self, order: int) -> Prediction:
        raise ValueError(f"order: a level has no images of order {order}")

    def per_source_tail(self, *, has_rays: bool) -> Prediction:
        if not has_rays:
            return Prediction(0.0, "level", "no rays are traced, so there is no late tail")
        reason = "always on in levels: rooms, storeys and doors keep late sound apart; by a trial with one tail for all"
        return self.largest(lambda trial: trial.with_one_tail(self.longest_way_s + _MIXED_S), reason)

    def shared_tail(self) -> TailNeeds | None:
        return None

    def diffraction(self) -> Prediction:
        hidden = np.mean(np.concatenate([pairs.hidden for pairs in self._heard.values()]))
        if not hidden:
            return Prediction(0.0, "level", "nothing stands between any two places")
        changes_jnd = {state: pairs.without_diffraction_jnd() for state, pairs in self._heard.items()}
        reason = f"the direct sound of {100 * hidden:.0f} % of the pairs bends round edges"
        return _told(changes_jnd, reason)

    def transmission(self) -> Prediction:
        """Predict the larger change: of the direct sound through walls, or of what rays bring through them."""
        if not self.scene.has_mass:
            return Prediction(0.0, "level", "no material and no door has a mass")
        changes_jnd = {}
        for state, pairs in self._heard.items():
            losses_db = self._losses_db(state)[pairs.hidden]
            changes_jnd[state] = pairs.without_transmission_jnd(losses_db)
        masses = [material.surface_mass_kg_m2 for material in self.scene.place.materials.values()]
        known = [mass for mass in masses if mass]
        ends = dict.fromkeys(f"{mass:g}" for mass in (min(known), max(known)))
        reason = f"walls and doors of {' to '.join(ends)} kg/m2, beside what comes round them"
        direct = _told(changes_jnd, f"{reason}; the direct sound")
        return max(
            direct,
            self.largest(Trial.without_transmission, f"{reason}; by a trial without it"),
            key=lambda each: each.change_jnd,
        )

    @cached_property
    def _heard(self) -> Mapping[str, HeardPairs]:
        """The pairs of the trials, by the state of the doors."""
        heard = {}
        for state, level in self.states.items():
            trial = self.trials[state]
            found = [
                level.sound_paths.find(self.probes[emitter], self.probes[list(receivers)])
                for emitter, receivers in trial.pairs
            ]
            parts = zip(*(vars(each).values() for each in found), strict=True)
            heard[state] = HeardPairs(SoundPaths(*(np.concatenate(part) for part in parts)), trial.reverberant_power())
        return heard

    def _losses_db(self, state: str) -> _Floats:
        """(pair, band) what all walls between the pairs of a trial take; infinite where they let nothing through."""
        level = self.states[state]
        walls = MeshWallLosses(level.surroundings.tree, wall_losses_db(level.place.in_order))
        losses_db = [np.zeros((0, len(OCTAVE_BANDS_HZ)))]
        for emitter, receivers in self.trials[state].pairs:
            lets_through, of_walls_db = walls.between(self.probes[emitter], self.probes[list(receivers)])
            losses_db.append(np.where(lets_through[:, None], of_walls_db, np.inf))
        return np.concatenate(losses_db)


def _told(changes_jnd: Mapping[str, float], reason: str) -> Prediction:
    """The largest of the changes of level, with the state of the doors in which it is."""
    state = max(changes_jnd, key=lambda each: changes_jnd[each])
    largest = changes_jnd[state]
    return Prediction(largest, "level", f"{reason}, with {state}" if state and largest else reason)
