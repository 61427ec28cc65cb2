"""State of a fit and its checkpoint."""

import json
import logging
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hilsplat.base.artifacts import read_npz, write_npz
from hilsplat.base.errors import ArtifactError
from hilsplat.splat.densify import ScreenGradients
from hilsplat.splat.optimise import FIELDS, Adam

logger = logging.getLogger(__name__)


@dataclass
class FitState:
    """State from which a fit resumes exactly.

    Attributes:
        adam: parameters and moments.
        gradients: screen gradients since the last densification.
        generator: source of view order, splits and random backgrounds.
        order: indices of the remaining views of this round.
        step: completed steps.
        curve: rows of (step, loss, training PSNR in dB, number of Gaussians).
    """

    adam: Adam
    gradients: ScreenGradients
    generator: np.random.Generator
    order: list[int] = field(default_factory=list)
    step: int = 0
    curve: list[tuple[float, float, float, float]] = field(default_factory=list)

    def save(self, path: Path, key: str) -> None:
        """Write a checkpoint."""
        arrays = {
            f"{table}_{name}": getattr(self.adam, table)[name]
            for table in ("parameters", "first", "second")
            for name in FIELDS
        }
        write_npz(
            path,
            key=np.array(key),
            counts=np.array([self.step, self.adam.steps]),
            order=np.array(self.order, dtype=np.int64),
            generator=np.array(json.dumps(self.generator.bit_generator.state)),
            gradient_total=self.gradients.total,
            gradient_seen=self.gradients.seen,
            curve=np.array(self.curve, dtype=np.float64).reshape(-1, 4),
            **arrays,
        )

    @staticmethod
    def load(path: Path, key: str) -> "FitState | None":
        """Read the checkpoint of this fit; None if it is missing, damaged or of another fit."""
        if not path.is_file():
            return None
        try:
            arrays = read_npz(path)
        except ArtifactError as error:
            logger.warning("ignoring the checkpoint, the fit starts over: %s", error)
            return None
        if arrays["key"].item() != key:
            logger.info("checkpoint %s belongs to other inputs; the fit starts over", path)
            return None
        parameters, first, second = (
            {name: arrays[f"{table}_{name}"] for name in FIELDS}
            for table in ("parameters", "first", "second")
        )
        generator = np.random.default_rng()
        generator.bit_generator.state = json.loads(arrays["generator"].item())
        step, adam_steps = (int(count) for count in arrays["counts"])
        return FitState(
            Adam(parameters, first, second, adam_steps),
            ScreenGradients(arrays["gradient_total"], arrays["gradient_seen"]),
            generator,
            arrays["order"].tolist(),
            step,
            [tuple(row) for row in arrays["curve"].tolist()],
        )
