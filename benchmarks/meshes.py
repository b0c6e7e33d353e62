"""Measures how right the simulation in triangle meshes is: `python -m benchmarks.meshes [--note TEXT]`, or
`make meshes`. It writes `benchmarks/results/meshes.json`, from which `make results` fills `docs/results/meshes.md`.

It takes five minutes of two idle cores, says what is done, and may be interrupted; nothing is written before the end.
"""

import argparse
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from decimal import Decimal
from functools import partial
from itertools import product
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
from rich.console import Console

from benchmarks.record import FOLDER, Cell, Column, Host, Result, Table, Value
from server.acoustics.metrics import PARAMETER_METRICS
from server.bench.history import current_commit
from server.scene.geometry import Geometry
from server.scene.mesh_geometry import MeshGeometry
from training.trials import mesh_laws, plans_as_meshes
from training.trials.mesh_and_others import BesideOthers, beside_others
from training.trials.mesh_laws import (
    LAWS,
    RECIPROCITIES,
    Decay,
    Deviation,
    Reciprocity,
    Screened,
    ScreenedPlaces,
    Slit,
    decay,
    screened,
    screened_places,
    slit,
)
from training.trials.mesh_rooms import house, l_plan, pyramid, shoebox_plan
from training.trials.plans_as_meshes import METRICS, Compared, compare

PATH: Final = FOLDER / "meshes.json"
PLOTS: Final = {"meshes.png": "errors_of_meshes", "screen.png": "losses_at_a_screen"}
_RANGE: Final = 0.05, 0.95
"""Quantiles of what chance gives."""
_SLITS_M: Final = 0.05, 0.2, 0.8
_ABSORPTIONS: Final = 0.1, 0.2, 0.3
_OTHERS_ABSORPTION: Final = 0.15

_T = TypeVar("_T")
_Generators = Sequence[np.random.Generator]


@dataclass(frozen=True)
class Sizes:
    """How much is simulated and traced. `scenes` are the floor plans that are compared."""

    plans: plans_as_meshes.Sizes = field(default_factory=plans_as_meshes.Sizes)
    laws: mesh_laws.Sizes = field(default_factory=mesh_laws.Sizes)
    scenes: tuple[Path, ...] = plans_as_meshes.SCENES


@dataclass(frozen=True)
class Measured:
    """Everything that is measured, in the order of the tables."""

    plans: list[tuple[Compared, Compared]]
    others: list[BesideOthers]
    decays: list[Decay]
    deviations: list[Deviation]
    reciprocities: list[Reciprocity]
    slits: list[Slit]
    screened: list[Screened]
    screened_places: list[ScreenedPlaces]


def measure(sizes: Sizes, say: Callable[[str], None], *, seed: int = 0, threads: int = 2) -> Measured:
    """Measure everything, in threads; `say` is told what is done. All but times depends on sizes and seed only."""
    laws = sizes.laws

    def numbers(part: int, count: int) -> _Generators:
        return np.random.default_rng([seed, part]).spawn(count)

    def each(name: str, steps: Sequence[Callable[[], _T]]) -> list[_T]:
        return _each(name, steps, say, threads)

    plans = [partial(compare, path, sizes.plans, seed=seed) for path in sizes.scenes]
    walls: dict[str, Callable[[float, float], Geometry | MeshGeometry]] = {
        "shoebox": shoebox_plan,
        "L": l_plan,
        "gabled house": house,
    }
    fewer = replace(laws, rays=laws.rays // 3)  # pyroomacoustics takes long where walls are triangles
    others = [
        partial(beside_others, name, walls[name](_OTHERS_ABSORPTION, scattering), scattering, fewer, rng)
        for (name, scattering), rng in zip(product(walls, (0.0, 1.0)), numbers(1, 6), strict=True)
    ]
    closed: dict[str, Callable[[float, float], MeshGeometry]] = {"gabled house": house, "L": _l, "pyramid": pyramid}
    decays = [
        partial(decay, name, closed[name], absorption, laws, rng)
        for (name, absorption), rng in zip(product(closed, _ABSORPTIONS), numbers(2, 9), strict=True)
    ]
    by_law = [partial(law, laws, rng) for law, rng in zip(LAWS, numbers(3, len(LAWS)), strict=True)]
    reciprocities = [
        partial(law, laws, rng) for law, rng in zip(RECIPROCITIES, numbers(4, len(RECIPROCITIES)), strict=True)
    ]
    slits = [partial(slit, laws, rng, width_m) for width_m, rng in zip(_SLITS_M, numbers(5, 3), strict=True)]
    return Measured(
        each("plans as meshes", plans),
        each("beside pyroomacoustics", others),
        each("beside Eyring's formula", decays),
        each("laws", by_law),
        each("reciprocity", reciprocities),
        each("slits", slits),
        screened(),
        screened_places(laws, *numbers(6, 1)),
    )


def _l(absorption: float, scattering: float) -> MeshGeometry:
    return MeshGeometry.of_plan(l_plan(absorption, scattering))


def _each(name: str, steps: Sequence[Callable[[], _T]], say: Callable[[str], None], threads: int) -> list[_T]:
    """The results of steps, in their order. Compiled code releases the interpreter's lock."""
    began_s, found = time.monotonic(), []
    pool = ThreadPoolExecutor(threads)
    try:
        for result in pool.map(lambda step: step(), steps):
            found.append(result)
            say(f"{name}: {len(found)} of {len(steps)}, {time.monotonic() - began_s:.0f} s")
    finally:
        pool.shutdown(cancel_futures=True)
    return found


def result_of(measured: Measured, sizes: Sizes, *, host: Host, commit: str, command: str) -> Result:
    plans, laws = sizes.plans, sizes.laws
    alike, with_images = ([each[at] for each in measured.plans] for at in (0, 1))
    return Result(
        host=host,
        date=datetime.now(UTC).date().isoformat(),
        commit=commit,
        command=command,
        facts={
            "Plans": f"{plans.pairs} pairs a scene ({plans.emitters} emitters, {plans.listeners} listeners of each), "
            f"{plans.takes} takes of each as a plan and as a mesh, {plans.rays:,} rays",
            "Laws": f"{laws.rays:,} rays, {laws.receivers} receivers and {laws.runs} runs, where a table has no others",
        },
        tables={
            "plans": _plans(alike),
            "ratios": _ratios(alike),
            "shifts": _shifts(alike),
            "images": _ratios(with_images),
            "pyroomacoustics": _others(measured.others),
            "eyring": _decays(measured.decays),
            "laws": _laws(measured.deviations),
            "reciprocity": _reciprocities(measured.reciprocities),
            "slits": _slits(measured.slits),
            "screen": _screen(measured.screened),
            "hidden": _hidden(measured.screened_places),
        },
        plots=PLOTS,
        values={"ratios": _plotted(alike)},
    )


def _plotted(compared: Sequence[Compared]) -> dict[str, dict[str, list[float]]]:
    """Errors divided by the floor, and the ends of the range that chance gives, by scene and metric."""
    return {
        each.scene: {
            name: [round(value, 4) for value in (of.ratio, *np.quantile(of.ratios, _RANGE))]
            for name, of in each.metrics.items()
        }
        for each in compared
    }


def _plans(compared: Sequence[Compared]) -> Table:
    """Two rows for each scene: the error as a mesh, and the floor."""
    digits = {"t60": 2, "edt": 1, "c50": 2, "drr": 2, "iacc": 4, "level": 3}
    rows: list[tuple[Cell, ...]] = []
    for each in compared:
        for is_mesh in (True, False):
            values = [of.error if is_mesh else of.floor for of in each.metrics.values()]
            rows.append(
                (
                    f"{each.scene} ({each.in_sight} in sight)" if is_mesh else None,
                    "mesh" if is_mesh else "floor",
                    *(_number(value, digits[name]) for name, value in zip(METRICS, values, strict=True)),
                    _number(each.times_as_long, 2) if is_mesh else None,
                )
            )
    return _table(["scene", "", *_metric_titles(), "time, mesh / plan"], rows, numbers_from=2)


def _ratios(compared: Sequence[Compared]) -> Table:
    """Errors divided by the floor, and in brackets what they exceed by chance in one case of twenty."""

    def cells(of_scenes: Sequence[Compared]) -> list[Cell]:
        means = [np.mean([each.metrics[name].ratio for each in of_scenes]) for name in METRICS]
        drawn = [np.mean([each.metrics[name].ratios for each in of_scenes], axis=0) for name in METRICS]
        limits = [np.quantile(ratios, _RANGE[1]) for ratios in drawn]
        return [
            Value(value=Decimal(f"{mean:.2f}"), note=f"{limit:.2f}") for mean, limit in zip(means, limits, strict=True)
        ]

    rows: list[tuple[Cell, ...]] = [(each.scene, *cells([each])) for each in compared]
    return _table(["error / floor", *_names()], [*rows, ("mean", *cells(compared))], numbers_from=1)


def _shifts(compared: Sequence[Compared]) -> Table:
    """What a mesh has more than its plan, and in brackets the standard deviation of chance."""
    digits = {"t60": 2, "edt": 1, "c50": 3, "drr": 3, "iacc": 4, "level": 3}

    def cells(of_scenes: Sequence[Compared]) -> list[Cell]:
        means = [float(np.mean([each.metrics[name].shift for each in of_scenes])) for name in METRICS]
        drawn = [np.mean([each.metrics[name].shifts for each in of_scenes], axis=0) for name in METRICS]
        return [
            _with_error(mean, float(shifts.std()), digits[name], signed=True)
            for name, mean, shifts in zip(METRICS, means, drawn, strict=True)
        ]

    rows: list[tuple[Cell, ...]] = [(each.scene, *cells([each])) for each in compared]
    return _table(["mesh - plan", *_metric_titles()], [*rows, ("mean", *cells(compared))], numbers_from=1)


def _others(compared: Sequence[BesideOthers]) -> Table:
    rows = [
        (
            each.room,
            "all scattered" if each.scattering else "mirrors",
            f"{each.rays:,}",
            _number(float(np.mean(each.ours_s)), 3),
            _number(float(np.mean(each.others_s)), 3),
            _with_error(100 * each.difference, 100 * each.error, 1, signed=True),
            *(None if value is None else _number(value, 2) for value in (each.c50_db, each.level_db, each.decay_db)),
        )
        for each in compared
    ]
    titles = ["rays", "T60, s", "pyroomacoustics, s", "difference, %", "C50, dB", "level, dB", "decay, dB"]
    return _table(["room", "walls", *titles], rows, numbers_from=2)


def _decays(decays: Sequence[Decay]) -> Table:
    rows = [
        (
            each.place,
            _number(each.volume_m3, 1),
            _number(each.surface_m2, 1),
            _number(each.absorption, 1),
            _with_error(each.found_s, each.error_s, 3),
            _number(each.eyring_s, 3),
            _number(100 * (each.found_s / each.eyring_s - 1), 1, signed=True),
            _number(each.eyring_of_paths_s, 3),
            _number(100 * (each.found_s / each.eyring_of_paths_s - 1), 1, signed=True),
        )
        for each in decays
    ]
    titles = ["volume, m³", "surface, m²", "absorption", "T60, s", "Eyring, s", "off, %", "of its paths, s", "off, %"]
    return _table(["room", *titles], rows, numbers_from=1)


def _laws(deviations: Sequence[Deviation]) -> Table:
    rows = [
        (each.law, each.place, each.size, _with_error(each.off_db, each.error_db, 3, signed=True))
        for each in deviations
    ]
    return _table(["law", "place", "of", "measured - law, dB"], rows, numbers_from=3)


def _reciprocities(found: Sequence[Reciprocity]) -> Table:
    rows = [
        (each.place, each.pairs, f"{each.rays:,}", _number(each.there_and_back_db, 2), _number(each.twice_db, 2))
        for each in found
    ]
    return _table(["place", "pairs", "rays", "there and back, dB", "twice one way, dB"], rows, numbers_from=1)


def _slits(slits: Sequence[Slit]) -> Table:
    rows = [
        (
            _number(each.area_m2, 3),
            _number(each.expected_db, 2),
            _with_error(each.found_db, each.error_db, 2),
            _number(each.found_db - each.expected_db, 2, signed=True),
        )
        for each in slits
    ]
    return _table(["area, m²", "balance, dB", "measured, dB", "off, dB"], rows, numbers_from=0)


def _screen(found: Sequence[Screened]) -> Table:
    rows = [
        (
            _number(each.fresnel_number, 1),
            *(
                None if value is None else _number(value, 1)
                for value in (each.found_db, each.chart_db, each.rigid_db, each.absorbing_db)
            ),
        )
        for each in found
    ]
    titles = ["Fresnel number", "mesh, dB", "Maekawa, dB", "rigid half-plane, dB", "absorbing half-plane, dB"]
    return _table(titles, rows, numbers_from=0)


def _hidden(found: Sequence[ScreenedPlaces]) -> Table:
    rows = [
        (
            "reflects everything" if each.reflecting else "reflects nothing",
            each.pairs,
            *(_number(value, 1, signed=True) for value in (each.mean_db, each.low_db, each.high_db)),
        )
        for each in found
    ]
    return _table(["half-plane", "pairs", "mesh - theory, dB", "5 %, dB", "95 %, dB"], rows, numbers_from=1)


def _names() -> list[str]:
    return [each.label for name in METRICS for each in PARAMETER_METRICS if each.name == name]


def _metric_titles() -> list[str]:
    of_name = {each.name: each for each in PARAMETER_METRICS}
    return [f"{of_name[name].label}, {of_name[name].unit}".rstrip(", ") for name in METRICS]


def _table(titles: Sequence[str], rows: Sequence[tuple[Cell, ...]], *, numbers_from: int) -> Table:
    columns = tuple(Column(title=title, is_number=at >= numbers_from) for at, title in enumerate(titles))
    return Table(columns=columns, rows=tuple(rows))


def _number(value: float, digits: int, *, signed: bool = False) -> Cell:
    """None for what could not be measured. A sign is text, since JSON has none for positive numbers."""
    if not math.isfinite(value):
        return None
    if signed:
        return f"{value:+.{digits}f}"
    return Value(value=Decimal(f"{value:.{digits}f}"))


def _with_error(value: float, error: float, digits: int, *, signed: bool = False) -> Cell:
    if not math.isfinite(value):
        return None
    note = f"± {error:.{digits}f}" if math.isfinite(error) else ""
    if signed:
        return f"{value:+.{digits}f}" + (f" ({note})" if note else "")
    return Value(value=Decimal(f"{value:.{digits}f}"), note=note)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--note", default="", help="what else is to be known of the machine")
    given = parser.parse_args(arguments)
    began_s = time.monotonic()
    sizes = Sizes()
    console = Console(stderr=True)
    measured = measure(sizes, console.print)
    host = Host.this(given.note)
    minutes = (time.monotonic() - began_s) / 60
    command = f"`make meshes` (`python -m benchmarks.meshes`): {minutes:.1f} minutes"
    result = result_of(measured, sizes, host=host, commit=current_commit(), command=command)
    PATH.write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
