"""Compares new views by a NeRF alone and with a grid that it shares with a field of sound: `results.json` and
`views.png` in the run folder, beside a folder for each training."""

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import mean, stdev
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image

from training.learning.runs import RunError, write_json
from training.sight.cameras import Views
from training.sight.joint import METHODS, Recipe, Training, open_pair
from training.sight.picture_errors import mean_squared_error, psnr_db, ssim

RESULTS, PICTURES = "results.json", "views.png"
SHOWN = 4
_GAP = 4
_Track = Callable[[Iterable[Any], str], Iterable[Any]]


def compare(
    data: Path,
    images: Path,
    run: Path,
    methods: Sequence[str],
    counts: Sequence[int],
    seeds: Sequence[int],
    recipe: Recipe,
    track: _Track,
) -> dict[str, Any]:
    """Train what is not trained yet, test it and return the results. It goes seed by seed, so that an interrupted
    comparison has whole pairs.

    Raises RunError for an unknown method, for more views than there are, and for DATA of another scene than IMAGES.
    """
    for name in methods:
        if name not in METHODS:
            raise RunError(f"--methods: there is no {name!r}, but {', '.join(METHODS)}")
    chosen = [name for name in METHODS if name in methods]
    if not chosen:
        raise RunError(f"--methods: names none; choose from {', '.join(METHODS)}")
    dataset, views = open_pair(data, images)
    for count in counts:
        if count > len(views.training):
            raise RunError(f"--views: {count}, and {images} has {len(views.training)} views to train on; draw more")
    rows: list[dict[str, Any]] = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1 if not torch.cuda.is_available() else threads)
    try:
        for count in counts:
            for seed in seeds:
                for method in chosen:
                    folder = run / str(count) / f"{method}-{seed}"
                    training = Training(folder, dataset, views, method, count, seed, recipe)
                    rows.append(
                        _tested(folder, training, views, track) | {"method": method, "views": count, "seed": seed}
                    )
                    result = _result(views, recipe, rows)
                    write_json(run / RESULTS, result)
    finally:
        torch.set_num_threads(threads)
    side_by_side(run, views, counts[0], chosen, seeds[0]).save(run / PICTURES)
    return result


def _tested(folder: Path, training: Training, views: Views, track: _Track) -> dict[str, Any]:
    """The errors of a training on the test views, from its folder if they were measured before."""
    path = folder / "tested.json"
    if path.exists():
        return dict(json.loads(path.read_text()))
    training.go_on(track)
    pictures = training.test_pictures()
    for number in range(min(SHOWN, len(pictures))):
        Image.fromarray(pictures[number]).save(folder / f"test-{number:03d}.png")
    pairs = list(zip(pictures, views.test_pictures, strict=True))
    tested = {
        "psnr_db": mean(psnr_db(*pair) for pair in pairs),
        "ssim": mean(ssim(*pair) for pair in pairs),
        "mse": mean(mean_squared_error(*pair) for pair in pairs),
        "psnr_of_views_db": [round(psnr_db(*pair), 3) for pair in pairs],
        "naf_validation_loss": training.validation_loss(),
        "cpu_s": training.cpu_s,
        "device": training.device,
        "device_s": training.device_s,
    }
    write_json(path, tested)
    return tested


def _result(views: Views, recipe: Recipe, rows: list[dict[str, Any]]) -> dict[str, Any]:
    height, width = views.test_pictures.shape[1:3]
    flat = np.median(views.training_pictures.reshape(-1, 3), axis=0).astype(np.uint8)
    return {
        "scene": views.scene,
        "pixels": [width, height],
        "test_views": len(views.test),
        "device": ", ".join(dict.fromkeys(row["device"] for row in rows)),
        "recipe": dict(vars(recipe)),
        "one_colour_psnr_db": mean(psnr_db(np.broadcast_to(flat, true.shape), true) for true in views.test_pictures),
        "rows": rows,
        "means": _means(rows),
    }


def _means(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over seeds by number of views and method, and the gain in PSNR over `nerf` of the same seed."""
    found = []
    alone = {(row["views"], row["seed"]): row["psnr_db"] for row in rows if row["method"] == "nerf"}
    for views, method in dict.fromkeys((row["views"], row["method"]) for row in rows):
        those = [row for row in rows if (row["views"], row["method"]) == (views, method)]
        gains = [row["psnr_db"] - alone[key] for row in those if (key := (views, row["seed"])) in alone]
        found.append(
            {
                "views": views,
                "method": method,
                "seeds": len(those),
                "psnr_db": mean(row["psnr_db"] for row in those),
                "psnr_spread_db": stdev(row["psnr_db"] for row in those) if len(those) > 1 else None,
                "ssim": mean(row["ssim"] for row in those),
                "mse": mean(row["mse"] for row in those),
                "gain_db": mean(gains) if gains and method != "nerf" else None,
                "gain_spread_db": stdev(gains) if len(gains) > 1 and method != "nerf" else None,
            }
        )
    return found


def table(result: dict[str, Any]) -> list[list[str]]:
    """The means as lines of text."""
    lines = [["views", "method", "seeds", "PSNR (dB)", "SSIM", "MSE", "gain (dB)"]]
    for row in result["means"]:
        psnr = f"{row['psnr_db']:.2f}" + ("" if row["psnr_spread_db"] is None else f" ± {row['psnr_spread_db']:.2f}")
        gain = "" if row["gain_db"] is None else f"{row['gain_db']:+.2f}"
        gain += "" if row["gain_spread_db"] is None else f" ± {row['gain_spread_db']:.2f}"
        cells = [str(row["views"]), row["method"], str(row["seeds"]), psnr, f"{row['ssim']:.3f}", f"{row['mse']:.5f}"]
        lines.append([*cells, gain])
    return lines


def side_by_side(run: Path, views: Views, count: int, methods: Sequence[str], seed: int) -> Image.Image:
    """The first test views: the truth on the left, then each method, of one seed."""
    columns = [views.test_pictures[:SHOWN]]
    for method in methods:
        folder = run / str(count) / f"{method}-{seed}"
        shown: list[npt.NDArray[np.uint8]] = []
        for number in range(len(columns[0])):
            with Image.open(folder / f"test-{number:03d}.png") as image:
                shown.append(np.asarray(image))
        columns.append(np.stack(shown))
    rows, height, width = columns[0].shape[:3]
    page = np.full((rows * (height + _GAP) - _GAP, len(columns) * (width + _GAP) - _GAP, 3), 255, np.uint8)
    for across, column in enumerate(columns):
        for down, picture in enumerate(column):
            page[down * (height + _GAP) :, across * (width + _GAP) :][:height, :width] = picture
    return Image.fromarray(page)
