"""The held-out pairs of a dataset, answered by a bundle's field and by the baselines."""

from collections.abc import Callable, Iterable
from pathlib import Path

import h5py
import numpy as np
import numpy.typing as npt

from server.field.field import AcousticField
from server.scene.bundle import Bundle, write_bundle
from server.scene.manifest import Accuracy
from server.whole_field import WholeField
from training.dataset import Dataset, DatasetError
from training.evaluation.baselines import TrainingPairs, linear, linear_aligned, nearest
from training.evaluation.evaluate import FIELD, FLOOR, Evaluation, Responses, evaluate
from training.evaluation.figure import draw_figure
from training.simulation.references import References


class HeldOut:
    """Held-out pairs by index; every method takes one and gives (yaw, ear, sample)."""

    def __init__(self, dataset: Dataset, field: WholeField, file: h5py.File) -> None:
        probes = len(dataset.probes)
        emitter, listener = np.divmod(np.arange(probes**2), probes)
        self.dataset = dataset
        self.flat = np.flatnonzero(dataset.held_out.ravel())
        self._field = field
        self._responses = References(dataset, file)
        self._repeats = References(dataset, file, "repeats")
        self._training = TrainingPairs(
            self._responses,
            listener,
            emitter,
            dataset.probes,
            dataset.probes,
            ~dataset.held_out.ravel() & (emitter != listener),
        )

    @property
    def ends(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """(pair, 3) emitters and listeners."""
        emitter, listener = np.divmod(self.flat, len(self.dataset.probes))
        return self.dataset.probes[emitter], self.dataset.probes[listener]

    @property
    def visible(self) -> npt.NDArray[np.bool_]:
        return self.dataset.plan.is_visible(*self.ends)

    def reference(self, index: int) -> Responses:
        return self._responses[self.flat[index]]

    def repeat(self, index: int) -> Responses:
        return self._repeats[self.flat[index]]

    def predicted(self, index: int) -> Responses:
        emitters, listeners = self.ends
        yaws = self.dataset.yaws
        shape = (len(yaws), 3)
        return self._field.impulse_responses(
            np.broadcast_to(listeners[index], shape), np.broadcast_to(emitters[index], shape), yaws
        )

    def nearest(self, index: int) -> Responses:
        return nearest(self._training, int(self.flat[index]))

    def linear(self, index: int) -> Responses:
        return linear(self._training, int(self.flat[index]))

    def linear_aligned(self, index: int) -> Responses:
        delays = self.dataset.onset_s.ravel()
        return linear_aligned(self._training, int(self.flat[index]), delays, self.dataset.sample_rate)


def require_same_scene(bundle: Bundle, dataset: Dataset) -> None:
    """Raises DatasetError if the dataset is of another scene than the bundle."""
    codec = bundle.manifest.codec.codec
    of_bundle = bundle.manifest.geometry, codec.sample_rate, codec.samples
    if of_bundle != (dataset.scene.geometry, dataset.sample_rate, dataset.samples):
        raise DatasetError(f"{dataset.folder}: is not of the scene of {bundle.folder}")


def evaluate_bundle(
    bundle: Bundle,
    dataset: Dataset,
    *,
    figure: Path | None = None,
    track: Callable[[range], Iterable[int]] = iter,
) -> Evaluation:
    """Every held-out pair at every yaw, in the time domain, as the server would render it; optionally with a figure
    (PNG).

    Raises DatasetError if the dataset is of another scene than the bundle.
    """
    require_same_scene(bundle, dataset)
    codec = bundle.manifest.codec.codec
    field = WholeField.through_kemar(AcousticField.load(bundle))
    with h5py.File(dataset.folder / "pairs.h5", "r") as file:
        held_out = HeldOut(dataset, field, file)
        evaluation = evaluate(
            held_out.reference,
            field=held_out.predicted,
            baselines={"nearest": held_out.nearest, "linear": held_out.linear},
            informational={"linear, aligned": held_out.linear_aligned},
            repeats=held_out.repeat,
            visible=held_out.visible,
            sample_rate=dataset.sample_rate,
            log_magnitude=lambda responses: codec.log_magnitude(codec.transform(responses)),
            track=track,
        )
        if figure is not None:
            draw_figure(
                evaluation,
                figure,
                references=held_out.reference,
                columns={FIELD: held_out.predicted, "nearest": held_out.nearest},
                examples=_examples(held_out),
                sample_rate=dataset.sample_rate,
            )
    return evaluation


def record_accuracy(bundle: Bundle, evaluation: Evaluation) -> Bundle:
    """Writes the measured errors of the bundle's first quality level into its manifest."""
    columns = {
        column: {row.name: mean for row in evaluation.rows if (mean := row.columns[column].mean) is not None}
        for column in (FIELD, FLOOR)
    }
    accuracy = Accuracy(pairs=evaluation.pairs, yaws=evaluation.yaws, errors=columns[FIELD], floor=columns[FLOOR])
    first, *others = bundle.manifest.levels
    levels = (first.model_copy(update={"accuracy": accuracy}), *others)
    files = {name: (bundle.folder / name).read_bytes() for name in bundle.manifest.files}
    return write_bundle(bundle.folder, bundle.manifest.model_copy(update={"levels": levels}), files)


def _examples(held_out: HeldOut) -> list[tuple[int, str]]:
    """Held-out pairs worth looking at: the closest and farthest in sight, and out of sight."""
    emitters, listeners = held_out.ends
    distance = np.linalg.norm(emitters - listeners, axis=-1)
    examples = []
    for visible, label in ((True, "in sight"), (False, "round the corner")):
        chosen = np.flatnonzero(held_out.visible == visible)
        ordered = chosen[np.argsort(distance[chosen])]
        ends = dict.fromkeys([*ordered[:1], *ordered[-1:]])
        examples += [(int(index), f"{label}, {distance[index]:.1f} m") for index in ends]
    return examples
