"""Locations of a finished scene's artifacts, and the settings that produced them."""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, fields
from fnmatch import fnmatchcase
from pathlib import Path

from hilsplat.base.artifacts import INDEX, provenance_path, read_index, run_command
from hilsplat.base.errors import ArtifactError, foreign, nearest
from hilsplat.base.lineage import read_provenance
from hilsplat.base.plugins import entry_points
from hilsplat.settings import EvaluateSettings

KEY_VIEWS = "key-views"
"""Variant computed from the masks of a subset of the views, used for queries until `default` is finished."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SceneParts:
    """Paths of the artifacts needed to query one variant of a scene.

    Attributes:
        field: language field; None if it does not exist yet, in which case queries use only the tree.
        autoencoder: decoder from the field's features to CLIP vectors; None if there is no field.
        clip: CLIP vectors of the masks; its index records the model, which also embeds the queries.
    """

    scene: Path
    gaussians: Path
    semantic_tree: Path
    field: Path | None
    autoencoder: Path | None
    clip: Path
    masks: Path

    def as_inputs(self) -> dict[str, Path]:
        """Return the existing parts by name, in the format of a provenance record's inputs."""
        return {part.name: path for part in fields(self) if (path := getattr(self, part.name)) is not None}


@dataclass(frozen=True)
class FinishedScene:
    """One variant of a finished scene; it may share artifacts with other variants."""

    folder: Path
    variant: str
    parts: SceneParts

    @staticmethod
    def locate(folder: Path, variant: str = "default") -> "FinishedScene":
        """Find the artifacts of a variant, which must all be in the scene folder.

        Input paths are read from provenance; without it, each is expected beside the artifact made from it. A
        variant may share the field recorded in the provenance of its scores. During a run, the variant's own
        CLIP vectors are sufficient. Until `default` has any, those of the key views are used, with a warning.
        While a run rebuilds the scene, what it has already made precedes what is left of the previous run.

        Raises:
            ArtifactError: the folder, the variant or a part is missing.
        """
        require_scene_folder(folder)
        require_variant(folder, variant)
        new, scores = (folder / variant / name for name in ("field.safetensors", "scores.csv"))
        field = _recorded_input(scores, "field", folder) or new
        if field != new and new.exists() and new.stat().st_mtime > provenance_path(scores).stat().st_mtime:
            field = new  # it is not scored yet
        own, early = (folder / name / "clip" for name in (variant, KEY_VIEWS))
        usable = [field, own, *([early] if variant == "default" else [])]
        made = [path for path in usable if path.exists()]
        if not made:  # `default` has its own vectors; other variants may share them
            raise _unfinished(folder, own if variant == "default" else field)
        clip = next((path for path in made if not changed_input(path, folder)), made[0])
        autoencoder = None
        if clip == field:
            autoencoder = input_of(field, "autoencoder", folder)
            clip = input_of(autoencoder, "clip", folder)
        elif clip != own:
            logger.warning("%s", refining(folder))
        tree = input_of(autoencoder or clip, "semantic_tree", folder)
        used_field, masks = field if autoencoder else None, input_of(clip, "masks", folder)
        gaussians = folder / "gaussians.ply"
        parts = SceneParts(folder / "scene", gaussians, tree, used_field, autoencoder, clip, masks)
        for path in parts.as_inputs().values():
            if not path.exists():
                raise _unfinished(folder, path)
        return FinishedScene(folder, variant, parts)

    def evaluate_settings(self) -> EvaluateSettings:
        """Return the query settings of the run that made the scene, from the provenance of its scores.

        A scene without labels has no scores, but its nodes were named, and its panel drawn, with the same
        settings.
        """
        variant_folder, scene = self.folder / self.variant, self.folder.resolve()
        panel = scene.parent.parent / "figures" / scene.parent.name / scene.name / "panel.webp"
        records = map(read_provenance, (variant_folder / "scores.csv", variant_folder / "names", panel))
        settings = next((record.settings.get("evaluate", {}) for record in records if record), None)
        if settings is None:
            logger.warning(
                "%s: no scores, names or panel record the settings; using the defaults", self.folder
            )
            settings = {}
        values = {name: settings[name] for name in EvaluateSettings.model_fields if name in settings}
        fix = "delete the damaged provenance file of the scores, or rerun the workflow"
        with foreign("the record of query settings", ArtifactError, problem="is not valid", fix=fix):
            return EvaluateSettings(**values)


def scenes_in(results: Path) -> list[str]:
    """Return the names, `<dataset>/<scene>`, of the scenes of a results folder that have poses."""
    places = [path.parents[1] for path in results.glob(f"*/*/scene/{INDEX}")]  # skips unreadable folders
    return sorted(f"{path.parent.name}/{path.name}" for path in places)


def matching_scenes(names: Iterable[str], pattern: str) -> list[str]:
    """Return the scenes, `<dataset>/<scene>`, with a name, data set or scene that matches (`fnmatch`)."""
    return [name for name in names if any(fnmatchcase(each, pattern) for each in (name, *name.split("/")))]


def command_name(folder: Path) -> str:
    """Return a scene's name in commands: `<dataset>/<scene>`, or its path if it is not in results/."""
    return str(folder.relative_to("results") if folder.parts[0] == "results" else folder)


def holds_scenes(folder: Path) -> bool:
    """Return whether a folder is or has scenes, as a folder of photographs with a scene's name has not."""
    return any(any(folder.glob(place)) for place in ("scene", "*/scene", "*/*/scene"))


def require_scene_folder(folder: Path) -> None:
    """Raise ArtifactError, with known scenes, if a folder does not exist or contains scenes."""
    around = folder.absolute().parent
    below = [f"{folder.name}/{path.parents[1].name}" for path in folder.glob(f"*/scene/{INDEX}")]
    inside = scenes_in(folder) or sorted(below)
    if folder.is_dir() and not inside:
        return
    known = inside or scenes_in(around) or scenes_in(around.parent)  # results/desk, or results/photos/desk
    name = f"{folder.parent.name}/{folder.name}"
    first = "correct the name" if known else "change to the folder of the project"
    raise ArtifactError(
        f"{folder} is a folder of scenes, not a scene" if inside else f"scene folder {folder} is missing",
        expected=nearest(name, known) if known else "a run's folder results/<dataset>/<scene>, or a copy",
        fix=f"{first}, or make the scene: hilsplat run SCENE; to list all: hilsplat scenes",
    )


def require_variant(folder: Path, variant: str) -> None:
    """Raise ArtifactError if other variants of a scene accept queries, and this one doesn't exist."""
    finished = finished_variants(folder)
    if finished and not (folder / variant).exists():
        raise ArtifactError(
            f"{folder} has no variant {variant!r}",
            expected=nearest(variant, finished),
            fix="correct the name, or list it under ablation_variants and run the workflow",
        )


def refining(folder: Path) -> str:
    """Return a message that states how many key views are used until the run ends."""
    used = len(read_index(folder / KEY_VIEWS / "masks")["views"])
    train = sum(entry["split"] == "train" for entry in read_index(folder / "scene")["views"].values())
    return f"{folder.parent.name}/{folder.name} uses {used} of {train} photographs until the run ends"


def is_drawn(scene: Path) -> bool:
    """Return whether a `Scene` artifact was made from a generator's renders (from its provenance)."""
    record = read_provenance(scene)
    images = record.inputs.get("images") if record else None
    if images is None or images.files is not None:  # each photograph of a user is recorded
        return False
    folder = Path(images.path)
    return folder.name == "images" and folder.parent.name in entry_points("hilsplat.generators")


def finished_variants(folder: Path) -> list[str]:
    """Return the variants of a scene that accept queries: those with their own field or CLIP vectors."""
    outputs = [path for name in ("field.safetensors", "clip") for path in folder.glob(f"*/{name}")]
    return sorted({path.parent.name for path in outputs})


def _unfinished(folder: Path, missing: Path) -> ArtifactError:
    return ArtifactError(f"{folder} is not finished: {missing} is missing", fix=run_command(missing))


def input_of(artifact: Path, name: str, folder: Path) -> Path:
    """Return the path of an artifact's input from its provenance or, if not recorded, beside the artifact."""
    return _recorded_input(artifact, name, folder) or artifact.parent / name


def changed_input(artifact: Path, folder: Path) -> str:
    """Return the name of an artifact from which another was made and which was rebuilt or removed since.

    The provenance records of the scene are followed from `artifact` to its poses. The result is empty if no
    recorded input has changed; artifacts without a record are not compared.
    """
    waiting, seen = [read_provenance(artifact)], set[Path]()
    while waiting:
        record = waiting.pop()
        for read in record.inputs.values() if record else ():
            if read.sha256 is None:
                continue  # files of a user, which only the workflow compares
            places = [folder / Path(*Path(read.path).parts[-count:]) for count in (2, 1)]
            path = next((candidate for candidate in places if provenance_path(candidate).is_file()), None)
            if path is None or path in seen:
                continue
            made = read_provenance(path)
            written = made.outputs.get(path.name) if made else None
            if not path.exists() or (written is not None and written.sha256 != read.sha256):
                return path.name
            seen.add(path)
            waiting.append(made)
    return ""


def _recorded_input(artifact: Path, name: str, folder: Path) -> Path | None:
    """Return the path of an artifact's recorded input, even if the scene folder was moved, or None."""
    record = read_provenance(artifact)
    if record is None or name not in record.inputs:
        return None
    path = Path(record.inputs[name].path)
    recorded = folder / path.parent.name / path.name
    return recorded if path.name and recorded.exists() else None
