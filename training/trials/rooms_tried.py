"""Tests predictions of plans: for rooms of extreme absorption, volume and shape, it compares the predicted change
without an effect with the change in simulated responses. `make predictions` prints the table.

A prediction comes from the energies of a few rays. The responses it is compared with are whole and binaural, from many
rays and noise. Their parameters are measured like those of real responses, in octave bands of a separate filter. Both
simulations of a pair use the same noise. Differences of a parameter are averaged over pairs with their sign, so that
chance cancels out. For a parameter that is as often higher as lower, the root mean square counts, minus that of two
random draws of the same simulation.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from time import process_time

import numpy as np
import numpy.typing as npt
from rich.console import Console
from rich.table import Table
from scipy.signal import butter, sosfilt

from server.acoustics.audibility import JND_THRESHOLDS
from server.acoustics.bands import OCTAVE_BANDS_HZ
from server.acoustics.room_parameters import RoomParameters, measure
from server.scene.geometry import Geometry, Material, Materials, Opening
from server.scene.manifest import Start
from training.data.scene_file import Probes, SceneFile, Simulation
from training.data.simulation_plan import SimulatedEffect, SimulationPlan
from training.simulation.check import GeometricResponses
from training.simulation.pairs import PairSimulation
from training.simulation.planner import THRESHOLD, planner_of

_Floats = npt.NDArray[np.float64]

_BANDS = len(OCTAVE_BANDS_HZ)
_TRIED = (
    SimulatedEffect.LATE_REVERBERATION,
    SimulatedEffect.SCATTERING,
    SimulatedEffect.PER_SOURCE_TAIL,
    SimulatedEffect.AIR_ABSORPTION,
    SimulatedEffect.EARLY_REFLECTIONS,
    SimulatedEffect.DIFFRACTION,
    SimulatedEffect.TRANSMISSION,
)
AUDIBLE_JND = 1.0
# In standard errors. It is large because the greatest of two dozen differences counts.
_ERRORS = 2.5


@dataclass(frozen=True)
class Compared:
    """One effect in one room, in JND: the predicted change, and the simulated change without what chance explains."""

    room: str
    effect: SimulatedEffect
    is_on: bool
    predicted: float
    simulated: float
    parameter: str

    @property
    def is_wrong(self) -> bool:
        """Whether the effect is off although leaving it out is audible."""
        return not self.is_on and self.simulated >= AUDIBLE_JND


def _box(x: float, y: float) -> tuple[tuple[float, float], ...]:
    return (0.0, 0.0), (x, 0.0), (x, y), (0.0, y)


def _room(
    name: str,
    corners: tuple[tuple[float, float], ...],
    height_m: float,
    *,
    duration_s: float,
    spacing_m: float,
    walls: tuple[float, float],
    floor: tuple[float, float] | None = None,
    ceiling: tuple[float, float] | None = None,
    mass: float | None = None,
    openings: tuple[Opening, ...] = (),
    places: tuple[tuple[float, float], tuple[float, float]] | None = None,
) -> SceneFile:
    """`walls`, `floor` and `ceiling` are (absorption, scattering), the same for all bands."""

    def material(shares: tuple[float, float], mass: float | None = None) -> Material:
        absorption, scattering = ((share,) * _BANDS for share in shares)
        return Material(absorption=absorption, scattering=scattering, surface_mass_kg_m2=mass)

    (x, y), (low, high) = np.ptp(corners, axis=0).tolist(), (0.45 * height_m, 0.65 * height_m)
    listener, emitter = places or ((0.3 * x, 0.3 * y), (0.7 * x, 0.7 * y))
    middle_m = (low + high) / 2
    return SceneFile(
        id=name,
        name=name,
        description="",
        geometry=Geometry(
            height_m=height_m,
            corners=corners,
            openings=openings,
            materials=Materials(
                walls=material(walls, mass), floor=material(floor or walls), ceiling=material(ceiling or walls)
            ),
        ),
        start=Start(listener=(*listener, middle_m), emitter=(*emitter, middle_m)),
        probes=Probes(spacing_m=spacing_m, jitter_m=spacing_m / 8, wall_clearance_m=0.25, heights_m=(low, high)),
        simulation=Simulation(
            sample_rate=24_000,
            duration_s=duration_s,
            yaws=1,
            rays=6_000,
            image_order=3,
            arrival_directions=12,
            held_out_share=0.1,
        ),
    )


def rooms() -> tuple[SceneFile, ...]:
    ell = ((0.0, 0.0), (9.0, 0.0), (9.0, 7.6), (7.4, 7.6), (7.4, 1.6), (0.0, 1.6))
    left = (0.0, 0.0), (4.0, 0.0), (4.0, 1.8)
    right = (4.1, 1.8), (4.1, 0.0), (9.0, 0.0), (9.0, 5.0), (4.1, 5.0), (4.1, 2.7)
    coupled = (*left, *right, (4.0, 2.7), (4.0, 5.0), (0.0, 5.0))
    door = Opening(name="door", start=(4.05, 1.8), end=(4.05, 2.7))
    dull, hard = (0.9, 0.3), (0.03, 0.1)
    return (
        _room("bathroom", _box(2, 2.5), 2.4, duration_s=3.2, spacing_m=0.6, walls=(0.02, 0.05)),
        _room("booth", _box(1.6, 1.4), 2.1, duration_s=0.25, spacing_m=0.4, walls=(0.85, 0.5)),
        _room("dry-box", _box(3, 2.5), 2.4, duration_s=0.25, spacing_m=0.7, walls=(0.995, 0.3)),
        _room("flutter", _box(8, 3), 2.6, duration_s=1.6, spacing_m=1.5, walls=hard, floor=hard, ceiling=dull),
        _room("smooth-hall", _box(30, 20), 10, duration_s=3.0, spacing_m=6, walls=(0.2, 0.02)),
        _room("tunnel", _box(60, 3), 3, duration_s=6.0, spacing_m=8, walls=(0.1, 0.1)),
        _room("plate", _box(20, 20), 1.2, duration_s=1.2, spacing_m=5, walls=(0.2, 0.3)),
        _room("rough", _box(6, 5), 3, duration_s=0.6, spacing_m=1.5, walls=(0.3, 0.9)),
        _room(
            "corner",
            ell,
            2.6,
            duration_s=1.2,
            spacing_m=1.6,
            walls=(0.06, 0.1),
            floor=hard,
            ceiling=(0.4, 0.2),
            places=((1.0, 0.8), (8.2, 6.5)),
        ),
        _room(
            "coupled",
            coupled,
            2.5,
            duration_s=1.2,
            spacing_m=1.4,
            walls=(0.1, 0.2),
            mass=8.0,
            openings=(door,),
            places=((1.0, 1.0), (8.0, 4.0)),
        ),
    )


def compare(scene: SceneFile, *, emitters: int, rays: int, seed: int = 0) -> Iterator[Compared]:
    """Compares, for each effect that the scene could have, the simulation without it with the one that has every
    effect."""
    scene = scene.model_copy(update={"simulation": scene.simulation.model_copy(update={"rays": rays})})
    planner = planner_of(scene, seed)
    decided = {each.name: each for each in planner.plan({}).decisions}
    everything, tail = planner.everything, planner.plan({SimulatedEffect.PER_SOURCE_TAIL: False})
    responses = partial(_responses, scene, emitters)
    whole, again = responses(everything, seed), responses(everything, seed + 1)
    for effect in _TRIED:
        without = _without(everything, tail, effect)
        if without is None:
            continue
        jnd, parameter = _difference(whole, responses(without, seed), again, scene.simulation.sample_rate)
        yield Compared(scene.id, effect, decided[effect].called_for, decided[effect].change_jnd, jnd, parameter)


def _without(plan: SimulationPlan, tail: SimulationPlan, effect: SimulatedEffect) -> SimulationPlan | None:
    """The plan without the effect; None if the scene does not have the effect."""
    match effect:
        case SimulatedEffect.LATE_REVERBERATION:
            return replace(plan, rays=0)
        case SimulatedEffect.SCATTERING:
            return replace(plan, scattering=False)
        case SimulatedEffect.PER_SOURCE_TAIL if tail.tail_start_s is not None:
            return replace(plan, tail_start_s=tail.tail_start_s, tail_rays=8 * plan.rays)
        case SimulatedEffect.AIR_ABSORPTION:
            return replace(plan, air_absorption=False)
        case SimulatedEffect.EARLY_REFLECTIONS:
            return replace(plan, image_order=1)
        case SimulatedEffect.DIFFRACTION if plan.diffraction:
            return replace(plan, diffraction=False)
        case SimulatedEffect.TRANSMISSION if plan.transmission:
            return replace(plan, transmission=False)
    return None


def _responses(scene: SceneFile, emitters: int, plan: SimulationPlan, seed: int) -> _Floats:
    """(pair, ear, sample) responses between the probes of seed 0, for any seed of the simulation."""
    probes, yaws = scene.probe_positions(0), np.zeros(1)
    simulation = PairSimulation.prepare(scene, probes, yaws, seed=seed, plan=plan)
    geometric = GeometricResponses(scene, plan, probes, yaws)
    heard = []
    for emitter in np.unique(np.linspace(0, len(probes) - 1, emitters).astype(int)).tolist():
        listeners = np.delete(np.arange(len(probes)), emitter)
        late = [response for _, _, response in simulation.take(emitter, listeners, 0)]
        heard.append((np.stack(late) + geometric.responses(emitter, listeners))[:, 0])
    return np.concatenate(heard).astype(np.float64)


def _difference(whole: _Floats, other: _Floats, again: _Floats, sample_rate: int) -> tuple[float, str]:
    """The greatest difference in JND over parameters and octave bands, and its parameter."""
    largest, which = 0.0, "level"
    for centre_hz in OCTAVE_BANDS_HZ[1:]:  # in the lowest band, a room has too few modes
        edges_hz = np.clip([centre_hz / np.sqrt(2), centre_hz * np.sqrt(2)], 1, 0.49 * sample_rate)
        octave = butter(3, edges_hz, "bandpass", fs=sample_rate, output="sos")
        reference, left, drawn = (
            _in_jnd(measure(sosfilt(octave, each), sample_rate)) for each in (whole, other, again)
        )
        for name, values in reference.items():
            changed, chance = left[name] - values, drawn[name] - values
            is_known = np.isfinite(changed) & np.isfinite(chance)
            if is_known.sum() < 6:
                continue
            # The two ears of a pair are not independent.
            share = _ERRORS / np.sqrt(is_known.sum() / 2)
            bias = abs(float(changed[is_known].mean())) - share * float(changed[is_known].std())
            squares, by_chance = changed[is_known] ** 2, chance[is_known] ** 2
            beyond = squares.mean() - by_chance.mean() - share * np.hypot(squares.std(), by_chance.std())
            jnd = max(bias, float(np.sqrt(max(0.0, beyond))))
            if jnd > largest:
                largest, which = jnd, name
    return min(largest, 100.0), which


def _in_jnd(measured: RoomParameters) -> dict[str, _Floats]:
    """(pair, ear) values of each parameter on a scale whose unit is one JND."""

    def percent(seconds: _Floats, name: str) -> _Floats:
        return 100 * np.log(seconds) / JND_THRESHOLDS[name].amount

    with np.errstate(invalid="ignore", divide="ignore"):
        return {
            "level": measured.level_db / JND_THRESHOLDS["level"].amount,
            "c50": measured.clarity_db / JND_THRESHOLDS["c50"].amount,
            "edt": percent(measured.early_decay_time_s, "edt"),
            "t60": percent(measured.reverberation_time_s, "t60"),
        }


def table(rows: list[Compared]) -> Table:
    shown = Table(
        title=f"an effect is on from {THRESHOLD.enter_jnd:g} JND; heard from {AUDIBLE_JND:g}", title_justify="left"
    )
    for column in ("room", "effect", "plan", "predicted", "simulated", "of", ""):
        shown.add_column(column, justify="right" if column in {"predicted", "simulated"} else "left", no_wrap=True)
    for row in rows:
        verdict = (
            "WRONG" if row.is_wrong else "on, not heard" if row.is_on and row.simulated < THRESHOLD.enter_jnd else ""
        )
        state = "on" if row.is_on else "off"
        numbers = f"{row.predicted:.2f}", f"{row.simulated:.2f}"
        shown.add_row(row.room, row.effect.replace("_", " "), state, *numbers, row.parameter, verdict)
    return shown


def main() -> int:
    """The exit code: 1 if an audible effect is off."""
    rows: list[Compared] = []
    began_s, progress = process_time(), Console(stderr=True)
    for scene in rooms():
        rows += compare(scene, emitters=3, rays=6_000)
        progress.print(f"{scene.id}: {process_time() - began_s:.0f} s of one core so far")
    Console(width=110).print(table(rows))
    return int(any(row.is_wrong for row in rows))


if __name__ == "__main__":
    sys.exit(main())
