"""Training loop of both small models; interrupted trainings resume, and finished ones can be extended."""

import json
import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from hilsplat.base.artifacts import atomic_path
from hilsplat.base.errors import ArtifactError
from models.training.steps import Budget, Curve, learning_rate, prefetched

logger = logging.getLogger(__name__)

Batch = TypeVar("Batch")


@dataclass(frozen=True)
class Tuning:
    """Settings of the optimiser and the training loop.

    Attributes:
        peak: learning rate of the constant phase.
        warmup: number of warm-up steps.
        weight_decay: weight decay of AdamW.
        average: memory per step of the running average that gives the final weights.
        measure_every: steps between rows of the learning curve.
        save_every: steps between saved states.
    """

    peak: float
    warmup: int = 100
    weight_decay: float = 0.02
    average: float = 0.998
    measure_every: int = 500
    save_every: int = 200


@dataclass
class Progress:
    """Progress of a training.

    Attributes:
        step: number of finished steps.
        minutes: their duration over all runs.
        decay_from: first step of the learning rate decay, -1 before it.
        decay_steps: number of decay steps.
        budget: budget that the decay was planned for.
        rows: rows of the learning curve.
    """

    step: int = 0
    minutes: float = 0.0
    decay_from: int = -1
    decay_steps: int = 0
    budget: dict[str, float] = field(default_factory=dict)
    rows: list[dict[str, float]] = field(default_factory=list)

    @property
    def is_finished(self) -> bool:
        """Whether the learning rate decay is complete."""
        return self.decay_from >= 0 and self.step >= self.decay_from + self.decay_steps


class Training:
    """Modules, optimiser and averaged weights of one model, with a state on disk.

    `<name>.safetensors` holds the current state, `<name>-constant.safetensors` the state at the start of the
    learning rate decay. A run with another budget resumes from the second, as if the decay had not happened:
    the constant phase does not depend on its planned length. All randomness is derived from the step number,
    so a resumed run repeats an uninterrupted one.

    Args:
        modules: modules by name, trained together.
        tuning: settings of the optimiser and the loop.
        folder: folder of the state.
        name: base name of the state's files; it should identify everything that the weights depend on.
        device: device of the modules.
    """

    def __init__(
        self, modules: Mapping[str, nn.Module], tuning: Tuning, folder: Path, name: str, device: torch.device
    ) -> None:
        self.modules = nn.ModuleDict({key: module.to(device) for key, module in modules.items()})
        self.tuning, self.device = tuning, device
        matrices = [p for p in self.modules.parameters() if p.ndim > 1]
        others = [p for p in self.modules.parameters() if p.ndim <= 1]
        self.optimiser = torch.optim.AdamW(
            [
                {"params": matrices, "weight_decay": tuning.weight_decay},
                {"params": others, "weight_decay": 0.0},
            ],
            lr=tuning.peak,
            fused=True,
        )
        self.averaged = {
            key: value.detach().clone()
            for key, value in self.modules.state_dict().items()
            if value.is_floating_point()
        }
        self.progress = Progress()
        self.now = Path(folder) / f"{name}.safetensors"
        self.constant = Path(folder) / f"{name}-constant.safetensors"

    def run(
        self,
        make: Callable[[int], Batch],
        loss_of: Callable[[Batch, int], tuple[Tensor, dict[str, float]]],
        measure: Callable[[], dict[str, float]],
        budget: Budget,
    ) -> Curve:
        """Train from the state on disk until the budget is used, then set the averaged weights.

        Args:
            make: returns the batch of a step; runs in a second thread.
            loss_of: returns the loss of a batch, and its terms for the curve.
            measure: returns the quality of the modules, which have their averaged weights at that time.
            budget: duration of the training.
        """
        self._resume(budget)
        curve, since = Curve(self.progress.rows), 0
        sums: dict[str, float] = {}
        progress, clock = self.progress, time.monotonic()
        steps = prefetched(make, progress.step)
        while not progress.is_finished:
            if progress.decay_from < 0 and budget.is_time_to_decay(progress.step, progress.minutes):
                if progress.step:
                    self._save(self.constant)
                progress.decay_from = progress.step
                progress.decay_steps = budget.decay_steps(progress.step, progress.minutes)
                logger.info("the learning rate falls over the last %d steps", progress.decay_steps)
                continue
            terms = self._step(next(steps), loss_of)
            since += 1
            for key, value in terms.items():
                sums[key] = sums.get(key, 0.0) + value
            now = time.monotonic()
            progress.minutes, clock = progress.minutes + (now - clock) / 60, now
            if progress.step % self.tuning.measure_every == 0 or progress.is_finished:
                with self.averages():
                    found = measure()
                losses = {f"{key}_loss": value / since for key, value in sums.items()}
                curve.add(step=progress.step, minutes=progress.minutes, **losses, **found)
                sums, since = {}, 0
            if progress.step % self.tuning.save_every == 0 or progress.is_finished:
                self._save(self.now)
        steps.close()
        self.averages().__enter__()
        return curve

    def _step(
        self, batch: Batch, loss_of: Callable[[Batch, int], tuple[Tensor, dict[str, float]]]
    ) -> dict[str, float]:
        progress, tuning = self.progress, self.tuning
        rate = learning_rate(
            progress.step, tuning.peak, tuning.warmup, progress.decay_from, progress.decay_steps
        )
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        self.modules.train()
        loss, terms = loss_of(batch, progress.step)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.modules.parameters(), 2.0)
        self.optimiser.step()
        progress.step += 1
        memory = min(tuning.average, (1 + progress.step) / (10 + progress.step))
        state = self.modules.state_dict()
        with torch.no_grad():
            torch._foreach_lerp_(
                list(self.averaged.values()), [state[key] for key in self.averaged], 1 - memory
            )
        return terms

    def averages(self) -> "_Averages":
        """Return a context in which the modules have their averaged weights and are in evaluation mode."""
        return _Averages(self)

    def _resume(self, budget: Budget) -> None:
        asked = asdict(budget)
        if self.now.is_file():
            self._load(self.now)
            if self.progress.decay_from >= 0 and self.progress.budget != asked:
                if not self.constant.is_file():
                    raise ArtifactError(
                        f"{self.now} cannot be trained for longer: {self.constant.name} is missing",
                        fix="ask for the budget it was trained with, or name another --cache to begin again",
                    )
                rows = self.progress.rows
                self._load(self.constant)
                logger.info("another budget: continuing from step %d of %d", self.progress.step, len(rows))
            logger.info("resuming at step %d, after %.1f minutes", self.progress.step, self.progress.minutes)
        self.progress.budget = asked

    def _save(self, path: Path) -> None:
        tensors = {f"model.{key}": value for key, value in self.modules.state_dict().items()}
        tensors |= {f"averaged.{key}": value for key, value in self.averaged.items()}
        for row, values in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{row}.{key}": value for key, value in values.items()}
        plain = {key: value.detach().cpu().clone().contiguous() for key, value in tensors.items()}
        # The state before the decay must not contain the plan of one run's decay.
        kept = self.progress if path == self.now else replace(self.progress, decay_from=-1, decay_steps=0)
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            save_file(plain, temporary, metadata={"progress": json.dumps(asdict(kept))})

    def _load(self, path: Path) -> None:
        with safe_open(path, framework="pt") as file:
            progress: dict[str, Any] = json.loads(file.metadata()["progress"])
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        model = {key[6:]: value for key, value in tensors.items() if key.startswith("model.")}
        self.modules.load_state_dict(model)
        for key, value in self.averaged.items():
            value.copy_(tensors[f"averaged.{key}"])
        state = self.optimiser.state_dict()
        state["state"] = {}
        parameters = [p for group in self.optimiser.param_groups for p in group["params"]]
        for key, value in tensors.items():
            if key.startswith("optimiser."):
                _, row, what = key.split(".")
                if value.ndim:
                    # The fused optimiser requires moments with the memory layout of their parameter.
                    value = torch.empty_like(parameters[int(row)]).copy_(value)
                state["state"].setdefault(int(row), {})[what] = value
        self.optimiser.load_state_dict(state)
        self.progress = Progress(**progress)


class _Averages:
    """Context that swaps the averaged weights in and restores the trained ones."""

    def __init__(self, training: Training) -> None:
        self.training = training
        self.before: dict[str, Tensor] = {}

    def __enter__(self) -> None:
        modules = self.training.modules
        self.before = {key: value.clone() for key, value in modules.state_dict().items()}
        modules.load_state_dict(self.before | self.training.averaged)
        modules.eval()

    def __exit__(self, *error: object) -> None:
        self.training.modules.load_state_dict(self.before)
