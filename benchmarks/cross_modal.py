"""Records what `nafir-train cross-modal` wrote to a run folder as a result, beside the paper's figures:
`python -m benchmarks.cross_modal RUN COMMAND [COMMIT [HOST]]`.

HOST is a JSON file with the fields of `benchmarks.record.Host`, if another machine than this one measured."""

import base64
import json
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Any, Final

from benchmarks.record import FOLDER, Cell, Column, Host, Result, Table, Value
from server.bench.history import current_commit

PAPER_PSNR_DB: Final = {(75, "nerf"): "25.41", (75, "nerf-naf"): "26.19"}
PAPER_GAIN_DB: Final = {(75, "nerf-naf"): "+0.78", (150, "nerf-naf"): "+0.05"}
"""Of Luo et al., Learning Neural Acoustic Fields, NeurIPS 2022, by the number of images and method. They stand beside
what was measured with as many."""
_TITLES: Final = {
    "nerf": "NeRF",
    "nerf-naf": "NeRF + NAF",
    "nerf-grid": "NeRF + grid",
    "nerf-grid-l2": "NeRF + grid, L2 1e-5",
}


def result_of(measured: Mapping[str, Any], png: bytes, *, host: Host, command: str, commit: str) -> Result:
    """The result of a comparison. `png` shows the truth and the methods of `measured` side by side."""
    recipe, pixels = measured["recipe"], measured["pixels"]
    found = {(row["views"], row["method"]): row for row in measured["means"]}
    methods = [method for method in _TITLES if any(key[1] == method for key in found)]
    columns = (
        "images",
        "method",
        "seeds",
        "PSNR, dB",
        "SSIM",
        "MSE",
        "gain, dB",
        "the paper's PSNR",
        "the paper's gain",
    )
    keys = sorted(found, key=lambda key: (key[0], list(_TITLES).index(key[1])))
    means = Table(
        columns=tuple(Column(title=title, is_number=title != "method") for title in columns),
        rows=tuple(
            (views, _TITLES[method], *_cells(found[views, method]), *_paper(views, method)) for views, method in keys
        ),
    )
    # A training on a GPU keeps a core of its host busy, which is not what it takes.
    times = ("host's CPU, s", "GPU, s") if measured["device"] != "cpu" else ("CPU, s",)
    seeds = Table(
        columns=tuple(
            Column(title=title, is_number=title != "method")
            for title in ("images", "method", "seed", "PSNR, dB", "SSIM", "MSE", "held-back NAF loss", *times)
        ),
        rows=tuple(
            (
                row["views"],
                _TITLES[row["method"]],
                row["seed"],
                _rounded(row["psnr_db"], 2),
                _rounded(row["ssim"], 3),
                _rounded(row["mse"], 5),
                None if row["naf_validation_loss"] is None else _rounded(row["naf_validation_loss"], 4),
                *(_rounded(row[kind], 0) for _, kind in zip(times, ("cpu_s", "device_s"), strict=False)),
            )
            for row in measured["rows"]
        ),
    )
    facts = {
        "Scene": measured["scene"],
        "Pictures": f"{pixels[0]} x {pixels[1]} pixels, {measured['test_views']} views to test on",
        "One colour": f"{measured['one_colour_psnr_db']:.2f} dB: PSNR of the median colour of the training pictures",
        "NeRF": f"{recipe['layers']} layers of {recipe['width']}, {recipe['coarse']} coarse and {recipe['fine']} fine "
        f"samples a ray, {recipe['rays']} rays a step (the paper: 8 of 256, 64 and 128, 1,024)",
        "Grid": f"{recipe['grid_features']} features every {recipe['grid_spacing_m']} m (the paper: 64 every 0.25 m)",
        "NAF": f"width {recipe['naf_width']}, {recipe['responses']} responses a step with {recipe['points']} points "
        f"each, {100 * recipe['share']:g} % of the pairs (the paper: 512, 20 with 2,000, all)",
        "Length": f"{recipe['steps']:,} steps (the usual NeRF: 200,000), learning rate {recipe['learning_rate']:g} "
        f"falling to a tenth, on {measured['device']}",
    }
    return Result(
        host=host,
        date=datetime.now(UTC).date().isoformat(),
        commit=commit,
        command=command,
        facts=facts,
        tables={"means": means, "seeds": seeds},
        plots={"cross-modal.png": "pictures_side_by_side"},
        values={"columns": ["truth", *(_TITLES[name] for name in methods)], "png": base64.b64encode(png).decode()},
    )


def _cells(row: Mapping[str, Any]) -> tuple[Cell, ...]:
    psnr, gain = _rounded(row["psnr_db"], 2), row["gain_db"]
    if row["psnr_spread_db"] is not None:
        psnr = psnr.model_copy(update={"note": f"± {row['psnr_spread_db']:.2f}"})
    spread = "" if row["gain_spread_db"] is None else f" (± {row['gain_spread_db']:.2f})"
    difference = None if gain is None else f"{gain:+.2f}{spread}"
    return row["seeds"], psnr, _rounded(row["ssim"], 3), _rounded(row["mse"], 5), difference


def _paper(views: int, method: str) -> tuple[Cell, Cell]:
    return PAPER_PSNR_DB.get((views, method)), PAPER_GAIN_DB.get((views, method))


def _rounded(value: float, digits: int) -> Value:
    return Value(value=Decimal(f"{value:.{digits}f}"))


def main() -> None:
    run, command, *others = sys.argv[1:]
    commit = others[:1]
    measured = json.loads((Path(run) / "results.json").read_text(encoding="utf-8"))
    host = Host.model_validate_json(Path(others[1]).read_text(encoding="utf-8")) if len(others) > 1 else Host.this()
    png = (Path(run) / "views.png").read_bytes()
    result = result_of(measured, png, host=host, command=command, commit=commit[0] if commit else current_commit())
    (FOLDER / "cross-modal.json").write_text(result.model_dump_json(indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
