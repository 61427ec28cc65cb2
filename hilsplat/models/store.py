"""The folders of models: the released models that they may hold, those that they do hold, and which answer.

Light enough to import when a run is planned: it opens no network.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import platformdirs

from hilsplat.base.artifacts import parse_json
from hilsplat.base.files import project_path
from hilsplat.models.layouts import LAYOUTS, layout_of

MODELS = Path("models")
"""Folder of a project's own models, relative to the folder in which a command or a run starts."""

FOLDER_VARIABLE = "HILSPLAT_MODELS"
"""Environment variable that names `user_models`."""

AUTO = "auto"
"""Value of a setting: a real model if there is one."""

EMBEDDED = {"sam": "models/sam-tiny", "clip": "models/clip-tiny"}
"""The models of the synthetic world that come with the project."""


@dataclass(frozen=True)
class Release:
    """A released model that `hilsplat models get` knows by name.

    Attributes:
        name: of its folder.
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
    Release("edgetam", "sam", "onnx-community/EdgeTAM-ONNX", 37, "Apache-2.0", "the fastest encoder"),
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
    place = model_path(folder)
    try:
        config = parse_json((place / "config.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    layout = layout_of(config)
    if layout is None or not any(place.rglob("*.onnx")):
        return None
    return PresentModel(folder, LAYOUTS[layout].kind, is_embedded(config))


def user_models() -> Path:
    """Return the folder of fetched models, which all projects of a user share."""
    named = os.environ.get(FOLDER_VARIABLE)
    return Path(named).expanduser() if named else platformdirs.user_data_path("hilsplat") / "models"


def model_path(path: str | Path) -> Path:
    """Return where a model folder of the settings is: as named, in the installation, or among the user's.

    A folder that is in none of these is returned unchanged, so that messages name what the user wrote.
    """
    place = project_path(path)
    of_user = user_models() / place.name
    return of_user if not place.exists() and place.parent == MODELS and of_user.exists() else place


def present_models(*stores: Path) -> list[PresentModel]:
    """Models in folders, best first: released ones in their order, others by name, embedded ones last.

    Args:
        stores: folders of models; of models of one name, the first counts. Default: the project's, the
            user's, and the embedded models of the installation.
    """
    order = {release.name: number for number, release in enumerate(RELEASES)}
    by_name: dict[str, PresentModel] = {}
    for folder in _folders(*stores):
        if folder.name not in by_name and (model := read_model(folder)) is not None:
            by_name[folder.name] = model
    return sorted(
        by_name.values(),
        key=lambda model: (model.embedded, order.get(model.folder.name, len(order)), model.folder.name),
    )


def broken_models() -> list[Path]:
    """Return folders that have networks, but no configuration of a model that we read."""
    folders = {folder.resolve(): folder for folder in _folders()}.values()
    return [folder for folder in folders if any(folder.rglob("*.onnx")) and read_model(folder) is None]


def _folders(*stores: Path) -> list[Path]:
    folders = [
        path for store in stores or (MODELS, user_models()) for path in store.glob("[!.]*") if path.is_dir()
    ]
    return folders + [project_path(path) for path in EMBEDDED.values() if not stores]


def real_model(family: str) -> Path | None:
    """The model that `auto` means: the best one of a family that knows more than the synthetic world."""
    return next(
        (each.folder for each in present_models() if each.family == family and not each.embedded), None
    )


def meaningless(name: str) -> str:
    """The sentence about an embedded CLIP that is asked about photographs."""
    return (
        f"{name} knows the synthetic world alone: its answers about photographs mean nothing. "
        "For answers that do: hilsplat models get, then run again"
    )
