"""Model folders: released models, installed models, and the models that `auto` selects.

This module opens no networks, so that importing it to plan a run is fast.
"""

import csv
import functools
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import platformdirs

from hilsplat.base.artifacts import parse_json
from hilsplat.base.files import files_below, project_path, stats_of
from hilsplat.base.lineage import digests_of, sha256_of_json, visible_files
from hilsplat.models.layouts import LAYOUTS, layout_of

MODELS = Path("models")
"""Folder of a project's own models, relative to the working directory of a command or run."""
AUTO = "auto"  # setting value that selects a pretrained model if one is installed
EMBEDDED = {"sam": "models/sam-tiny", "clip": "models/clip-tiny"}
"""Models of the synthetic world that are included in the project."""


@dataclass(frozen=True)
class Release:
    """A released model that `hilsplat models get` accepts by name."""

    name: str  # name of the model folder
    repository: str
    megabytes: int  # approximate size of the download; the exact size is reported before a transfer
    family: str  # "sam" or "clip"
    licence: str  # licence of the weights
    use: str


def _releases() -> tuple[Release, ...]:
    with Path(__file__).with_name("releases.tsv").open(encoding="utf-8", newline="") as stream:
        rows: list[dict[str, Any]] = list(csv.DictReader(stream, delimiter="\t"))
    return tuple(Release(**{**row, "megabytes": int(row["megabytes"])}) for row in rows)


RELEASES = _releases()  # released models, in the order of preference of `auto` within each family

RECOMMENDED = ("sam2.1-hiera-small", "clip-vit-base-patch16")
"""Models that `hilsplat models get` downloads if no name is given; docs/models.md gives the reasons."""


@dataclass(frozen=True)
class PresentModel:
    """An existing model folder, which is checked for completeness only when it is opened."""

    folder: Path
    family: str  # "sam" or "clip"
    embedded: bool  # trained on the synthetic world only


def is_embedded(config: Mapping[str, Any]) -> bool:
    """Return whether, according to its config.json, a model was trained on the synthetic world only."""
    return config.get("world_only") is True


def read_model(folder: Path) -> PresentModel | None:
    """Return the model in a folder, or None if it has no network or its config.json is not supported."""
    path = model_path(folder)
    try:
        config = parse_json((path / "config.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    layout = layout_of(config)
    if layout is None or not _has_network(path):
        return None
    return PresentModel(folder, LAYOUTS[layout].kind, is_embedded(config))


def planned_model(folder: Path) -> PresentModel | None:
    """Return the model in a folder or, if the folder is missing, the released model of that name."""
    released = next((release for release in RELEASES if release.name == folder.name), None)
    if released is not None and not model_path(folder).exists():
        return PresentModel(folder, released.family, embedded=False)
    return read_model(folder)


def user_models() -> Path:
    """Return the folder of downloaded models, shared by all projects of a user."""
    if named := os.environ.get("HILSPLAT_MODELS"):
        return Path(named).expanduser()
    with suppress(RuntimeError):
        return platformdirs.user_data_path("hilsplat") / "models"
    return Path("~/.local/share/hilsplat/models")  # missing, because the user has no home


def model_path(path: str | Path) -> Path:
    """Find a model folder named in the settings: as given, in the installation, or among the user's models.

    Any other path is returned unchanged, so that messages show what the user wrote.
    """
    in_project = project_path(path)
    of_user = user_models() / in_project.name
    if in_project.parent == MODELS and not in_project.exists() and of_user.exists():
        return of_user
    return in_project


def present_models() -> list[PresentModel]:
    """Return the installed models, best first: released models, others by name, then embedded models.

    If several folders have the same name, the project's models take precedence, then the user's models, then
    the embedded models of the installation.
    """
    order = {release.name: number for number, release in enumerate(RELEASES)}
    by_name: dict[str, PresentModel] = {}
    for folder in _folders():
        if folder.name not in by_name and (model := read_model(folder)) is not None:
            by_name[folder.name] = model
    return sorted(
        by_name.values(),
        key=lambda model: (model.embedded, order.get(model.folder.name, len(order)), model.folder.name),
    )


def broken_models() -> list[Path]:
    """Return the folders that contain networks but no configuration of a supported model."""
    folders = {folder.resolve(): folder for folder in _folders()}.values()
    return [folder for folder in folders if _has_network(folder) and read_model(folder) is None]


def _has_network(folder: Path) -> bool:
    return any(path.suffix == ".onnx" for path in files_below(folder))


def _folders() -> list[Path]:
    paths = [path for store in (MODELS, user_models()) for path in store.glob("[!.]*")]
    return [path for path in paths if path.is_dir()] + [project_path(path) for path in EMBEDDED.values()]


@functools.cache
def model_digest(folder: Path, cache: Path) -> str:
    """Return the digest of a model folder, or "... is missing"; the stage reports how to fix it.

    The digest is that of `sha256_of_path`. Those of files are kept in `cache`; reading ViT-H takes seconds.
    """
    if not folder.is_dir():
        return f"{folder} is missing"
    digests = digests_of([str(path) for path in visible_files(folder)], cache / "digests.json")
    return sha256_of_json([(Path(path).relative_to(folder).as_posix(), digests[path]) for path in digests])


def real_model(family: str) -> Path | None:
    """Return the model that `auto` selects: the best pretrained model of a family, or None."""
    models = (model for model in present_models() if model.family == family)
    return next((model.folder for model in models if not model.embedded), None)


def models_table() -> str:
    """Return a table of released and installed models that marks those used for photographs."""
    present = {model.folder.name: model for model in present_models()}
    chosen = (real_model("sam"), real_model("clip"))

    def state(name: str) -> str:
        if name in present:
            return "in use" if present[name].folder in chosen else "installed"
        return "incomplete" if (user_models() / f".{name}.part").is_dir() else ""

    rows: list[tuple[object, ...]] = [("name", "kind", "MB", "licence", "", "use")]
    for release in RELEASES:
        use = release.use + (" (recommended)" if release.name in RECOMMENDED else "")
        kind, licence = release.family.upper(), release.licence
        rows.append((release.name, kind, release.megabytes, licence, state(release.name), use))
    released = [release.name for release in RELEASES]
    for name, model in present.items():
        if name in released:
            continue
        num_bytes = sum(stat.st_size for stat in stats_of(files_below(model.folder)).values())
        use = "the synthetic world only" if model.embedded else ""
        rows.append((name, model.family.upper(), f"{num_bytes / 1e6:.0f}", "", state(name), use))
    lines = ["{:<24} {:<5} {:>8}  {:<11} {:<11} {}".format(*row).rstrip() for row in rows]
    return "\n".join(
        [
            *lines,
            "",
            "Install: hilsplat models get NAME (or owner/name on the hub); "
            "without a name, the recommended pair",
            f"Models are stored in {user_models()}; those in a project's models/ take precedence.",
        ]
    )


def meaningless(name: str) -> str:
    """Return the warning for queries of photographs with an embedded CLIP model."""
    return (
        f"{name} was trained only on the synthetic world: its answers about photographs are meaningless. "
        "To use a pretrained model, run `hilsplat models get` and rerun."
    )
