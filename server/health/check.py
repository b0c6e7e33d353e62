"""The health check of a scene bundle. It tests laws that hold in every room and for every computation: at the corners
of the scene, at poses all over it, and at the worst poses that a search finds.

Laws of a field's predictions are checked once per field, before decoding. Laws of responses and of their computation
are checked once per quality level.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from server.acoustics.decibels import amplitude_to_db
from server.core.errors import FieldError, NafirError
from server.field.field import AcousticField, Silence
from server.field.fields_by_level import FieldsByLevel
from server.field.graph import FieldGraph
from server.health import laws, search
from server.health.double_precision import DoubleFullResponse
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
from server.rendering.hrtf import kemar
from server.responses.full_response import FullResponse
from server.scene.bundle import Bundle
from server.scene.manifest import Manifest

Floats = npt.NDArray[np.float64]
Responses = npt.NDArray[np.float32]

_CUT_POSES = 16
_LEVEL = "level "
_CONTINUITY = {
    "listener": (LEVEL_PER_CM, SPECTRUM_PER_CM),
    "emitter": (LEVEL_PER_CM, SPECTRUM_PER_CM),
    "yaw": (LEVEL_PER_DEGREE, SPECTRUM_PER_DEGREE),
}
"""Laws of continuity, by what moves."""


class HealthError(NafirError):
    """A bundle breaks a law. The message names each broken law with its worst pose."""


@dataclass(frozen=True)
class Effort:
    """Numbers of poses tried for each field, and of responses for each level. They are reduced for a field that would
    take longer than `field_s` seconds."""

    scattered: int = 192
    halved: int = 24
    climbing: int = 8
    responses: int = 12
    field_s: float = 12.0

    def of_share(self, share: float) -> "Effort":
        """This share of the effort: at least one pose of each kind, but possibly none to start a search from."""
        counts = {name: max(1, round(getattr(self, name) * share)) for name in ("scattered", "halved", "responses")}
        return replace(self, **counts, climbing=int(self.climbing * share))


@dataclass(frozen=True)
class FieldEvidence:
    """Data for the figure: the poses tried (pose, 7), their energy excess (pose,) and window levels (pose, channel,
    window), and the greatest changes of level over one step, by what moves."""

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
        """Findings of broken laws that the scene's manifest does not accept."""
        return tuple(finding for finding in self.findings if not finding.holds and finding.accepted is None)

    @property
    def accepted(self) -> tuple[Finding, ...]:
        """Findings of broken laws that the manifest accepts."""
        return tuple(finding for finding in self.findings if not finding.holds and finding.accepted is not None)

    def require(self) -> None:
        """Raises HealthError if a law is broken."""
        if self.broken:
            problems = "; ".join(
                f"{finding.of}: {finding.law.label} {finding.value:.3g} {finding.law.unit}".rstrip()
                + f", more than {finding.law.bound:.3g}"
                + (f" at {finding.where}" if finding.pose is not None else "")
                for finding in self.broken
            )
            remedies = " ".join(f"{line}." for line in dict.fromkeys(advice(finding.law) for finding in self.broken))
            raise HealthError(f"scene {self.scene} is not healthy: {problems}. {remedies}")


def advice(law: Law) -> str:
    """What to do about a broken law."""
    if not law.can_be_accepted:
        return f"{law.label}: a fault of the program, not of the scene; please report it"
    return f"{law.label}: {law.remedy}; or, if the room does so, export with --accept {law.name}='why'"


@dataclass(frozen=True)
class FieldsHealth:
    """The health of a bundle's fields. `worst` has the poses (pose, 7) of each field at which its levels are tried."""

    health: Health
    worst: dict[str, Poses]


def check(
    bundle: Bundle,
    effort: Effort | None = None,
    *,
    seed: int = 0,
    track: Callable[[Iterable[str]], Iterable[str]] = iter,
    fields: FieldsHealth | None = None,
) -> Health:
    """Check a bundle. Findings about fields come first. `track` gets the names of fields and levels and yields them one
    by one, to show progress. `fields` is an earlier result for the same fields, which are then not checked again.

    Raises BundleError for a graph that does not fit the manifest.
    """
    started_s = time.perf_counter()
    effort = effort or Effort()
    levels = FieldsByLevel.load(bundle)
    fields = fields or _check_fields(bundle, levels, effort, seed, track)
    findings: list[Finding] = []
    for name in track([f"{_LEVEL}{name}" for name in levels]):
        level = levels[name.removeprefix(_LEVEL)]
        poses = fields.worst.get(level.level.field)
        if poses is None:  # a scene without fields
            poses = scattered(bundle, effort.responses, seed)
        findings += _check_level(level, poses)
    found = (*fields.health.findings, *_with_reasons(bundle, findings))
    return Health(bundle.id, found, fields.health.evidence, time.perf_counter() - started_s)


def check_fields(bundle: Bundle, effort: Effort | None = None, *, seed: int = 0) -> FieldsHealth:
    """Check only the fields' predictions, which depend neither on the scene's noise nor on its levels."""
    return _check_fields(bundle, FieldsByLevel.load(bundle), effort or Effort(), seed, iter)


def _check_fields(
    bundle: Bundle,
    levels: FieldsByLevel,
    effort: Effort,
    seed: int,
    track: Callable[[Iterable[str]], Iterable[str]],
) -> FieldsHealth:
    started_s = time.perf_counter()
    graphs = {level.level.field: level.graph for level in levels.values() if not isinstance(level, Silence)}
    findings: list[Finding] = []
    evidence: dict[str, FieldEvidence] = {}
    worst: dict[str, Poses] = {}
    for name in track(list(graphs)):
        affordable = _affordable(graphs[name], bundle, effort, seed)
        of_field, evidence[name], poses = _check_field(bundle, graphs[name], affordable, seed)
        worst[name] = poses[: affordable.responses]
        findings += of_field
    found = tuple(_with_reasons(bundle, findings))
    return FieldsHealth(Health(bundle.id, found, evidence, time.perf_counter() - started_s), worst)


def _with_reasons(bundle: Bundle, findings: Iterable[Finding]) -> list[Finding]:
    """The findings, with the manifest's reasons for accepting broken laws."""
    reasons = {entry.law: entry.reason for entry in bundle.manifest.accepted}
    return [
        finding
        if finding.holds or not finding.law.can_be_accepted
        else replace(finding, accepted=reasons.get(finding.law.name))
        for finding in findings
    ]


def _affordable(graph: FieldGraph, bundle: Bundle, effort: Effort, seed: int) -> Effort:
    """The effort, reduced to its time limit. The time is estimated from the quicker of two predictions."""
    predictions, pose = Predictions(graph), scattered(bundle, 1, seed)
    times_s = []
    for _ in range(2):
        started_s = time.thread_time()  # CPU time, since other processes must not influence the findings
        predictions.energies(pose)
        times_s.append(time.thread_time() - started_s)
    asked = 6 * effort.scattered + 3 * search.HALVINGS * effort.halved + search.NEIGHBOURS * effort.climbing
    return effort.of_share(min(1.0, effort.field_s / (asked * max(min(times_s), 1e-6))))


def _check_field(
    bundle: Bundle, graph: FieldGraph, effort: Effort, seed: int
) -> tuple[list[Finding], FieldEvidence, Poses]:
    """Findings, their evidence, and poses for the levels: the worst of each law first, then others."""
    rng = np.random.default_rng([seed, 2])
    predictions = Predictions(graph)
    at_corners, spread = corners(bundle), scattered(bundle, effort.scattered, seed)
    poses = np.concatenate([at_corners[:: max(1, len(at_corners) // (2 * effort.scattered))], spread])
    energies = predictions.energies(poses)
    manifest = bundle.manifest
    windows = predictions.windows
    usual_db = laws.usual_rises_db(manifest.reference, energies.shape[-1] - 1, windows.window_s)
    findings = [_worst(DECAY, graph.name, poses, laws.decay_rise_db(energies, usual_db))]
    excess_db = None
    usual_excess_db = laws.usual_excess_db(manifest.reference)
    if (geometry := manifest.geometry) is not None:

        def above_law(some: Poses, found: Energies) -> Floats:
            return laws.energy_excess_db(manifest, geometry, some, found) - usual_excess_db

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
        what: search.steepest(
            bundle, predictions.energies, partial(_change, manifest), spread, moved, kept=effort.halved
        )
        for what, moved in search.moves(spread, rng).items()
    }
    # Measured responses change in steps from one measured place to the next. Fields learned from them do not.
    is_recording = graph.gives_responses and manifest.direct_sound == "field"
    for what, (level, spectrum) in () if is_recording else _CONTINUITY.items():
        for law, change_db in ((level, laws.level_change_db), (spectrum, laws.spectral_change_db)):
            step = steps[what]
            values = change_db(step.before, step.after) - laws.spreading_db(manifest, step.poses, step.moved)
            if len(values):
                findings.append(_worst(law, graph.name, steps[what].poses, values, what))
    if not graph.gives_responses and graph.parameters.known_frames:
        some = spread[:_CUT_POSES]
        share = laws.branch_cut_share(predictions.spectrograms(some).instantaneous_frequency)
        findings.append(Finding(BRANCH_CUT, graph.name, share, len(some)))
    worst = np.array([finding.pose for finding in findings if finding.pose is not None])
    findings.insert(0, Finding(FINITE, graph.name, float(predictions.faults), predictions.poses))
    evidence = FieldEvidence(
        poses,
        excess_db,
        laws.window_levels_db(energies),
        {what: laws.level_change_db(some.before, some.after) for what, some in steps.items()},
    )
    return findings, evidence, np.concatenate([worst, spread])


def _change(manifest: Manifest, step: search.Steps) -> Floats:
    """Change of level or of spectrum, whichever is more, as a multiple of its bound."""
    spreading_db = laws.spreading_db(manifest, step.poses, step.moved)
    level = (laws.level_change_db(step.before, step.after) - spreading_db) / LEVEL_PER_CM.bound
    spectrum = (laws.spectral_change_db(step.before, step.after) - spreading_db) / SPECTRUM_PER_CM.bound
    return np.maximum(level, spectrum)


def _check_level(field: AcousticField, poses: Poses) -> list[Finding]:
    """Findings about a level's responses: peak, exactness, and whether repeated and single computations agree."""
    name = field.level.name
    answers = np.array([_answers(field, poses[row : row + 1]) for row in range(len(poses))])
    findings = [_worst(FINITE, name, poses, np.where(answers, 0.0, 1.0))]
    if not answers.any():
        return findings
    poses = poses[answers]
    together, again = _responses(field, poses), _responses(field, poses)
    alone = np.concatenate([_responses(field, poses[row : row + 1]) for row in range(len(poses))])
    head = kemar(field.sample_rate)
    whole = _responses(FullResponse(field, head), poses)
    exact = _responses(DoubleFullResponse(field, head), poses)
    from_zero_phase = field.level.phase.kind == "griffin_lim" and not field.level.phase.warm
    if field.bundle.manifest.direct_sound == "geometry":  # measured responses have an unknown unit
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


def _responses(field: AcousticField | FullResponse, poses: Poses) -> Responses:
    return field.impulse_responses(poses[:, LISTENER], poses[:, EMITTER], poses[:, YAW])


def _difference_db(responses: Responses, reference: Responses) -> Floats:
    """(pose,) energy in dB of the difference of responses (pose, channel, sample), relative to the reference; -inf if
    they are equal."""
    exact = reference.astype(np.float64)
    difference = np.linalg.norm(responses - exact, axis=(1, 2))
    whole = np.maximum(np.linalg.norm(exact, axis=(1, 2)), np.finfo(np.float32).tiny)
    return np.asarray(amplitude_to_db(difference / whole))


def _worst(law: Law, of: str, poses: Poses, values: Floats, moving: str | None = None) -> Finding:
    at = int(np.argmax(search.known(values)))
    return Finding(law, of, float(values[at]), len(values), poses[at], moving)
