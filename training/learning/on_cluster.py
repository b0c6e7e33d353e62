"""Training in worker processes on the nodes of a Ray cluster, by Ray Train.

Each worker runs the training loop as each process that torchrun starts does: it computes an equal share of every batch,
on one core, and gradients are averaged. Data and run folder have the same paths on all nodes. If a node is lost, all
workers begin again at the last checkpoint.
"""

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from rich.progress import Progress

from server.core.errors import NafirError
from training.learning.runs import Configuration
from training.learning.train import train
from training.parallel.code_digest import code_digest
from training.parallel.ray_jobs import TRIES, ClusterError, connected
from training.simulation.responses import open_responses

_STATE = "ray"
"""Folder in the run folder for Ray Train's own state, while it trains."""


@dataclass(frozen=True)
class _Training:
    data: Path
    run: Path
    configuration: Configuration
    code: str


def train_on_cluster(address: str, data: Path, run: Path, configuration: Configuration, *, workers: int) -> None:
    """Train to the end, or resume an interrupted run, in so many workers of the cluster.

    Raises ClusterError if no cluster answers, if it has too few cores, or if training has failed too often; and the
    errors of `train`.
    """
    run.mkdir(parents=True, exist_ok=True)
    with connected(address) as jobs:
        if (cores := jobs.cores) < workers:
            raise ClusterError(f"--workers: {workers} workers take a core each, and the cluster has {cores}")
        # The environment says it when Ray Train is imported.
        os.environ.setdefault("RAY_TRAIN_V2_ENABLED", "1")
        try:
            from ray.train import FailureConfig, RunConfig, ScalingConfig
            from ray.train.torch import TorchConfig, TorchTrainer
            from ray.train.v2.api.exceptions import TrainingFailedError
        except ImportError as exc:
            raise ClusterError(f"--cluster: Ray Train is not complete ({exc}): pip install 'nafir[cluster]'") from exc
        trainer = TorchTrainer(
            _train,
            train_loop_config={"training": _Training(data.resolve(), run.resolve(), configuration, code_digest())},
            torch_config=TorchConfig(backend="gloo"),
            scaling_config=ScalingConfig(num_workers=workers, resources_per_worker={"CPU": 1}),
            run_config=RunConfig(
                name=_STATE, storage_path=str(run.resolve()), failure_config=FailureConfig(max_failures=TRIES - 1)
            ),
        )
        shutil.rmtree(run / _STATE, ignore_errors=True)
        try:
            trainer.fit()
        except TrainingFailedError as exc:
            raise _reason(exc, run) from exc
        finally:
            shutil.rmtree(run / _STATE, ignore_errors=True)


def _train(config: dict[str, _Training]) -> None:
    """One worker; Ray Train has joined it with the others."""
    training = config["training"]
    if training.code != code_digest():
        raise ClusterError("a node runs another version of Nafir: install the same on all")
    train(open_responses(training.data), training.run, training.configuration, Progress(disable=True))


def _reason(failure: Exception, run: Path) -> NafirError:
    """The error of Nafir's own that a worker raised, or one that says which run failed."""
    of_workers = list(getattr(failure, "worker_failures", {}).values())
    for cause in of_workers:
        if isinstance(cause, NafirError):
            return cause
    told = "; ".join(f"{type(cause).__name__}: {cause}".splitlines()[0] for cause in of_workers) or str(failure)
    return ClusterError(f"{run}: training failed {TRIES} times, at last with {told}; run the command again to go on")
