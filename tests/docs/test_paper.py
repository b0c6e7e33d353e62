"""What `make paper` measured becomes a page, row by row; what was not measured is told so."""

import json
from pathlib import Path

import pytest

from benchmarks.paper import gather, main, with_claims
from benchmarks.plots import fractions as draw_fractions
from benchmarks.plots import held_back_losses
from benchmarks.record import Host, Result
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


def record(loss: float) -> dict[str, object]:
    """Of a network whose loss rose a little at the end."""
    return {
        "steps": 400,
        "epochs": 4.25,
        "recipe_share": 0.02,
        "held_back_loss": loss,
        "mean_loss": 0.2,
        "slope_per_doubling": 0.001,
        "curve": [[100, 0.3], [200, loss - 0.01], [400, loss]],
    }


@pytest.fixture
def networks(tmp_path: Path) -> Path:
    (tmp_path / "gpu").mkdir()
    of_scene = {"naf": record(0.125), "naf-no-grid": record(0.15)}
    (tmp_path / "gpu" / "networks.json").write_text(json.dumps({"small1": of_scene}))
    return tmp_path / "gpu"


def test_rows_are_what_was_measured(runs: Path) -> None:
    result = gather(runs)
    (row,) = result.tables["errors"].markdown().splitlines()[2:]
    assert row == "| small1 | aac-nearest | | | 12.3 | 56.7 | | | | 9.35 | 2.00 |"
    probe = result.tables["probe"].markdown().splitlines()[2:]
    assert probe == ["| small1 | **50.0** | 20.0 | 5.0 |", "| small2 | 10.0 | **20.0** | 5.0 |"]
    assert "| naf | 5 | 2 | 1.5 ± 0.71 | 3 ± 0 | |" in result.tables["fractions"].markdown()
    assert "office" not in result.tables


def test_a_claim_that_a_control_beats_is_told(runs: Path, tmp_path: Path) -> None:
    claims = with_claims(gather(runs), [], tmp_path).tables["claims"].markdown()
    assert "MFCC on 2 of 2, untrained naf on 1 of 2 scenes" in claims


def test_what_was_not_measured_is_told(tmp_path: Path) -> None:
    result = with_claims(gather(tmp_path), [], tmp_path)
    assert list(result.tables) == ["claims"]
    assert all("not measured" in row for row in result.tables["claims"].markdown().splitlines()[2:])


def test_what_pictures_gained_is_told_beside_the_papers(tmp_path: Path) -> None:
    columns = [{"title": title} for title in ("images", "method", "seeds", "PSNR, dB")]
    rows = [[75, "NeRF", 3, {"value": "27.50"}], [75, "NeRF + NAF", 3, {"value": "28.25"}], [150, "NeRF", None, None]]
    found = {"host": {"processor": "P", "instruction_set": "AVX2", "cores": 1}, "date": "2026-01-02", "command": "c"}
    found |= {"commit": "0123abc", "facts": {}, "tables": {"means": {"columns": columns, "rows": rows}}}
    (tmp_path / "cross-modal.json").write_text(json.dumps(found))
    claims = with_claims(gather(tmp_path), [], tmp_path).tables["claims"].markdown()
    assert "| 25.41 dB and 26.19 dB | 27.50 dB and 28.25 dB, [there](cross-modal.md) |" in claims


def test_networks_are_told_with_the_least_loss_on_the_way(networks: Path) -> None:
    (row, _) = gather(networks).tables["networks"].markdown().splitlines()[2:]
    assert row == "| small1 | naf | 400 | 4.25 | 2 | 0.1250 | 0.1150 | 0.2000 | +0.0010 |"
    (axes,) = held_back_losses(gather(networks)).axes
    assert [line.get_label() for line in axes.lines] == ["naf", "naf-no-grid", "the training set's mean"]
    assert axes.lines[0].get_ydata().tolist() == [0.3, 0.115, 0.125]


def test_claims_are_of_what_all_machines_measured(runs: Path, networks: Path, tmp_path: Path) -> None:
    main([str(runs), "c"], tmp_path)
    host = Host(processor="G", instruction_set="AVX-512", cores=16, note="a GPU")
    (tmp_path / "host.json").write_text(host.model_dump_json())
    main([str(networks), "on a GPU", "paper-networks", "0123abc", str(tmp_path / "host.json")], tmp_path)
    paper, other = (
        Result.model_validate_json((tmp_path / f"{name}.json").read_text()) for name in ("paper", "paper-networks")
    )
    assert (other.host, other.commit, other.command) == (host, "0123abc", "on a GPU")
    claims = paper.tables["claims"].markdown()
    assert "held-back loss on all pairs of small1: 0.1250 with and 0.1500 without grid" in claims
    assert "MFCC on 2 of 2" in claims
    assert "errors" in paper.tables


def test_fractions_are_drawn_from_the_record(runs: Path) -> None:
    result = gather(runs)
    read_back = type(result).model_validate_json(result.model_dump_json())
    assert len(draw_fractions(read_back).axes) == 3
