"""What a comparison measured becomes the tables of its page, with the paper's figures beside it."""

import io

import numpy as np
from PIL import Image

from benchmarks.cross_modal import result_of
from benchmarks.plots import pictures_side_by_side
from benchmarks.record import Host
from training.sight.comparison import _means
from training.sight.joint import SMALL

ROWS = [
    {
        "views": 75,
        "method": method,
        "seed": seed,
        "psnr_db": psnr,
        "ssim": 0.5,
        "mse": 0.01,
        "naf_validation_loss": 0.1 if method == "nerf-naf" else None,
        "cpu_s": 60.0,
        "device_s": 0.0,
    }
    for method, psnrs in (("nerf", (20.0, 21.0)), ("nerf-naf", (20.5, 21.1)))
    for seed, psnr in enumerate(psnrs)
]
MEASURED = {
    "scene": "large1",
    "pixels": [32, 24],
    "test_views": 50,
    "device": "cpu",
    "recipe": vars(SMALL),
    "one_colour_psnr_db": 12.0,
    "rows": ROWS,
    "means": _means(ROWS),
}


def result(**changes):
    png = io.BytesIO()
    Image.fromarray(np.zeros((20, 30, 3), np.uint8)).save(png, "PNG")
    host = Host(processor="P", instruction_set="AVX2", cores=1)
    return result_of(MEASURED | changes, png.getvalue(), host=host, command="c", commit="0123abc")


def test_gains_are_paired_by_seed_and_stand_beside_the_papers() -> None:
    _, _, *lines = result().tables["means"].markdown().splitlines()
    assert lines[0] == "| 75 | NeRF | 2 | 20.50 (± 0.71) | 0.500 | 0.01000 | | 25.41 | |"
    assert lines[1] == "| 75 | NeRF + NAF | 2 | 20.80 (± 0.42) | 0.500 | 0.01000 | +0.30 (± 0.28) | 26.19 | +0.78 |"
    assert len(lines) == 2  # what the paper has with 150 images stands beside nothing


def test_each_training_has_its_time_by_the_clock_of_what_computed_it() -> None:
    head, _, first, *_ = result().tables["seeds"].markdown().splitlines()
    assert head.endswith("| held-back NAF loss | CPU, s |")
    assert first.endswith("| 60 |")
    rows = [row | {"device_s": 70.0} for row in ROWS]
    head, _, first, *_ = result(device="NVIDIA H100", rows=rows).tables["seeds"].markdown().splitlines()
    assert head.endswith("| held-back NAF loss | host's CPU, s | GPU, s |")
    assert first.endswith("| 60 | 70 |")


def test_the_picture_has_a_title_for_each_column() -> None:
    (axes,) = pictures_side_by_side(result()).axes
    assert [text.get_text() for text in axes.get_xticklabels()] == ["truth", "NeRF", "NeRF + NAF"]
