"""The folder `models/`: the released models that it may hold, those that it does hold, and which answer.

Light enough to import when a run is planned: it opens no network.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import parse_json
from hilsplat.base.files import project_path
from hilsplat.models.layouts import LAYOUTS, layout_of

MODELS = Path("models")
"""Folder of the models, relative to the folder in which a command or a run starts."""

AUTO = "auto"
"""Value of a setting: a real model if there is one."""

EMBEDDED = {"sam": "models/sam-tiny", "clip": "models/clip-tiny"}
"""The models of the synthetic world that come with the project."""


@dataclass(frozen=True)
class Release:
    """A released model that `hilsplat models get` knows by name.

    Attributes:
        name: its folder in `models/`.
        family: "sam" or "clip".
        repository: on the model hub.
        megabytes: approximate size of the download; the hub's own number is reported before a transfer.
        licence: of the weights.
        use: what it is good for.
    """

    name: str
    family: str
    repository: str
    megabytes: int
    licence: str
    use: str


RELEASES = (
    Release("sam-vit-huge", "sam", "Xenova/sam-vit-huge", 2570, "Apache-2.0", "the paper's masks; a GPU"),
    Release(
        "sam-vit-large", "sam", "Xenova/sam-vit-large", 1250, "Apache-2.0", "between huge and base; a GPU"
    ),
    Release("sam-vit-base", "sam", "Xenova/sam-vit-base", 376, "Apache-2.0", "the smallest original SAM"),
    Release(
        "sam2.1-hiera-small",
        "sam",
        "onnx-community/sam2.1-hiera-small-ONNX",
        184,
        "Apache-2.0",
        "masks of photographs, on a CPU",
    ),
    Release(
        "sam2.1-hiera-base-plus",
        "sam",
        "onnx-community/sam2.1-hiera-base-plus-ONNX",
        328,
        "Apache-2.0",
        "between small and ViT-B",
    ),
    Release("slimsam-77", "sam", "Xenova/slimsam-77-uniform", 40, "Apache-2.0", "little memory or time"),
    Release(
        "clip-vit-b-16-laion2b",
        "clip",
        "laion/CLIP-ViT-B-16-laion2B-s34B-b88K",
        600,
        "MIT",
        "words as in LangSplat and the paper; exported here (extra export)",
    ),
    Release(
        "clip-vit-base-patch16", "clip", "Xenova/clip-vit-base-patch16", 601, "MIT", "words, ready to use"
    ),
)
"""In the order in which `auto` prefers them, within a family."""

RECOMMENDED = ("sam2.1-hiera-small", "clip-vit-base-patch16")
"""What `hilsplat models get` fetches without a name; docs/models.md says why."""


@dataclass(frozen=True)
class PresentModel:
    """A model folder that is there; whether it is whole shows when it is opened.

    Attributes:
        folder: where it is.
        family: "sam" or "clip".
        embedded: it knows the synthetic world alone.
    """

    folder: Path
    family: str
    embedded: bool


def is_embedded(config: Mapping[str, Any]) -> bool:
    """Whether a model's config.json says that it was trained on the synthetic world and on nothing else."""
    return config.get("world_only") is True


def read_model(folder: Path) -> PresentModel | None:
    """What a folder holds, by its config.json; None if it has no network or is not a model that we read."""
    place = project_path(folder)
    try:
        config = parse_json((place / "config.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    layout = layout_of(config)
    if layout is None or not any(place.rglob("*.onnx")):
        return None
    return PresentModel(folder, LAYOUTS[layout].kind, is_embedded(config))


def present_models(models: Path = MODELS) -> list[PresentModel]:
    """Models in a folder, best first: released ones in their order, others by name, embedded ones last."""
    order = {release.name: number for number, release in enumerate(RELEASES)}
    folders = sorted(path for path in models.glob("[!.]*") if path.is_dir())
    found = [model for folder in folders if (model := read_model(folder)) is not None]
    return sorted(
        found, key=lambda model: (model.embedded, order.get(model.folder.name, len(order)), model.folder.name)
    )


def real_model(family: str, models: Path = MODELS) -> Path | None:
    """The model that `auto` means: the best one of a family that knows more than the synthetic world."""
    return next(
        (each.folder for each in present_models(models) if each.family == family and not each.embedded), None
    )


def meaningless(name: str) -> str:
    """The sentence about an embedded CLIP that is asked about photographs."""
    return (
        f"{name} knows the synthetic world alone: its answers about photographs mean nothing. "
        "For answers that do: hilsplat models get, then run again"
    )
