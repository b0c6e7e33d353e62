"""Decisions about what the simulation of a scene computes.

An effect is called for if leaving it out would change some parameter by a quarter of a just-noticeable difference or
more: errors of the data add to the errors of the fields trained on them, which are two to three times as large.
"""

from dataclasses import replace

from server.planning.decision import Threshold
from training.data.dataset import GEOMETRIC_ORDER
from training.data.levels.level_scene import LevelScene
from training.data.scene_file import SceneFile, SceneFileError
from training.data.simulation_plan import Overrides, SimulatedEffect, SimulationDecision, SimulationPlan
from training.simulation.predictions import Prediction, Predictions
from training.simulation.size import SimulationSize

THRESHOLD = Threshold(enter_jnd=0.25, leave_jnd=0.25)


def planner_of(scene: SceneFile, seed: int) -> "SimulationPlanner":
    """Return the planner for the probes of a dataset with this seed. Raises SceneFileError if the scene is too large to
    be simulated, or too large for its responses."""
    SimulationSize(scene).require_reasonable()
    return SimulationPlanner(Predictions(scene, scene.probe_positions(seed)))


def plan_of_level(scene: LevelScene) -> SimulationPlan:
    """Return the plan for a level, which leaves nothing out: what its effects change is not predicted."""
    masses = [material.surface_mass_kg_m2 for material in scene.place.materials.values()]
    plan = SimulationPlan.everything(GEOMETRIC_ORDER, scene.simulation.rays, transmission=any(masses))
    note = "levels are simulated with everything on; what more than one surface mirrors is traced by rays"
    return replace(plan, notes=(note,))


class SimulationPlanner:
    """A planner for one scene. Its predictions do not depend on overrides, so plans share them."""

    def __init__(self, predictions: Predictions) -> None:
        self._predictions = predictions
        self._settings = predictions.scene.simulation
        self._refuse_what_is_too_far()
        self._by_order = {
            order: predictions.early_reflections(order)
            for order in range(GEOMETRIC_ORDER + 1, self._settings.image_order + 1)
        }

    @property
    def everything(self) -> SimulationPlan:
        """The plan with every effect on that the scene file allows."""
        has_mass = self._predictions.scene.geometry.materials.walls.surface_mass_kg_m2 is not None
        never = {SimulatedEffect.DIRECTIVITY: False, SimulatedEffect.TRANSMISSION: has_mass}
        return self.plan({**dict.fromkeys(SimulatedEffect, True), **never})

    def plan(self, overrides: Overrides) -> SimulationPlan:
        """Make a plan. Raises SceneFileError for an override that the scene cannot follow."""
        predicted = self._predictions
        self._refuse_what_cannot_be(overrides)
        order, images = self._images(overrides)
        late = predicted.late_reverberation()
        has_rays = THRESHOLD.decides(late.change_jnd, overrides.get(SimulatedEffect.LATE_REVERBERATION))
        scattering = predicted.scattering(has_rays=has_rays)
        scatters = THRESHOLD.decides(scattering.change_jnd, overrides.get(SimulatedEffect.SCATTERING))
        decided = {
            SimulatedEffect.EARLY_REFLECTIONS: images,
            SimulatedEffect.LATE_REVERBERATION: late,
            SimulatedEffect.SCATTERING: scattering,
            SimulatedEffect.PER_SOURCE_TAIL: predicted.per_source_tail(has_rays=has_rays),
            SimulatedEffect.AIR_ABSORPTION: predicted.air_absorption(has_rays=has_rays, scatters=scatters),
            SimulatedEffect.DIFFRACTION: predicted.diffraction(),
            SimulatedEffect.TRANSMISSION: predicted.transmission(),
            SimulatedEffect.DIRECTIVITY: Prediction(
                0.0, "level", "fields are of emitters that radiate all round; rendering gives each its directivity"
            ),
        }
        is_on = {name: THRESHOLD.decides(each.change_jnd, overrides.get(name)) for name, each in decided.items()}
        has_own_tails = is_on[SimulatedEffect.PER_SOURCE_TAIL]
        shares_tail = has_rays and not has_own_tails and not predicted.ends_before_tail
        rays = predicted.rays() if shares_tail else self._settings.rays
        return SimulationPlan(
            image_order=order,
            rays=rays if has_rays else 0,
            tail_start_s=predicted.tail_start_s if shares_tail else None,
            tail_rays=predicted.tail_rays() if shares_tail else 0,
            scattering=is_on[SimulatedEffect.SCATTERING],
            air_absorption=is_on[SimulatedEffect.AIR_ABSORPTION],
            diffraction=is_on[SimulatedEffect.DIFFRACTION],
            transmission=is_on[SimulatedEffect.TRANSMISSION],
            decisions=tuple(
                SimulationDecision(name, is_on[name], **vars(prediction), overridden=name in overrides)
                for name, prediction in decided.items()
            ),
            notes=predicted.notes(has_rays=has_rays),
        )

    def _images(self, overrides: Overrides) -> tuple[int, Prediction]:
        """Return the highest reflection order that is called for, and the change without all orders beyond those
        computed from geometry."""
        called_for = [order for order, each in self._by_order.items() if THRESHOLD.is_reached(each.change_jnd)]
        order = max(called_for, default=GEOMETRIC_ORDER)
        if SimulatedEffect.EARLY_REFLECTIONS in overrides:
            order = self._settings.image_order if overrides[SimulatedEffect.EARLY_REFLECTIONS] else GEOMETRIC_ORDER
        if not self._by_order:
            return order, Prediction(0.0, "spectrum", "the scene file asks for none beyond those left to geometry")
        largest = max(self._by_order.values(), key=lambda each: each.change_jnd)
        reason = "; ".join(f"{each.reason} ({each.change_jnd:.2f} JND)" for each in self._by_order.values())
        return order, Prediction(largest.change_jnd, largest.parameter, reason)

    def _refuse_what_is_too_far(self) -> None:
        longest_s, duration_s = self._predictions.longest_way_s, self._settings.duration_s
        if longest_s >= duration_s:
            needed_s = self._predictions.needed_s
            also = f"; {needed_s:.2f} s would hold reverberation too" if needed_s < float("inf") else ""
            raise SceneFileError(
                f"{self._predictions.scene.id}: simulation.duration_s: sound needs up to {longest_s:.2f} s from one "
                f"place to another, and a response ends after {duration_s:g} s{also}"
            )

    def _refuse_what_cannot_be(self, overrides: Overrides) -> None:
        scene = self._predictions.scene
        if overrides.get(SimulatedEffect.DIRECTIVITY):
            raise SceneFileError(
                f"{scene.id}: effects.directivity: cannot be on: probes radiate all round, and directivity is applied "
                "where emitters are rendered"
            )
        if overrides.get(SimulatedEffect.TRANSMISSION) and scene.geometry.materials.walls.surface_mass_kg_m2 is None:
            raise SceneFileError(f"{scene.id}: effects.transmission: needs geometry.materials.walls.surface_mass_kg_m2")
