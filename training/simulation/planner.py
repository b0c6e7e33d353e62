"""Decisions about what the simulation of a scene computes.

An effect is called for if leaving it out would change some parameter by a quarter of a just-noticeable difference or
more: errors of the data add to the errors of the fields trained on them, which are two to three times as large.
"""

from server.planning.decision import Threshold
from training.data.dataset import GEOMETRIC_ORDER
from training.data.levels.level_scene import LevelScene
from training.data.scene_file import SceneFile, SceneFileError
from training.data.simulation_plan import Overrides, SimulatedEffect, SimulationDecision, SimulationPlan
from training.simulation.level_predictions import LevelPredictions
from training.simulation.plan_predictions import PlanPredictions
from training.simulation.predictions import Prediction, Predictions
from training.simulation.size import SimulationSize, level_extent

THRESHOLD = Threshold(enter_jnd=0.25, leave_jnd=0.25)


def planner_of(scene: SceneFile | LevelScene, seed: int) -> "SimulationPlanner":
    """Return the planner for the probes of a dataset with this seed. Raises SceneFileError if the scene is too large to
    be simulated, or too large for its responses."""
    if isinstance(scene, LevelScene):
        probes = scene.probe_positions(seed)
        level_extent(scene, len(probes))  # before anything is traced
        return SimulationPlanner(LevelPredictions(scene, probes))
    SimulationSize(scene).require_reasonable()
    return SimulationPlanner(PlanPredictions(scene, scene.probe_positions(seed)))


class SimulationPlanner:
    """A planner for one scene. Its predictions do not depend on overrides, so plans share them."""

    def __init__(self, predictions: Predictions) -> None:
        self._predictions = predictions
        self._settings = predictions.scene.simulation
        self._refuse_what_is_too_far()
        self._by_order = {order: predictions.early_reflections(order) for order in predictions.orders}

    @property
    def everything(self) -> SimulationPlan:
        """The plan with every effect on that the scene file allows."""
        fixed = {name: each.is_on for name, each in self._predictions.fixed.items()}
        return self.plan({**dict.fromkeys(SimulatedEffect, True), **fixed})

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
        fixed = {name: each.is_on for name, each in predicted.fixed.items()}
        if not has_rays:
            fixed.pop(SimulatedEffect.PER_SOURCE_TAIL, None)
        wanted = {**overrides, **fixed}
        is_on = {name: THRESHOLD.decides(each.change_jnd, wanted.get(name)) for name, each in decided.items()}
        has_own_tails = is_on[SimulatedEffect.PER_SOURCE_TAIL]
        tail = predicted.shared_tail() if has_rays and not has_own_tails else None
        rays = self._settings.rays if tail is None else tail.rays
        return SimulationPlan(
            image_order=order,
            rays=rays if has_rays else 0,
            tail_start_s=None if tail is None else tail.start_s,
            tail_rays=0 if tail is None else tail.tail_rays,
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
            return order, Prediction(0.0, "spectrum", self._predictions.no_orders)
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
        for name, fixed in self._predictions.fixed.items():
            if overrides.get(name, fixed.is_on) != fixed.is_on:
                raise SceneFileError(f"{self._predictions.scene.id}: effects.{name}: {fixed.otherwise}")
