"""The training loop for every kind of field, in one process or several, on a GPU if there is one.

A run can be interrupted at any time and continues when it is started again, also on another machine, with a GPU or
without one. If its length is given in epochs, then with the same seed and number of threads on the same kind of machine
the result is the same as without interruption. If it is given in minutes, it counts the time spent on steps and
validation, over all parts of the run; the last validation may end later. These are minutes of the processor, of all
cores and processes together, or of the clock where a GPU computes. So other work on the machine takes nothing from a
training's budget."""

import dataclasses
import math
import os
import time
from collections import deque
from collections.abc import Generator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.progress import Progress
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from server.core.errors import NafirError
from training.data.responses import ResponseSet
from training.learning.kinds import learner_of
from training.learning.learner import Learner, Rows
from training.learning.pairs import split
from training.learning.precision import autocast, bfloat16_gains
from training.learning.processes import Processes
from training.learning.record import MeasuredLoss
from training.learning.runs import (
    CHECKPOINT,
    Configuration,
    append_log,
    claim,
    keep_log,
    load_checkpoint,
    require_same_data,
    restore,
    save_checkpoint,
)

_CHECKPOINT_S = 60.0
_ROUNDS = 20
_BATCHES_AHEAD = 2
_THREADS_OF_A_GPU = 16
"""Most threads that make batches for a GPU, whose step takes less time than making its batch. Where the processor
computes the steps, more than one thread would take its cores away."""
_PROBE_ROWS = 2
_LARGEST_GRADIENT = 1.0
_EXPLODED = 1000.0
"""A loss is implausible above this many times the first loss, or above this number if the first loss is below one.
Normalised targets have errors of about one at first."""


class DivergedError(NafirError):
    """The error for a loss or gradient that is not finite, or far above its first value."""


def train(
    responses: ResponseSet,
    run: Path,
    configuration: Configuration,
    progress: Progress,
    *,
    pause_after_s: float | None = None,
) -> bool:
    """Train to the end, or resume an interrupted run; returns whether the end is reached. Under `torchrun`, all
    processes train together. With `pause_after_s` the run is stored after a step and so many seconds of the clock and
    can be resumed.

    Raises RunError if the folder holds a run of another configuration or on other data, RecipeError if the
    configuration does not fit the data, and DivergedError if the loss becomes implausible; the last checkpoint stays.
    """
    with Processes.joined() as processes:
        if processes.first:
            claim(run, responses, configuration)
        processes.wait()
        torch.manual_seed(configuration.seed)
        learner = learner_of(responses, configuration)
        # The first process computes missing targets, which the others then load.
        if processes.first:
            learner.prepare(progress)
        processes.wait()
        if not processes.first:
            learner.prepare(progress)
        learner.to(processes.device)
        loop = _Loop(
            learner, run, configuration, processes, split(responses, share=configuration.share, seed=configuration.seed)
        )
        return loop.run_to_the_end(progress, pause_after_s)


def load_learner(responses: ResponseSet, run: Path) -> Learner:
    """The learner of a finished run, with its trained field on the CPU. Raises RunError if the run is missing,
    unfinished or of other data."""
    configuration = Configuration.read(run)
    require_same_data(responses, run)
    learner = learner_of(responses, configuration)
    restore(learner.field, run, configuration)
    return learner


@dataclass
class _State:
    """The state of a run: steps and epochs done, responses that the steps have seen, seconds that steps and validation
    took, seconds of preparation (at the end), sum of the current round's losses, least validation error, rounds since
    it (`stale`), and the parameters to keep. `curve` has the step and the validation error at the end of each round,
    and `mean_loss` is the validation error of the training set's mean. `machine` is the one that `bfloat16` was chosen
    on."""

    step: int = 0
    epochs: float = 0.0
    seconds: float = 0.0
    prepared_s: float = 0.0
    rounds: int = 0
    round_loss: float = 0.0
    round_steps: int = 0
    best_loss: float = float("inf")
    kept: dict[str, Tensor] = dataclasses.field(default_factory=dict)
    stale: int = 0
    bfloat16: bool = False
    finished: bool = False
    first_loss: float | None = None
    responses: int = 0
    curve: list[MeasuredLoss] = dataclasses.field(default_factory=list)
    mean_loss: float | None = None
    machine: str = ""


class _Loop:
    def __init__(
        self,
        learner: Learner,
        run: Path,
        configuration: Configuration,
        processes: Processes,
        rows: tuple[Rows, Rows],
    ) -> None:
        self._learner, self._run, self._configuration, self._processes = learner, run, configuration, processes
        self._rows, validation_rows = rows
        self._validation_rows = learner.validation(validation_rows)
        self._optimiser = torch.optim.AdamW(learner.parameter_groups(), configuration.learning_rate, fused=True)
        visited = len(self._order(0))
        # A small scene has fewer rows than a batch; processes have equal shares of a batch.
        size = min(configuration.examples_of_a_step(visited), visited)
        self._batch = max(size - size % processes.count, processes.count)
        self._steps_per_epoch = max(1, visited // self._batch)
        # guard: a run goes on from its checkpoint and not from its beginning
        if (run / CHECKPOINT).exists():
            state = load_checkpoint(run, processes.device)
            learner.field.load_state_dict(state.pop("field"))
            # guard: an optimiser goes on as it was
            self._optimiser.load_state_dict(state.pop("optimiser"))
            self._state = _State(**state)
            if self._state.machine != processes.machine and not self._state.finished:
                self._choose_precision()
            if processes.first and not self._state.finished:
                # guard: the log goes no further than the checkpoint
                keep_log(run, self._state.rounds)
        else:
            if processes.first:
                # guard: a log begins anew with its run
                keep_log(run, 0)
            learner.initialise(self._rows, configuration.seed)
            self._state = _State()
            self._choose_precision()

    def run_to_the_end(self, progress: Progress, pause_after_s: float | None = None) -> bool:
        state, began_s = self._state, time.monotonic()
        if state.finished:
            return True
        parallel = self._processes.parallel(self._learner.field)
        task = progress.add_task("training", total=self._total(), completed=math.floor(self._measure()))
        writer = SummaryWriter(self._run / "tensorboard", purge_step=state.step) if self._processes.first else None
        saved_s = state.seconds
        round_ends = self._next_round()
        batches = self._batches(state.step)
        try:
            while self._fraction() < 1 and not self._stopped():
                start = self._processes.clock_s()
                due = state.seconds - saved_s > _CHECKPOINT_S
                self._step(parallel, *next(batches), save=due)
                saved_s = state.seconds if due else saved_s
                state.seconds += self._processes.total(self._processes.clock_s() - start)
                if self._measure() >= round_ends:
                    summary = self._end_round(writer)
                    state.rounds += 1
                    self._save()
                    saved_s = state.seconds
                    round_ends = self._next_round()
                    done = math.floor(self._measure())
                    progress.update(task, completed=done, description=f"training  validation: {summary}")
                if pause_after_s is not None and self._fraction() < 1 and not self._stopped():
                    (taken_s,) = self._processes.broadcast(time.monotonic() - began_s)
                    if taken_s >= pause_after_s:
                        self._save()
                        return False
        finally:
            batches.close()
            if writer is not None:
                writer.close()
        self._finish()
        return True

    def _fraction(self) -> float:
        """The share of training that is done."""
        configuration, state = self._configuration, self._state
        if configuration.minutes is not None:
            return state.seconds / (60 * configuration.minutes)
        return state.step / (configuration.epochs * self._steps_per_epoch)

    def _stopped(self) -> bool:
        patience = self._configuration.patience
        return patience is not None and self._state.stale >= patience

    def _measure(self) -> float:
        """The number of rounds done, with fractions."""
        if self._configuration.minutes is None:
            return self._state.step / self._steps_per_epoch
        return self._fraction() * _ROUNDS

    def _next_round(self) -> int:
        """The number of rounds at which the current round ends. It is later than now, however long the last validation
        took, so that every round trains."""
        return min(math.floor(self._measure()) + 1, self._total())

    def _total(self) -> int:
        """The greatest number of rounds."""
        return self._configuration.epochs if self._configuration.minutes is None else _ROUNDS

    def _step(
        self, parallel: torch.nn.Module, inputs: tuple[Tensor, ...], targets: tuple[Tensor, ...], *, save: bool
    ) -> None:
        """Make one training step. With `save`, the parameters before the step are saved, after their loss has shown
        that they are good."""
        state, configuration = self._state, self._configuration
        beta, share = self._learner.momentum_and_rate(self._fraction())
        for group in self._optimiser.param_groups:
            group["lr"], group["betas"] = configuration.learning_rate * share, (beta, 0.999)
        # What a step leaves out depends on its number alone, so that a resumed run goes on as it would have.
        torch.manual_seed(self._seed_of(state.step))
        loss = self._loss(parallel, inputs, targets, bfloat16=state.bfloat16)
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        norm = torch.nn.utils.clip_grad_norm_(self._learner.field.parameters(), _LARGEST_GRADIENT)
        mean_loss, mean_norm = (float(value) for value in self._processes.mean(torch.stack([loss.detach(), norm])))
        state.first_loss = mean_loss if state.first_loss is None else state.first_loss
        # guard: a loss out of proportion stops training
        # guard: a loss that is no number stops training
        if not np.isfinite(mean_norm) or not self._is_plausible(mean_loss):
            raise self._diverged(f"the loss is {mean_loss:g} and its gradient {mean_norm:g} in step {state.step + 1}")
        if save:
            self._save()
        self._optimiser.step()
        state.step += 1
        state.responses += self._batch
        state.epochs = state.step / self._steps_per_epoch
        state.round_loss += mean_loss
        state.round_steps += 1

    def _seed_of(self, step: int) -> int:
        return int(np.random.default_rng([self._configuration.seed, 10, step, self._processes.rank]).integers(2**63))

    def _is_plausible(self, loss: float) -> bool:
        """Whether the loss is finite and not far above the first one."""
        first = self._state.first_loss
        return bool(np.isfinite(loss)) and (first is None or loss <= _EXPLODED * max(first, 1.0))

    def _diverged(self, problem: str) -> DivergedError:
        rate = self._configuration.learning_rate
        kept = "the last checkpoint is kept" if (self._run / CHECKPOINT).exists() else "there is no checkpoint yet"
        return DivergedError(f"{self._run}: {problem}; {kept}. Train with a lower learning rate than {rate:g}")

    def _loss(
        self, model: torch.nn.Module, inputs: tuple[Tensor, ...], targets: tuple[Tensor, ...], *, bfloat16: bool
    ) -> Tensor:
        model.train()
        with autocast(self._processes.device, bfloat16=bfloat16):
            prediction = model(*inputs)
        return torch.stack(list(self._learner.losses(prediction.float(), targets).values())).sum()

    def _end_round(self, writer: SummaryWriter | None) -> str:
        """Validates, remembers the parameters to keep, and writes the logs. Returns a line that describes the
        errors."""
        state = self._state
        start = self._processes.clock_s()
        if state.mean_loss is None:
            parts = self._validate(of_mean=True) if self._processes.first else {}
            (state.mean_loss,) = self._processes.broadcast(sum(parts.values()))
        parts = self._validate() if self._processes.first else {}
        (validation_error,) = self._processes.broadcast(sum(parts.values()))
        state.seconds += self._processes.total(self._processes.clock_s() - start)
        # guard: an error out of proportion is not kept
        if not self._is_plausible(validation_error):  # before parameters are kept and saved
            raise self._diverged(f"the validation error is {validation_error:g} after step {state.step}")
        state.curve.append((state.step, validation_error))
        if validation_error < state.best_loss:
            state.best_loss, state.stale = validation_error, 0
        else:
            state.stale += 1
        if self._configuration.patience is None or not state.stale:
            state.kept = {name: value.detach().clone() for name, value in self._learner.field.state_dict().items()}
        training = state.round_loss / max(1, state.round_steps)
        state.round_loss, state.round_steps = 0.0, 0
        if writer is not None:
            append_log(self._run, {"epoch": state.epochs, "seconds": state.seconds, "training": training, **parts})
            rate = self._optimiser.param_groups[0]["lr"]
            writer.add_scalar("training/loss", training, state.step)
            writer.add_scalar("training/learning_rate", rate, state.step)
            for name, value in {**parts, "sum": validation_error}.items():
                writer.add_scalar(f"held_back/{name}", value, state.step)
        return " ".join(f"{name} {value:.4f}" for name, value in parts.items())

    @torch.no_grad()
    def _validate(self, *, of_mean: bool = False) -> dict[str, float]:
        """The losses of what is held back; with `of_mean`, those of a field that predicts the mean of its targets
        everywhere, which is zero when it is normalised."""
        field = self._learner.field.eval()
        totals: dict[str, float] = {}
        for start in range(0, len(self._validation_rows), self._configuration.batch):
            rows = self._validation_rows[start : start + self._configuration.batch]
            inputs, targets = self._on_device(*self._learner.batch(rows, None))
            prediction = field(*inputs)
            prediction = torch.zeros_like(prediction) if of_mean else prediction
            for name, value in self._learner.losses(prediction, targets).items():
                totals[name] = totals.get(name, 0.0) + float(value) * len(rows) / len(self._validation_rows)
        return totals

    def _finish(self) -> None:
        state = self._state
        self._learner.field.load_state_dict(state.kept)
        self._learner.field.eval()
        self._learner.finish(self._rows)
        state.finished, state.kept, state.prepared_s = True, {}, self._learner.prepared_s
        self._save()
        self._processes.wait()

    def _save(self) -> None:
        if self._processes.first:
            state: dict[str, Any] = vars(self._state) | {
                "field": self._learner.field.state_dict(),
                "optimiser": self._optimiser.state_dict(),
            }
            save_checkpoint(self._run, state)

    def _choose_precision(self) -> None:
        processes = self._processes
        inputs, targets = self._on_device(*self._learner.batch(self._order(0)[:_PROBE_ROWS], None))
        gains = processes.first and bfloat16_gains(
            lambda bfloat16: self._loss(self._learner.field, inputs, targets, bfloat16=bfloat16).backward(),
            processes.device,
        )
        self._optimiser.zero_grad(set_to_none=True)
        self._state.bfloat16 = bool(processes.broadcast(float(gains))[0])
        self._state.machine = processes.machine

    def _order(self, epoch: int) -> Rows:
        return self._learner.epoch(self._rows, np.random.default_rng([self._configuration.seed, 5, epoch]))

    def _on_device(
        self, inputs: tuple[Tensor, ...], targets: tuple[Tensor, ...]
    ) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
        device = self._processes.device
        return tuple(part.to(device) for part in inputs), tuple(part.to(device) for part in targets)

    def _batches(self, first_step: int) -> Generator[tuple[tuple[Tensor, ...], tuple[Tensor, ...]]]:
        """This process's share of every batch, from a step on, without end; computed a little ahead."""
        processes, seed = self._processes, self._configuration.seed
        orders: dict[int, Rows] = {}
        on_gpu = processes.device.type == "cuda"
        threads = max(1, min(_THREADS_OF_A_GPU, (os.cpu_count() or 1) // processes.count)) if on_gpu else 1

        def rows_of(step: int) -> Rows:
            epoch, number = divmod(step, self._steps_per_epoch)
            if epoch not in orders:
                orders.clear()
                orders[epoch] = self._order(epoch)
            start = number * self._batch
            return orders[epoch][start + processes.rank : start + self._batch : processes.count]

        def make(step: int, rows: Rows) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]]:
            return self._learner.batch(rows, np.random.default_rng([seed, 8, step, processes.rank]))

        with ThreadPoolExecutor(threads) as pool:
            step = first_step
            ahead: deque[Future[tuple[tuple[Tensor, ...], tuple[Tensor, ...]]]] = deque()
            while True:
                while len(ahead) < _BATCHES_AHEAD * threads:
                    ahead.append(pool.submit(make, step, rows_of(step)))
                    step += 1
                yield self._on_device(*ahead.popleft().result())
