"""Compares ambisonics of each order, decoded to a head, with what the same head hears of the same field:
`python -m training.trials.ambisonic_orders BUNDLE`.

Whole responses, with direct sound and first reflections, at places and orientations drawn at random. Differences are
measured in each octave band: levels at the ears, level differences between the ears, and interaural coherence, the
largest normalised cross-correlation within 1 ms. The sound up to 50 ms after its onset and the rest are compared
apart. The late sound of both ways is noise, so two responses of equal expectation differ too. How much, the first row
says: the same ears with another noise.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import typer
from rich.progress import track
from scipy.signal import butter, sosfiltfilt

from server.acoustics.bands import OCTAVE_BANDS_HZ, bands_within
from server.acoustics.decibels import power_to_db
from server.acoustics.geometry import Quaternion
from server.field.field import AcousticField
from server.rendering.head_decoder import ORDERS, HeadDecoder
from server.rendering.hrtf import kemar
from server.responses.impulse_response import ImpulseResponse, IrQuery
from server.scene.bundle import Bundle
from training.models.frozen_noise import even_noise

_Floats = npt.NDArray[np.float64]

_EARLY_S = 0.050
_LATEST_S = 0.5
_MOST_LAG_S = 0.001
_AUDIBLE_DB = -60.0
"""Under the loudest band of a response; quieter bands are not compared."""
_FILTER_ORDER = 2
_HIGHEST_SHARE = 0.49
MEASURES = ("level dB", "ILD dB", "coherence")


@dataclass(frozen=True)
class Heard:
    """A response in octave bands and two parts, early and late: (part, band, ear) `levels_db` and (part, band)
    `coherence`."""

    levels_db: _Floats
    coherence: _Floats

    @classmethod
    def of(cls, response: npt.NDArray[np.floating], sample_rate: int, onset_s: float) -> "Heard":
        """Measure a response (2, sample)."""
        edges = [round(max(0.0, onset_s + time_s) * sample_rate) for time_s in (-_MOST_LAG_S, _EARLY_S, _LATEST_S)]
        bands = bands_within(sample_rate)
        levels, coherence = np.zeros((2, bands, 2)), np.zeros((2, bands))
        for band, centre_hz in enumerate(OCTAVE_BANDS_HZ[:bands]):
            edges_hz = np.minimum(centre_hz * np.sqrt([0.5, 2.0]), _HIGHEST_SHARE * sample_rate)
            octave = butter(_FILTER_ORDER, edges_hz, "bandpass", fs=sample_rate, output="sos")
            filtered = sosfiltfilt(octave, response.astype(np.float64), axis=-1)
            for part, (start, end) in enumerate(itertools.pairwise(edges)):
                left, right = filtered[:, start:end]
                powers = np.array([left @ left, right @ right])
                levels[part, band] = power_to_db(powers + 1e-20)
                lag = round(_MOST_LAG_S * sample_rate)
                products = [
                    np.dot(left[max(0, -k) : len(left) - max(0, k)], right[max(0, k) :][: len(right) - abs(k)])
                    for k in range(-lag, lag + 1)
                ]
                coherence[part, band] = np.max(products) / np.sqrt(powers.prod() + 1e-40)
        return cls(levels, coherence)

    def differences(self, other: "Heard") -> _Floats:
        """(part, measure, band) absolute differences, NaN in bands that are too quiet to be heard."""
        ild, other_ild = (heard.levels_db[..., 0] - heard.levels_db[..., 1] for heard in (self, other))
        level = np.mean(np.abs(self.levels_db - other.levels_db), axis=-1)
        found = np.stack([level, np.abs(ild - other_ild), np.abs(self.coherence - other.coherence)], axis=1)
        loudest = self.levels_db.max(axis=-1)
        found[np.broadcast_to((loudest < loudest.max() + _AUDIBLE_DB)[:, None], found.shape)] = np.nan
        return found


def compare(bundle: Bundle, *, pairs: int, seed: int, level: str | None = None) -> dict[str, _Floats]:
    """(part, measure, band) mean differences from the ears of the field, by way. Raises BundleError for a level that
    there is not, and RequestError for a field that knows no directions."""
    field = AcousticField.load(bundle, level=level)
    noise = even_noise(bundle.manifest.codec.codec, np.random.default_rng(seed))
    other_noise = AcousticField.load(replace(bundle, frozen_noise=noise), level=level)
    rate, filters = field.sample_rate, kemar(field.sample_rate)

    def ears(of: AcousticField) -> Callable[[IrQuery], npt.NDArray[np.floating]]:
        return lambda query: ImpulseResponse.compute(of, query, filters).samples

    def decoded(order: int) -> Callable[[IrQuery], npt.NDArray[np.floating]]:
        decoder = HeadDecoder.of(filters, order)

        def response(query: IrQuery) -> npt.NDArray[np.floating]:
            asked = replace(query, output="ambisonics", order=order)
            channels = ImpulseResponse.compute(field, asked).samples
            size = channels.shape[-1] + decoder.filters.shape[-1]
            spectra = np.fft.rfft(decoder.filters, size) * np.fft.rfft(channels, size)
            return np.fft.irfft(spectra.sum(axis=1), size)[:, decoder.delay :][:, : channels.shape[-1]]

        return response

    ways = {"another noise": ears(other_noise)} | {f"order {order}": decoded(order) for order in ORDERS}
    found: dict[str, list[_Floats]] = {name: [] for name in ways}
    for query in track(list(_queries(bundle, pairs, seed)), description="Comparing", transient=True):
        onset_s = float(field.onset_s([query.listener], [query.emitter])[0])
        reference = Heard.of(ears(field)(query), rate, onset_s)
        for name, way in ways.items():
            found[name].append(reference.differences(Heard.of(way(query), rate, onset_s)))
    return {name: _mean(differences) for name, differences in found.items()}


def _mean(differences: list[_Floats]) -> _Floats:
    """The mean of those that are numbers; NaN where there are none."""
    masked = np.ma.masked_invalid(np.stack(differences))
    return np.asarray(masked.mean(axis=0).filled(np.nan))


def _queries(bundle: Bundle, pairs: int, seed: int) -> Iterator[IrQuery]:
    """Pairs of places in the scene, a metre apart or more, and heads turned any way."""
    rng = np.random.default_rng(seed)
    bounds = bundle.manifest.bounds
    while pairs:
        listener, emitter = (tuple(rng.uniform(bounds.minimum, bounds.maximum).tolist()) for _ in range(2))
        if (
            not bundle.surroundings.contains(np.array([listener, emitter])).all()
            or np.linalg.norm(np.subtract(listener, emitter)) < 1
        ):
            continue
        turned = Quaternion(*rng.normal(size=4))
        yield IrQuery(listener, emitter, orientation=turned)
        pairs -= 1


def markdown(found: dict[str, _Floats]) -> str:
    """The table: a row per way, means over bands."""
    columns = [f"{part} {measure}" for part in ("early", "late") for measure in MEASURES]
    lines = ["| | " + " | ".join(columns) + " |", "| --- |" + " ---: |" * len(columns)]
    for name, differences in found.items():
        cells = np.ma.masked_invalid(differences).mean(axis=-1).filled(np.nan).ravel()
        lines.append(f"| {name} | " + " | ".join("" if np.isnan(cell) else f"{cell:.3f}" for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def main(
    bundle: Annotated[Path, typer.Argument(metavar="BUNDLE", exists=True, file_okay=False)],
    pairs: Annotated[int, typer.Option(min=1, help="How many pairs of places are compared.")] = 100,
    seed: int = 0,
    level: Annotated[str | None, typer.Option(help="A quality level of the bundle; by default the first.")] = None,
) -> None:
    typer.echo(markdown(compare(Bundle.load(bundle), pairs=pairs, seed=seed, level=level)), nl=False)


if __name__ == "__main__":
    typer.run(main)
