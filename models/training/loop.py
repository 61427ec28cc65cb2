"""Training loop of both small models; interrupted trainings resume, and finished ones can be extended."""

import json
import logging
import time
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass, field, replace
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from hilsplat.base.atomic import atomic_path
from hilsplat.base.errors import ArtifactError

logger = logging.getLogger(__name__)

Batch = TypeVar("Batch")
Curve = list[dict[str, float]]  # learning curve: rows with equal keys; the first key is `step`
DECAY_SHARE = 0.25  # final share of a budget, during which the learning rate decays


def has_fast_half(device: torch.device) -> bool:
    """Return whether the device has fast bfloat16 convolutions: some GPUs, and CPUs with AVX512-BF16."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    supported = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return bool(supported and supported())


@dataclass(frozen=True)
class Budget:
    """Duration of a training: minutes or steps, whichever ends first; 0 sets no limit.

    A number of steps is reproducible on one machine; minutes adapt the schedule to the machine's speed.
    """

    minutes: float = 0.0
    steps: int = 0

    def __post_init__(self) -> None:
        if self.minutes <= 0 and self.steps <= 0:
            raise ValueError("training needs a limit: minutes or steps")

    def is_time_to_decay(self, step: int, minutes: float) -> bool:
        by_steps = self.steps > 0 and step >= int((1 - DECAY_SHARE) * self.steps)
        return by_steps or (self.minutes > 0 and minutes >= (1 - DECAY_SHARE) * self.minutes)

    def decay_steps(self, step: int, minutes: float) -> int:
        """Return the length of a decay that begins now: the remaining steps, or at least a quarter of all.

        The shorter of two limits applies. The minimum is for a state that is already past the budget.
        """
        left = []
        if self.steps > 0:
            left.append(max(self.steps - step, round(DECAY_SHARE * self.steps)))
        if self.minutes > 0:
            pace = step / minutes if minutes > 0 else 1.0
            left.append(round(max(self.minutes - minutes, DECAY_SHARE * self.minutes) * pace))
        return max(1, min(left))


def learning_rate(step: int, peak: float, warmup: int, decay_from: int = -1, decay_steps: int = 0) -> float:
    """Return the rate of a step: linear warm-up, a constant phase, then linear decay to 1 % of the peak."""
    rate = peak * min(1.0, (step + 1) / warmup)
    if decay_from >= 0:
        rate *= max(0.01, 1 - (step - decay_from) / max(1, decay_steps))
    return rate


def prefetched(make: Callable[[int], Batch], first: int) -> Generator[Batch, None, None]:
    """Yield make(first), make(first + 1), ..., each prepared while its predecessor is in use."""
    with ThreadPoolExecutor(1) as pool:
        upcoming = pool.submit(make, first)
        for step in count(first + 1):
            ready = upcoming.result()
            upcoming = pool.submit(make, step)
            yield ready


@dataclass(frozen=True)
class Tuning:
    """Settings of the optimiser and the training loop."""

    peak: float  # learning rate of the constant phase
    warmup: int = 100  # number of warm-up steps
    weight_decay: float = 0.02
    average: float = 0.998  # decay per step of the running average that gives the final weights
    measure_every: int = 500  # steps between rows of the learning curve
    save_every: int = 200  # steps between saved states


@dataclass
class Progress:
    step: int = 0  # number of finished steps
    minutes: float = 0.0  # their duration over all runs
    decay_from: int = -1  # first step of the learning rate decay, -1 before it
    decay_steps: int = 0
    budget: dict[str, float] = field(default_factory=dict)  # budget that the decay was planned for
    rows: Curve = field(default_factory=list)

    @property
    def is_finished(self) -> bool:
        """Whether the learning rate decay is complete."""
        return self.decay_from >= 0 and self.step >= self.decay_from + self.decay_steps


class Training:
    """Modules, optimiser and averaged weights of one model, with a state on disk.

    `<name>.safetensors` contains the current state, `<name>-constant.safetensors` the state at the start of
    the learning rate decay. A run with another budget resumes from the second: the constant phase does not
    depend on its planned length. All randomness is derived from the step number, so a resumed run repeats an
    uninterrupted one. The name should identify everything that the weights depend on.
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
        """
        self._resume(budget)
        since = 0
        sums: dict[str, float] = {}
        progress, clock = self.progress, time.monotonic()
        with closing(prefetched(make, progress.step)) as steps:
            while not progress.is_finished:
                if progress.decay_from < 0 and budget.is_time_to_decay(progress.step, progress.minutes):
                    if progress.step:
                        self._save(self.constant)
                    progress.decay_from = progress.step
                    progress.decay_steps = budget.decay_steps(progress.step, progress.minutes)
                    logger.info("the learning rate decays over the last %d steps", progress.decay_steps)
                    continue
                terms = self._step(next(steps), loss_of)
                since += 1
                for key, value in terms.items():
                    sums[key] = sums.get(key, 0.0) + value
                now = time.monotonic()
                progress.minutes, clock = progress.minutes + (now - clock) / 60, now
                if progress.step % self.tuning.measure_every == 0 or progress.is_finished:
                    with self._averaged_weights():
                        quality = measure()
                    losses = {f"{key}_loss": value / since for key, value in sums.items()}
                    values = {"step": progress.step, "minutes": progress.minutes, **losses, **quality}
                    progress.rows.append({key: float(f"{value:.5g}") for key, value in values.items()})
                    logger.info("  ".join(f"{key} {value:g}" for key, value in progress.rows[-1].items()))
                    sums, since = {}, 0
                if progress.step % self.tuning.save_every == 0 or progress.is_finished:
                    self._save(self.now)
        self._load_averages()
        return progress.rows

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

    def _load_averages(self) -> None:
        """Set the averaged weights, and switch to evaluation mode."""
        self.modules.load_state_dict(self.modules.state_dict() | self.averaged)
        self.modules.eval()

    @contextmanager
    def _averaged_weights(self) -> Iterator[None]:
        before = {key: value.clone() for key, value in self.modules.state_dict().items()}
        self._load_averages()
        yield
        self.modules.load_state_dict(before)

    def _resume(self, budget: Budget) -> None:
        planned = asdict(budget)
        if self.now.is_file():
            self._load(self.now)
            if self.progress.decay_from >= 0 and self.progress.budget != planned:
                if not self.constant.is_file():
                    raise ArtifactError(
                        f"{self.now} cannot resume with another budget: {self.constant.name} is missing",
                        fix="use the previous budget, or start again with another --cache folder",
                    )
                finished = self.progress.step
                self._load(self.constant)
                logger.info("different budget: resuming from step %d of %d", self.progress.step, finished)
            logger.info("resuming at step %d, after %.1f minutes", self.progress.step, self.progress.minutes)
        self.progress.budget = planned

    def _save(self, path: Path) -> None:
        tensors = {f"model.{key}": value for key, value in self.modules.state_dict().items()}
        tensors |= {f"averaged.{key}": value for key, value in self.averaged.items()}
        for row, values in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{row}.{key}": value for key, value in values.items()}
        plain = {key: value.detach().cpu().clone().contiguous() for key, value in tensors.items()}
        # The state before the decay must not contain the plan of one run's decay.
        progress = self.progress if path == self.now else replace(self.progress, decay_from=-1, decay_steps=0)
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_path(path) as temporary:
            save_file(plain, temporary, metadata={"progress": json.dumps(asdict(progress))})

    def _load(self, path: Path) -> None:
        with safe_open(path, framework="pt") as file:
            progress: dict[str, Any] = json.loads(file.metadata()["progress"])
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        model = {
            key.removeprefix("model."): value for key, value in tensors.items() if key.startswith("model.")
        }
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
