"""The health of a scene bundle: laws that hold of every room and of every computation, tried at its corners, all over
it, and at the worst poses that a search finds.

Laws of what a field predicts are checked once per field, before decoding; laws of responses, and of how they are
computed, once per quality level.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import amplitude_to_db
from server.errors import FieldError, NafirError
from server.field.field import AcousticField, Silence
from server.field.graph import FieldGraph
from server.field.levels import Levels
from server.health import laws, search
from server.health.double_precision import DoubleWholeField
from server.health.energies import Energies, Predictions
from server.health.findings import (
    BATCH,
    BRANCH_CUT,
    DECAY,
    DOUBLE,
    ENERGY,
    FINITE,
    ITERATED,
    LEVEL_PER_CM,
    LEVEL_PER_DEGREE,
    PEAK,
    REPEATABLE,
    SPECTRUM_PER_CM,
    SPECTRUM_PER_DEGREE,
    Finding,
    Law,
)
from server.health.poses import EMITTER, LISTENER, YAW, Poses, corners, scattered
from server.scene.bundle import Bundle
from server.whole_field import WholeField, kemar

Floats = npt.NDArray[np.float64]
Responses = npt.NDArray[np.float32]

_CUT_POSES = 16
_LEVEL = "level "
_CONTINUITY = {
    "listener": (LEVEL_PER_CM, SPECTRUM_PER_CM),
    "emitter": (LEVEL_PER_CM, SPECTRUM_PER_CM),
    "yaw": (LEVEL_PER_DEGREE, SPECTRUM_PER_DEGREE),
}
"""By what moves."""


class HealthError(NafirError):
    """A bundle that breaks a law; the message names each with the worst pose."""


@dataclass(frozen=True)
class Effort:
    """How many poses are tried of each field, and responses of each level; fewer where a field would take longer than
    `field_s` seconds."""

    scattered: int = 192
    halved: int = 24
    climbing: int = 8
    responses: int = 12
    field_s: float = 12.0

    def of_share(self, share: float) -> "Effort":
        """That share of the poses, one at least, but none to climb from where there is no time for that."""
        counts = {name: max(1, round(getattr(self, name) * share)) for name in ("scattered", "halved", "responses")}
        return replace(self, **counts, climbing=int(self.climbing * share))


@dataclass(frozen=True)
class FieldEvidence:
    """What figures are drawn from: of each pose tried (pose, 7) its energy excess (pose,) and the level of each window
    (pose, channel, window); by what moves, the greatest changes of level over one step."""

    poses: Poses
    excess_db: Floats | None
    decays_db: Floats
    changes_db: dict[str, Floats]


@dataclass(frozen=True)
class Health:
    scene: str
    findings: tuple[Finding, ...]
    evidence: dict[str, FieldEvidence]
    seconds: float

    @property
    def broken(self) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if not finding.holds)

    def require(self) -> None:
        """Raises HealthError if a law is broken."""
        if self.broken:
            problems = "; ".join(
                f"{finding.of}: {finding.law.label} {finding.value:.3g} {finding.law.unit}".rstrip()
                + f", more than {finding.law.bound:.3g}"
                + (f" at {finding.where}" if finding.pose is not None else "")
                for finding in self.broken
            )
            raise HealthError(f"scene {self.scene} is not healthy: {problems}")


def check(
    bundle: Bundle,
    effort: Effort | None = None,
    *,
    seed: int = 0,
    track: Callable[[Iterable[str]], Iterable[str]] = iter,
) -> Health:
    """All findings, fields first. `track` is given the names of fields and levels, and hands them on as they are done.

    Raises BundleError for a graph that does not fit the manifest.
    """
    started_s = time.perf_counter()
    effort = effort or Effort()
    levels = Levels.load(bundle)
    graphs = {level.level.field: level.graph for level in levels.values() if not isinstance(level, Silence)}
    findings: list[Finding] = []
    evidence: dict[str, FieldEvidence] = {}
    worst: dict[str, Poses] = {}
    for name in track([*graphs, *(f"{_LEVEL}{name}" for name in levels)]):
        if name in graphs:
            affordable = _affordable(graphs[name], bundle, effort, seed)
            of_field, evidence[name], poses = _check_field(bundle, graphs[name], affordable, seed)
            worst[name] = poses[: affordable.responses]
            findings += of_field
        else:
            level = levels[name.removeprefix(_LEVEL)]
            if level.level.field not in worst:  # in a scene without a field
                worst[level.level.field] = scattered(bundle, effort.responses, seed)
            findings += _check_level(level, worst[level.level.field])
    return Health(bundle.id, tuple(findings), evidence, time.perf_counter() - started_s)


def _affordable(graph: FieldGraph, bundle: Bundle, effort: Effort, seed: int) -> Effort:
    """As much of the effort as takes no longer than it allows, judged by the quicker of two predictions."""
    predictions, pose = Predictions(graph), scattered(bundle, 1, seed)
    times_s = []
    for _ in range(2):
        started_s = time.thread_time()  # other processes must not decide what is found
        predictions.energies(pose)
        times_s.append(time.thread_time() - started_s)
    asked = 6 * effort.scattered + 3 * search.HALVINGS * effort.halved + search.NEIGHBOURS * effort.climbing
    return effort.of_share(min(1.0, effort.field_s / (asked * max(min(times_s), 1e-6))))


def _check_field(
    bundle: Bundle, graph: FieldGraph, effort: Effort, seed: int
) -> tuple[list[Finding], FieldEvidence, Poses]:
    """Findings, what they rest on, and poses from the worst on: those of each law, then others."""
    rng = np.random.default_rng([seed, 2])
    predictions = Predictions(graph)
    at_corners, spread = corners(bundle), scattered(bundle, effort.scattered, seed)
    poses = np.concatenate([at_corners[:: max(1, len(at_corners) // (2 * effort.scattered))], spread])
    energies = predictions.energies(poses)
    findings = [_worst(DECAY, graph.name, poses, laws.decay_rise_db(energies))]
    excess_db = None
    manifest = bundle.manifest
    if (geometry := manifest.geometry) is not None:

        def above_law(some: Poses, found: Energies) -> Floats:
            return laws.energy_excess_db(manifest, geometry, some, found)

        excess_db = above_law(poses, energies)
        climbed, values = search.climb(
            bundle,
            lambda some: above_law(some, predictions.energies(some)),
            poses[np.argsort(-search.known(excess_db))[: effort.climbing]],
            rng,
        )
        tried = np.concatenate([poses, climbed])
        findings.append(_worst(ENERGY, graph.name, tried, np.concatenate([excess_db, values])))
    steps = {
        what: search.steepest(bundle, predictions.energies, _change, spread, moved, kept=effort.halved)
        for what, moved in search.moves(spread, rng).items()
    }
    # Measured responses step from one place to the next, as they were measured; what is learned of them does not.
    is_recording = graph.gives_responses and manifest.direct_sound == "field"
    for what, (level, spectrum) in () if is_recording else _CONTINUITY.items():
        for law, change_db in ((level, laws.level_change_db), (spectrum, laws.spectral_change_db)):
            values = change_db(steps[what].before, steps[what].after)
            if len(values):
                findings.append(_worst(law, graph.name, steps[what].poses, values, what))
    if not graph.gives_responses:
        some = spread[:_CUT_POSES]
        share = laws.branch_cut_share(predictions.spectrograms(some).instantaneous_frequency)
        findings.append(Finding(BRANCH_CUT, graph.name, share, len(some)))
    worst = np.array([finding.pose for finding in findings if finding.pose is not None])
    findings.insert(0, Finding(FINITE, graph.name, float(predictions.faults), predictions.asked))
    evidence = FieldEvidence(
        poses,
        excess_db,
        laws.window_levels_db(energies),
        {what: laws.level_change_db(some.before, some.after) for what, some in steps.items()},
    )
    return findings, evidence, np.concatenate([worst, spread])


def _change(before: Energies, after: Energies) -> Floats:
    """In units of what is allowed, of level or spectrum, whichever is more."""
    level = laws.level_change_db(before, after) / LEVEL_PER_CM.bound
    return np.maximum(level, laws.spectral_change_db(before, after) / SPECTRUM_PER_CM.bound)


def _check_level(field: AcousticField, poses: Poses) -> list[Finding]:
    """Of responses at some poses: how loud, how exact, and whether they are the same again, and alone."""
    name = field.level.name
    answers = np.array([_answers(field, poses[row : row + 1]) for row in range(len(poses))])
    findings = [_worst(FINITE, name, poses, np.where(answers, 0.0, 1.0))]
    if not answers.any():
        return findings
    poses = poses[answers]
    together, again = _responses(field, poses), _responses(field, poses)
    alone = np.concatenate([_responses(field, poses[row : row + 1]) for row in range(len(poses))])
    head = kemar(field.sample_rate)
    whole = _responses(WholeField(field, head), poses)
    exact = _responses(DoubleWholeField(field, head), poses)
    from_zero_phase = field.level.phase.kind == "griffin_lim" and not field.level.phase.warm
    if field.bundle.manifest.direct_sound == "geometry":  # else, in whatever unit it was measured
        findings.append(_worst(PEAK, name, poses, np.abs(together).max(axis=(1, 2)).astype(np.float64)))
    return [
        *findings,
        _worst(REPEATABLE, name, poses, np.abs(together - again).max(axis=(1, 2)).astype(np.float64)),
        _worst(BATCH, name, poses, _difference_db(together, alone)),
        _worst(ITERATED if from_zero_phase else DOUBLE, name, poses, _difference_db(whole, exact)),
    ]


def _answers(field: AcousticField, pose: Poses) -> bool:
    try:
        _responses(field, pose)
    except FieldError:
        return False
    return True


def _responses(field: AcousticField | WholeField, poses: Poses) -> Responses:
    return field.impulse_responses(poses[:, LISTENER], poses[:, EMITTER], poses[:, YAW])


def _difference_db(responses: Responses, reference: Responses) -> Floats:
    """(pose,) energy of the difference of (pose, channel, sample) re that of the reference; -inf where they agree."""
    exact = reference.astype(np.float64)
    difference = np.linalg.norm(responses - exact, axis=(1, 2))
    whole = np.maximum(np.linalg.norm(exact, axis=(1, 2)), np.finfo(np.float32).tiny)
    return np.asarray(amplitude_to_db(difference / whole))


def _worst(law: Law, of: str, poses: Poses, values: Floats, moving: str | None = None) -> Finding:
    at = int(np.argmax(search.known(values)))
    return Finding(law, of, float(values[at]), len(values), poses[at], moving)
