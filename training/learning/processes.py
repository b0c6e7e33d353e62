"""Data-parallel training in as many processes as `torchrun` or Ray Train started, or in one.

Each process computes an equal share of every batch, and gradients are averaged. Only the first process reads and writes
the run folder (all read the targets), and it makes the decisions that depend on time.
"""

import os
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch
import torch.distributed as dist
from torch import Tensor, nn

from training.learning.precision import compiled


@dataclass(frozen=True)
class Processes:
    """The `rank` of this process among `count`, and the device that it computes on."""

    rank: int
    count: int
    device: torch.device

    @classmethod
    @contextmanager
    def joined(cls) -> Iterator["Processes"]:
        """This process, as one of those that torchrun or Ray Train started, until the end of the block. Ray Train has
        joined them already."""
        rank, count = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
        gpu = torch.cuda.is_available()
        device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0"))) if gpu else torch.device("cpu")
        if count == 1:
            yield cls(rank, count, device)
            return
        if dist.is_initialized():
            yield cls(rank, count, device)
            return
        dist.init_process_group("nccl" if gpu else "gloo")
        try:
            yield cls(rank, count, device)
        finally:
            dist.destroy_process_group()

    def clock_s(self) -> float:
        """Seconds for budgets: of this process on all its cores, or of the clock where a GPU computes. CPU time is the
        same whatever else a machine does, so trainings with equal budgets may run at the same time."""
        return time.perf_counter() if self.device.type == "cuda" else time.process_time()

    @property
    def machine(self) -> str:
        """The device on which steps are computed, by name; bfloat16 may be quicker on one and slower on another."""
        if self.device.type == "cuda":
            return torch.cuda.get_device_name(self.device)
        return f"{platform.node()} ({platform.machine()})"

    @property
    def first(self) -> bool:
        return self.rank == 0

    def parallel(self, field: nn.Module) -> nn.Module:
        """The field, with gradients averaged over all processes, and compiled for a GPU."""
        field = compiled(field, self.device)
        if self.count == 1:
            return field
        ids = [self.device.index] if self.device.type == "cuda" else None
        return nn.parallel.DistributedDataParallel(field, device_ids=ids)

    def broadcast(self, *values: float) -> list[float]:
        """The values of the first process, in every process."""
        if self.count == 1:
            return list(values)
        tensor = torch.tensor(values, dtype=torch.float64, device=self.device)
        dist.broadcast(tensor, 0)
        return [float(value) for value in tensor]

    def total(self, value: float) -> float:
        """The sum of the values of all processes, the same in every process."""
        if self.count == 1:
            return value
        tensor = torch.tensor(value, dtype=torch.float64, device=self.device)
        dist.all_reduce(tensor)
        return float(tensor)

    def mean(self, value: Tensor) -> Tensor:
        if self.count == 1:
            return value
        total = value.clone()
        dist.all_reduce(total)
        return total / self.count

    def wait(self) -> None:
        """Wait until all processes have come here."""
        if self.count > 1:
            dist.barrier()
