"""Trains a NeRF alone or together with a field of sound, on one grid of features in plan (Luo et al., NeurIPS 2022,
"cross-modal learning"): in each step the loss of colours and the loss of the paper's acoustic network add up.

A training can be interrupted at any time. When it is started again it goes on, and gives the same numbers.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, cast, get_args

import numpy as np
import numpy.typing as npt
import torch
from rich.progress import Progress
from torch import Tensor, nn

from server.core.errors import NafirError
from training.data.dataset import Dataset
from training.learning.learner import Rows
from training.learning.naf import NafLearner
from training.learning.pairs import split
from training.learning.precision import autocast, compiled
from training.learning.runs import (
    CHECKPOINT,
    Configuration,
    NafRecipe,
    RunError,
    append_log,
    keep_log,
    load_checkpoint,
    read_json,
    save_checkpoint,
    write_json,
)
from training.learning.schedule import decay_to_a_tenth
from training.models.local_geometry import GaussianGrid
from training.models.naf import NafShape
from training.models.site import Site
from training.sight.cameras import FILE, Views
from training.sight.nerf import Nerf, Rays
from training.simulation.responses import SimulatedResponses

Method = Literal["nerf", "nerf-naf", "nerf-grid", "nerf-grid-l2"]
METHODS: tuple[Method, ...] = get_args(Method)
_CHECKPOINT_S = 20.0
_LOG_STEPS = 50
_RAYS_AT_A_TIME = 1024

_Pixels = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Recipe:
    """Sizes and lengths, those of the papers if nothing is said. `responses`, `points` and `share` are those of the
    field of sound: responses of a step, points of each, and the share of the pairs; less than all are drawn as they are
    needed. `l2` is the weight of the sum of squares of the grid's features, for `nerf-grid-l2` only. The learning rate
    falls to a tenth."""

    steps: int = 200_000
    rays: int = 1024
    coarse: int = 64
    fine: int = 128
    width: int = 256
    layers: int = 8
    learning_rate: float = 5e-4
    grid_spacing_m: float = 0.25
    grid_features: int = 64
    naf_width: int = 512
    responses: int = 20
    points: int = 2000
    share: float = 1.0
    naf_weight: float = 1.0
    l2: float = 1e-5

    @property
    def naf(self) -> Configuration:
        shape = NafShape(width=self.naf_width, grid_spacing_m=self.grid_spacing_m, grid_features=self.grid_features)
        return Configuration.naf(shape, NafRecipe(points=self.points), batch=self.responses, share=self.share)


SMALL = Recipe(
    steps=1500,
    rays=256,
    coarse=16,
    fine=24,
    width=64,
    layers=4,
    learning_rate=2e-3,
    grid_spacing_m=0.5,
    grid_features=16,
    naf_width=64,
    responses=4,
    points=64,
    share=0.02,
)
"""For two cores and pictures of some thousand pixels."""


class _Kept(SimulatedResponses):
    """Simulated responses of which those that were read once stay in memory."""

    def __init__(self, dataset: Dataset) -> None:
        super().__init__(dataset)
        self._read: dict[int, npt.NDArray[np.float32]] = {}

    def read(self, rows: npt.ArrayLike) -> npt.NDArray[np.float32]:
        wanted = np.asarray(rows, dtype=np.int64)
        missing = [int(row) for row in wanted if int(row) not in self._read]
        if missing:
            self._read.update(zip(missing, super().read(missing), strict=True))
        return np.stack([self._read[int(row)] for row in wanted])


def open_pair(data: Path, images: Path) -> tuple[Dataset, Views]:
    """A dataset and pictures of the same scene. Raises DatasetError or ViewsError for a folder that holds none, and
    RunError if they are of two scenes."""
    views, dataset = Views.read(images), Dataset.open(data)
    scene = dataset.scene
    for field, drawn, simulated in (
        ("scene", views.scene, scene.id),
        ("corners", views.corners, tuple(map(tuple, scene.geometry.corners))),
        ("height_m", float(views.high[2]), scene.geometry.height_m),
    ):
        if drawn != simulated:
            told = (
                f"is {drawn!r}, and {data} has {simulated!r}" if field != "corners" else f"differ from those of {data}"
            )
            raise RunError(f"{images / FILE}: {field}: {told}; draw views of the same scene file, or simulate it")
    return dataset, views


class Training:
    """One training: a method on the first `views` pictures, with a seed, in a folder of its own."""

    def __init__(
        self, run: Path, dataset: Dataset, pictures: Views, method: Method, views: int, seed: int, recipe: Recipe
    ) -> None:
        if views > len(pictures.training):
            raise RunError(f"{pictures.folder / FILE}: views: {len(pictures.training)} to train on, {views} wanted")
        self._run, self._method, self._seed, self._recipe = run, method, seed, recipe
        self._pictures = pictures
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        self._claim({"method": method, "views": views, "seed": seed, "scene": pictures.scene, "recipe": asdict(recipe)})
        responses = _Kept(dataset)
        torch.manual_seed(seed)
        self.learner: NafLearner | None = None
        self.grid: GaussianGrid | None = None
        if method == "nerf-naf":
            self.learner = NafLearner(responses, recipe.naf)
            self.grid = cast(GaussianGrid, self.learner.field.grids[0])
            self._rows, validation = split(responses, share=recipe.share, seed=seed)
            self._validation = self.learner.validation(validation)
        elif method != "nerf":
            site = Site.of(responses)
            self.grid = GaussianGrid(site.low, site.high, recipe.grid_spacing_m, recipe.grid_features)
        torch.manual_seed(seed)
        self.nerf = Nerf(
            pictures.low,
            pictures.high,
            width=recipe.width,
            layers=recipe.layers,
            coarse=recipe.coarse,
            fine=recipe.fine,
            features=0 if self.grid is None else recipe.grid_features,
        )
        self._parts = nn.ModuleDict({"nerf": self.nerf})
        if self.learner is not None:
            self._parts["naf"] = self.learner.field
        elif self.grid is not None:
            self._parts["grid"] = self.grid
        self._parts.to(self._device)
        self.nerf.quicken(self._device, self.grid)
        self._quick_field = None if self.learner is None else compiled(self.learner.field, self._device)
        shots = zip(pictures.training[:views], pictures.training_pictures[:views], strict=True)
        rays, colours = [], []
        for camera, picture in shots:
            rays.append(Rays.within(*camera.rays(), pictures.low, pictures.high))
            colours.append(torch.tensor(picture.reshape(-1, 3), dtype=torch.float32) / 255)
        joined = Rays(*(torch.cat(part) for part in zip(*(vars(each).values() for each in rays), strict=True)))
        self._rays, self._colours = joined.to(self._device), torch.cat(colours).to(self._device)
        groups = [{"params": list(self.nerf.parameters()), "weight_decay": 0.0}]
        if self.learner is not None:
            groups += self.learner.parameter_groups()
        elif self.grid is not None:
            groups.append({"params": list(self.grid.parameters()), "weight_decay": 0.0})
        self._optimiser = torch.optim.AdamW(groups, recipe.learning_rate, fused=self._device.type == "cuda")
        self._epoch, self._order = -1, np.empty(0, np.int64)
        self.step, self.cpu_s, self.device_s = 0, 0.0, 0.0

    def _claim(self, configuration: dict[str, Any]) -> None:
        """Make the folder a run of this configuration. Raises RunError if it holds another."""
        self._run.mkdir(parents=True, exist_ok=True)
        if (self._run / "run.json").exists() and read_json(self._run, "run.json") != configuration:
            raise RunError(f"{self._run / 'run.json'}: is of another configuration; choose an empty folder")
        write_json(self._run / "run.json", configuration)

    def go_on(self, track: Callable[[Iterable[int], str], Iterable[int]]) -> None:
        """Train to the end, from the last checkpoint if there is one. Raises NafirError if the loss is no number."""
        if (self._run / CHECKPOINT).exists():
            state = load_checkpoint(self._run, self._device)
            self._parts.load_state_dict(state["parts"])
            self._optimiser.load_state_dict(state["optimiser"])
            self.step, self.cpu_s = int(state["step"]), float(state["cpu_s"])
            self.device_s = float(state["device_s"])
        steps = self._recipe.steps
        if self.step == steps:
            return
        keep_log(self._run, self.step // _LOG_STEPS)
        if self.learner is not None:
            if self._recipe.share == 1.0:
                self.learner.prepare(Progress(disable=True))
                self.learner.to(self._device)
            if not self.step:
                self.learner.initialise(self._rows, self._seed)
        sums: dict[str, Tensor] = {}
        saved_s, began_s, clock_s = time.monotonic(), time.process_time(), time.monotonic()
        before_s, before_clock_s = self.cpu_s, self.device_s
        for number in track(
            range(self.step, steps), f"{self._run.parent.name} views, {self._method}, seed {self._seed}"
        ):
            losses = self.losses(number)
            self._descend(number, losses)
            self.step = number + 1
            for name, loss in losses.items():
                sums[name] = sums.get(name, 0) + loss.detach().double() / _LOG_STEPS
            self.cpu_s = before_s + time.process_time() - began_s
            if self._device.type == "cuda":
                self.device_s = before_clock_s + time.monotonic() - clock_s
            if self.step % _LOG_STEPS == 0:
                means = {name: float(total) for name, total in sums.items()}
                append_log(self._run, {"step": self.step, "cpu_s": self.cpu_s, **means})
                sums = {}
                # A checkpoint between two lines of the log would forget a part of the second one.
                if time.monotonic() - saved_s > _CHECKPOINT_S:
                    self._save()
                    saved_s = time.monotonic()
        self._save()

    def losses(self, step: int) -> dict[str, Tensor]:
        """The terms of the loss in a step; they depend on the step's number, the seed and the parameters alone."""
        recipe, device = self._recipe, self._device
        rng = np.random.default_rng([self._seed, 21, step])
        some = torch.from_numpy(rng.integers(0, len(self._colours), recipe.rays)).to(device)
        generator = torch.Generator(device).manual_seed(int(rng.integers(1 << 62)))
        true = self._colours[some]
        with autocast(device, bfloat16=device.type == "cuda"):
            coarse, fine = self.nerf(self._rays[some], self.grid, generator)
        losses = {"colour": (fine - true).square().mean(), "coarse": (coarse - true).square().mean()}
        if self.learner is not None and self._quick_field is not None:
            inputs, targets = self.learner.batch(self._rows_of(step), np.random.default_rng([self._seed, 22, step]))
            losses["naf"] = recipe.naf_weight * self._naf_loss(self._quick_field, inputs, targets)
        if self._method == "nerf-grid-l2" and self.grid is not None:
            losses["l2"] = recipe.l2 * self.grid.features.square().sum()
        return losses

    def _naf_loss(self, field: nn.Module, inputs: tuple[Tensor, ...], targets: tuple[Tensor, ...]) -> Tensor:
        assert self.learner is not None
        on_device = [tuple(part.to(self._device) for part in parts) for parts in (inputs, targets)]
        with autocast(self._device, bfloat16=self._device.type == "cuda"):
            prediction = field(*on_device[0])
        return torch.stack(list(self.learner.losses(prediction.float(), on_device[1]).values())).sum()

    def _rows_of(self, step: int) -> Rows:
        """The rows of a step: each pair once an epoch, as the field of sound is trained alone."""
        assert self.learner is not None
        visited = len(self._order) or len(self._order_of(0))
        size = min(self._recipe.responses, visited)
        epoch, number = divmod(step, max(1, visited // size))
        if epoch != self._epoch:
            self._epoch, self._order = epoch, self._order_of(epoch)
        return self._order[number * size : (number + 1) * size]

    def _order_of(self, epoch: int) -> Rows:
        assert self.learner is not None
        return self.learner.epoch(self._rows, np.random.default_rng([self._seed, 5, epoch]))

    def _descend(self, step: int, losses: dict[str, Tensor]) -> None:
        total = torch.stack(list(losses.values())).sum()
        # A GPU is asked for the loss when it has all of the step to do.
        self._optimiser.zero_grad(set_to_none=True)
        total.backward()
        if not torch.isfinite(total):
            value = float(total.detach())
            raise NafirError(f"{self._run}: the loss is {value:g} in step {step + 1}; lower --learning-rate")
        beta, share = decay_to_a_tenth(step / self._recipe.steps)
        for group in self._optimiser.param_groups:
            group["lr"], group["betas"] = self._recipe.learning_rate * share, (beta, 0.999)
        self._optimiser.step()

    def _save(self) -> None:
        state = {"parts": self._parts.state_dict(), "optimiser": self._optimiser.state_dict()}
        save_checkpoint(self._run, state | {"step": self.step, "cpu_s": self.cpu_s, "device_s": self.device_s})

    @property
    def device(self) -> str:
        """What the steps are computed on: the GPU's name, or the kind of the processor."""
        return torch.cuda.get_device_name(self._device) if self._device.type == "cuda" else self._device.type

    @torch.no_grad()
    def test_pictures(self) -> _Pixels:
        """(view, height, width, 3) as the fine network sees the test views."""
        drawn = np.empty_like(self._pictures.test_pictures)
        for number, camera in enumerate(self._pictures.test):
            rays = Rays.within(*camera.rays(), self._pictures.low, self._pictures.high)
            parts = [
                self.nerf(rays[slice(begin, begin + _RAYS_AT_A_TIME)].to(self._device), self.grid, None)[1].cpu()
                for begin in range(0, len(rays.origins), _RAYS_AT_A_TIME)
            ]
            drawn[number] = np.round(255 * torch.cat(parts).numpy()).astype(np.uint8).reshape(drawn[number].shape)
        return drawn

    @torch.no_grad()
    def validation_loss(self) -> float | None:
        """The loss of the field of sound at pairs that it was not trained on; None without one."""
        if self.learner is None:
            return None
        return float(self._naf_loss(self.learner.field, *self.learner.batch(self._validation, None)))
