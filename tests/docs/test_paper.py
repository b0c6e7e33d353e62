"""What `make paper` measured becomes a page, row by row; what was not measured is told so."""

import json
from pathlib import Path

import pytest

from benchmarks.paper import gather
from benchmarks.plots import fractions as draw_fractions
from training.evaluation.evaluate import METRICS
from training.trials.fractions import Effort, Fractions, Scored, Trial


def evaluation(**errors: float) -> dict[str, object]:
    metrics = {metric.name: {"mean": errors.get(metric.name)} for metric in METRICS}
    column = {"method": "aac-nearest", "storage_bytes": 2_000_000, "metrics": metrics}
    return {
        "data": "small1 (simulated)",
        "pairs": 20,
        "held_out_pairs": 226,
        "yaws": 1,
        "columns": {"aac-nearest": column},
    }


def probed(**shares: float) -> dict[str, object]:
    return {
        "run": "naf",
        "cells": 100,
        "fitted_places": 10,
        "spacing_m": 0.2,
        "points": 64,
        "explained_variance": {name.replace("_", " "): share for name, share in shares.items()},
    }


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    for scene, share in (("small1", 0.5), ("small2", 0.1)):
        (tmp_path / scene).mkdir()
        text = json.dumps(probed(naf=share, untrained_naf=0.2, MFCC=0.05))
        (tmp_path / scene / "probe.json").write_text(text)
    (tmp_path / "small1" / "paper-table.json").write_text(json.dumps(evaluation(t60=12.34, iacc_lag=56.7)))
    scored = tuple(Scored(Trial("naf", 5, seed), 20, {"spectral_loss": 1.0 + seed, "t60": 3.0}) for seed in range(2))
    (tmp_path / "fractions").mkdir()
    whole = Fractions("small1 (simulated)", Effort(), {"t60": 2.0}, scored)
    (tmp_path / "fractions" / "fractions.json").write_text(json.dumps(whole.to_json()))
    return tmp_path


def test_rows_are_what_was_measured(runs: Path, tmp_path: Path) -> None:
    result = gather(runs, tmp_path)
    (row,) = result.tables["errors"].markdown().splitlines()[2:]
    assert row == "| small1 | aac-nearest | | | 12.3 | 56.7 | | | | 9.35 | 2.00 |"
    probe = result.tables["probe"].markdown().splitlines()[2:]
    assert probe == ["| small1 | **50.0** | 20.0 | 5.0 |", "| small2 | 10.0 | **20.0** | 5.0 |"]
    assert "| naf | 5 | 2 | 1.5 ± 0.71 | 3 ± 0 | |" in result.tables["fractions"].markdown()
    assert "office" not in result.tables


def test_a_claim_that_a_control_beats_is_told(runs: Path, tmp_path: Path) -> None:
    claims = gather(runs, tmp_path).tables["claims"].markdown()
    assert "MFCC on 2 of 2, untrained naf on 1 of 2 scenes" in claims


def test_what_was_not_measured_is_told(tmp_path: Path) -> None:
    result = gather(tmp_path, tmp_path)
    assert list(result.tables) == ["claims"]
    assert all("not measured" in row for row in result.tables["claims"].markdown().splitlines()[2:])
    (tmp_path / "cross-modal.json").write_text("{}")
    assert "[there](cross-modal.md)" in gather(tmp_path, tmp_path).tables["claims"].markdown()


def test_fractions_are_drawn_from_the_record(runs: Path, tmp_path: Path) -> None:
    result = gather(runs, tmp_path)
    read_back = type(result).model_validate_json(result.model_dump_json())
    assert len(draw_fractions(read_back).axes) == 3
