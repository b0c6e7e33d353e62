"""Fields trained on measured responses, read from their run folders. A bundle cannot contain them, because their walls
are unknown.

A field predicts magnitudes, and phase as far as it is known. The rest of the phase is that of frozen noise, as in the
server. Measured responses include direct sound, so nothing is added.

Axes: B poses; (B, channel, frequency, frame) and (B, channel, sample).
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch

from server.acoustics.codec import Codec
from server.acoustics.phase import FrozenNoise, correlated_noise, separate
from training.baselines.held_out import EvaluationError, HeldOut, Responses
from training.data.responses import ResponseSet
from training.evaluation.evaluate import Column
from training.evaluation.fields import INTEGRATED
from training.learning.factorised import FactorisedLearner
from training.learning.naf import NafLearner
from training.learning.runs import Configuration, record_of
from training.learning.train import load_learner
from training.models.factorised import ExportedField
from training.models.frozen_noise import even_noise
from training.models.naf_graph import NafGraph
from training.models.targets import LEAD_SAMPLES, align
from training.simulation.responses import SimulatedResponses

Outputs = tuple[npt.NDArray[np.float32], ...]
_BYTES_PER_PARAMETER = 2
"""Half precision, as in a bundle."""


def run_columns(run: Path, responses: ResponseSet, held_out: HeldOut) -> list[Column]:
    """Make the column of a run, and for a network that has learned a phase throughout another one with that phase in
    place of noise. Raises RunError for a run that is missing, unfinished or of other data, and EvaluationError for a
    run on simulated responses, whose direct sound and levels are part of a bundle."""
    if isinstance(responses, SimulatedResponses):
        raise EvaluationError(f"{run}: was trained on a simulated scene; export it and evaluate the bundle")
    learner = load_learner(responses, run)
    codec: Codec
    predict: Callable[..., tuple[torch.Tensor, ...]]
    if isinstance(learner, FactorisedLearner):
        codec, predict = learner.cells.codec, ExportedField(learner.field, learner.cells).eval().forward_all_frames
    elif isinstance(learner, NafLearner):
        codec, predict = learner.codec, NafGraph(learner.field, learner.codec, tabled=True).eval()
    else:
        raise TypeError(f"{type(learner)} cannot be evaluated")
    configuration = Configuration.read(run)
    noise = FrozenNoise.from_signal(codec, even_noise(codec, np.random.default_rng([configuration.seed, 6])))
    listeners, emitters = held_out.listeners, held_out.emitters

    def respond(index: int, yaw_indices: npt.NDArray[np.integer], *, integrated: bool) -> Responses:
        shape = (len(yaw_indices), 3)
        listener, emitter = np.broadcast_to(listeners[index], shape), np.broadcast_to(emitters[index], shape)
        poses = [listener, emitter, held_out.yaws[yaw_indices]]
        if isinstance(learner, FactorisedLearner):
            poses.append(learner.site.paths(listener, emitter))
        with torch.no_grad():
            outputs = predict(*(torch.from_numpy(np.array(pose, dtype=np.float32)) for pose in poses))
        aligned = decoded(tuple(output.numpy() for output in outputs), codec, noise, integrated=integrated)
        later = float(held_out.delays_s[held_out.held_out[index]]) * held_out.sample_rate - LEAD_SAMPLES
        return undo_alignment(aligned, later)

    parameters = sum(parameter.numel() for parameter in learner.field.parameters())
    column = Column(
        Path(run).resolve().name,
        partial(respond, integrated=False),
        "field",
        parameters * _BYTES_PER_PARAMETER + noise.spectrogram.nbytes,
        method=configuration.name if configuration.kind == "naf" else "",
        training=record_of(run),
    )
    if not isinstance(learner, NafLearner) or learner.field.shape.domain == "time":
        return [column]
    return [column, replace(column, name=f"{column.name}{INTEGRATED}", source=partial(respond, integrated=True))]


def decoded(outputs: Outputs, codec: Codec, noise: FrozenNoise, *, integrated: bool = False) -> npt.NDArray[np.float32]:
    """Decode a field's outputs to aligned responses, with frozen noise where the phase is uncertain or, `integrated`,
    with the phase that is predicted. The outputs are the responses themselves, or log magnitude, instantaneous
    frequency, certainty and, for two ears, interaural coherence (real and imaginary parts)."""
    if len(outputs) == 1:
        return outputs[0]
    log_magnitude, frequency, certainty, *interaural = outputs
    magnitude, phase = codec.magnitude(log_magnitude), codec.integrate(frequency)
    if integrated:
        return codec.synthesise((magnitude * np.exp(1j * phase)).astype(np.complex64)).astype(np.float32)
    if interaural:
        coherence = np.asarray(interaural[0][:, 0] + 1j * interaural[0][:, 1], dtype=np.complex64)
        spectrogram = _with_phase(magnitude, phase, certainty, coherence, noise)
    else:
        # One microphone is treated as the left of two uncorrelated ears.
        magnitude, phase, certainty = (np.repeat(values, 2, axis=1) for values in (magnitude, phase, certainty))
        unlike = np.zeros(magnitude[:, 0].shape, np.complex64)
        spectrogram = _with_phase(magnitude, phase, certainty, unlike, noise)[:, :1]
    return codec.synthesise(spectrogram).astype(np.float32)


def _with_phase(
    magnitude: npt.NDArray[np.float32],
    phase: npt.NDArray[np.float32],
    certainty: npt.NDArray[np.float32],
    coherence: npt.NDArray[np.complex64],
    noise: FrozenNoise,
) -> npt.NDArray[np.complex64]:
    known, rest, coherence = separate(magnitude, phase, certainty, coherence)
    spectrogram = correlated_noise(rest, coherence, noise)
    spectrogram[..., : known.shape[-1]] += known
    return spectrogram


def undo_alignment(aligned: npt.NDArray[np.float32], samples: float) -> npt.NDArray[np.float32]:
    """Undo the alignment: delay (..., sample) by a fractional number of samples, with silence before, and cut at the
    end."""
    count = aligned.shape[-1]
    room = np.pad(aligned, [(0, 0)] * (aligned.ndim - 1) + [(0, max(0, int(np.ceil(samples))))])
    return align(room, -samples)[..., :count].astype(np.float32)
