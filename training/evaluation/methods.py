"""The methods with which a field is compared, by name."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from training.baselines.baselines import linear, linear_aligned, nearest
from training.baselines.coded import AAC, AudioCodec, CodedResponses, Track, opus
from training.baselines.held_out import EvaluationError, HeldOut, Responses
from training.baselines.helmholtz import HelmholtzInterpolation
from training.baselines.image_sources import ImageSources
from training.baselines.mean_spectrogram import MeanSpectrogram
from training.baselines.shaped import ShapedNearest
from training.evaluation.evaluate import FLOOR, ONE_SIMULATION, Column, Source

MEAN_SPECTROGRAM = "mean-spectrogram"
DEFAULT_METHODS = ("nearest", "linear", "linear-aligned", MEAN_SPECTROGRAM)
Answer = Callable[[int, npt.NDArray[np.integer]], Responses | None]

# Listeners are about a metre from each other in most of our data, so interpolation fails at higher frequencies.
_HELMHOLTZ_CUTOFF_HZ = 500.0
_BYTES_PER_SAMPLE = 2  # float16, as in simulated datasets


def method_columns(names: Sequence[str], held_out: HeldOut, track: Track = lambda steps, _: steps) -> list[Column]:
    """Make a column for each name. `track` may show the progress of preparations that take long.

    Raises EvaluationError for an unknown name, or for a method that does not work with these data.
    """
    for name in names:
        if name not in METHODS:
            raise EvaluationError(f"--methods: there is no {name!r}, but {', '.join(METHODS)}")
    prepared = _Prepared(held_out, track)
    return [METHODS[name](name, prepared) for name in names]


def floor_columns(held_out: HeldOut) -> list[Column]:
    """Make a column for the second take of the held-out pairs; none if there is no second take."""
    repeats = held_out.repeats
    if repeats is None:
        return []
    return [Column(FLOOR, lambda index, yaw_indices: repeats[int(held_out.held_out[index])][yaw_indices], "floor")]


def simulation_column(held_out: HeldOut) -> Column:
    """Make a column for the errors of one simulation, when the reference is a median over several."""
    return Column(
        ONE_SIMULATION,
        at_pairs(held_out, lambda pair, yaw_indices: held_out.pairs.response(pair)[yaw_indices]),
        "simulation",
    )


class _Prepared:
    """Data that several methods use, computed on first use."""

    def __init__(self, held_out: HeldOut, track: Track) -> None:
        self.held_out = held_out
        self.track = track
        self._coded: dict[str, CodedResponses] = {}

    def coded(self, codec: AudioCodec) -> CodedResponses:
        if codec.name not in self._coded:
            self._coded[codec.name] = CodedResponses(codec, self.held_out, track=self.track)
        return self._coded[codec.name]


def _plain(name: str, prepared: _Prepared) -> Column:
    interpolate = {"nearest": nearest, "linear": linear}[name]
    pairs = prepared.held_out.pairs
    return _of_stored(name, prepared.held_out, lambda pair, yaw_indices: interpolate(pairs, pair, yaw_indices))


def _aligned(name: str, prepared: _Prepared) -> Column:
    held_out = prepared.held_out
    pairs, delays_s, rate = held_out.pairs, held_out.delays_s, held_out.sample_rate
    return _of_stored(
        name, held_out, lambda pair, yaw_indices: linear_aligned(pairs, pair, delays_s, rate, yaw_indices)
    )


def _of_stored(name: str, held_out: HeldOut, answer: Answer) -> Column:
    """Make the column of a method that stores the training responses as they are."""
    stored = int(held_out.pairs.training.sum()) * len(held_out.yaws) * held_out.channels * held_out.samples
    return Column(name, at_pairs(held_out, answer), "baseline", stored * _BYTES_PER_SAMPLE, name)


def codec_named(name: str) -> AudioCodec:
    """Raises EvaluationError for another name than aac or opus."""
    if name not in {"aac", "opus"}:
        raise EvaluationError(f"--coded: there is no {name!r}, but aac, opus")
    return AAC if name == "aac" else opus()


def _coded(name: str, prepared: _Prepared) -> Column:
    codec_name, way = name.split("-")
    coded = prepared.coded(codec_named(codec_name))
    interpolate = {"nearest": nearest, "linear": linear}[way]
    held_out = prepared.held_out
    pairs = replace(held_out.pairs, responses=coded)
    return Column(
        name,
        at_pairs(held_out, lambda pair, yaw_indices: interpolate(pairs, pair, yaw_indices)),
        "baseline",
        coded.storage_bytes,
        name,
        # Inside a triangle of listeners, three responses must be decoded for one.
        extra_ms=coded.decoding_ms() * {"nearest": 1, "linear": 3}[way],
    )


def _helmholtz(name: str, prepared: _Prepared) -> Column:
    held_out = prepared.held_out
    cutoff_hz = _HELMHOLTZ_CUTOFF_HZ if name.endswith("lowpass") else None
    interpolation = HelmholtzInterpolation(held_out.pairs, held_out.sample_rate, cutoff_hz)
    return _of_stored(name, held_out, interpolation.response)


def _shaped(name: str, prepared: _Prepared) -> Column:
    held_out = prepared.held_out
    shaped = ShapedNearest(held_out.pairs, held_out.delays_s, held_out.sample_rate)
    return _of_stored(name, held_out, shaped.response)


def _mean_spectrogram(name: str, prepared: _Prepared) -> Column:
    held_out = prepared.held_out
    mean = MeanSpectrogram(held_out, whole=name.endswith("whole"), track=prepared.track)
    return Column(name, at_pairs(held_out, mean.response), "baseline", mean.storage_bytes, name)


def _image_sources(name: str, prepared: _Prepared) -> Column:
    held_out = prepared.held_out
    dataset = held_out.simulated
    if dataset is None:
        raise EvaluationError(f"--methods: {name} needs a simulated scene, whose walls are known; leave it out")
    images = ImageSources(dataset)
    emitters, listeners = held_out.emitters, held_out.listeners
    return Column(
        name,
        lambda index, yaw_indices: images.response(
            emitters[index], listeners[index], yaw_indices, number=int(held_out.held_out[index])
        ),
        "baseline",
        (dataset.folder / "scene.toml").stat().st_size,
        name,
    )


def at_pairs(held_out: HeldOut, answer: Answer) -> Source:
    """The source of a method, for an `answer` that takes the number of a pair in the dataset."""
    return lambda index, yaw_indices: answer(int(held_out.held_out[index]), yaw_indices)


METHODS: dict[str, Callable[[str, _Prepared], Column]] = {
    "nearest": _plain,
    "linear": _plain,
    "linear-aligned": _aligned,
    "shaped-nearest": _shaped,
    MEAN_SPECTROGRAM: _mean_spectrogram,
    f"{MEAN_SPECTROGRAM}-whole": _mean_spectrogram,
    "aac-nearest": _coded,
    "aac-linear": _coded,
    "opus-nearest": _coded,
    "opus-linear": _coded,
    "image-sources": _image_sources,
    "helmholtz": _helmholtz,
    "helmholtz-lowpass": _helmholtz,
}
