"""Where the parts of a finished scene lie, and which settings made them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hilsplat.base.artifacts import read_index, read_json, sha256_of_file
from hilsplat.base.errors import ArtifactError, MisalignedArtifactError
from hilsplat.base.provenance import provenance_path
from hilsplat.settings import EvaluateSettings, Section


@dataclass(frozen=True)
class FinishedScene:
    """The parts of one variant of a scene, some of which it may share with another variant.

    Attributes:
        folder: `results/<dataset>/<scene>`.
        scene, gaussians, semantic_tree, field, autoencoder, clip, masks: its artifacts.
        scores, panel: where these are, or would be; nothing is asked of them but settings.
    """

    folder: Path
    scene: Path
    gaussians: Path
    semantic_tree: Path
    field: Path
    autoencoder: Path
    clip: Path
    masks: Path
    scores: Path
    panel: Path

    @staticmethod
    def locate(folder: Path, variant: str = "default") -> "FinishedScene":
        """Find the parts of a variant.

        What a stage read is written in its provenance; without one, the parts are expected beside it. A
        variant without a field of its own was scored with another's, which its scores' provenance names.

        Raises:
            ArtifactError: a part is missing, or there is no such variant.
        """
        folder = Path(folder)
        scores = folder / variant / "scores.csv"
        if not (folder / variant).exists():
            raise ArtifactError(
                f"{folder} has no variant {variant!r}",
                expected=f"one of {', '.join(_variants(folder)) or 'none yet'}",
                fix="name it under ablation_variants and run the workflow",
            )
        field = folder / variant / "field.safetensors"
        if not field.exists():
            field = _recorded_input(scores, "field", folder) or field
        if not field.exists():
            raise _unfinished(folder, field)
        autoencoder = _input_of(field, "autoencoder", folder)
        clip = _input_of(autoencoder, "clip", folder)
        parts = {
            "scene": folder / "scene",
            "gaussians": folder / "gaussians.ply",
            "semantic_tree": _input_of(autoencoder, "semantic_tree", folder),
            "field": field,
            "autoencoder": autoencoder,
            "clip": clip,
            "masks": _input_of(clip, "masks", folder),
        }
        for path in parts.values():
            if not path.exists():
                raise _unfinished(folder, path)
        place = folder.resolve()
        return FinishedScene(
            folder,
            **parts,
            scores=scores,
            panel=place.parents[1] / "figures" / place.parent.name / place.name / "panel.png",
        )

    @property
    def clip_model(self) -> Path:
        """Folder of the CLIP that embedded the masks, and must embed the texts."""
        return Path(read_index(self.clip)["model"])

    def evaluate_settings(self) -> EvaluateSettings:
        """Canonical phrases, template, scale and selection of the run that made the scene; else the defaults.

        A scene without labels has no scores; its panel was drawn with the same settings.
        """
        if provenance_path(self.scores).is_file():
            return _section(EvaluateSettings, _recorded_settings(self.scores))
        return _section(EvaluateSettings, _recorded_settings(self.panel).get("evaluate", {}))


def _recorded_settings(artifact: Path) -> dict[str, Any]:
    """Settings in an artifact's provenance; none where it has none."""
    record = provenance_path(artifact)
    return read_json(record)["settings"] if record.is_file() else {}


def _section(section: type[Section], found: dict[str, Any]) -> Any:
    """A section from recorded settings; knobs that they do not know take their defaults."""
    return section(**{name: value for name, value in found.items() if name in section.model_fields})


def _variants(folder: Path) -> list[str]:
    return sorted(path.parent.name for path in folder.glob("*/field.safetensors"))


def _unfinished(folder: Path, missing: Path) -> ArtifactError:
    return ArtifactError(
        f"{folder} is not finished: {missing} is missing", fix=f"snakemake --cores 2 {missing}"
    )


def _input_of(artifact: Path, name: str, folder: Path) -> Path:
    """Where an artifact's input lies: as its provenance says, else beside it."""
    return _recorded_input(artifact, name, folder) or artifact.parent / name


def _recorded_input(artifact: Path, name: str, folder: Path) -> Path | None:
    """Where an artifact's input lies by its provenance, within the scene's folder wherever that is now."""
    record = provenance_path(artifact)
    if record.is_file():
        path = Path(read_json(record)["inputs"].get(name, {}).get("path", ""))
        recorded = folder / path.parent.name / path.name
        if path.name and recorded.exists():
            return recorded
    return None


def require_same(what: str, scene: str, path: Path, expected_sha256: str) -> None:
    """Refuse artifacts that were made for another file.

    Raises:
        MisalignedArtifactError: the file's digest is another one.
    """
    found = sha256_of_file(path)
    if found != expected_sha256:
        raise MisalignedArtifactError(
            f"the {what} of {scene} was made for another {Path(path).name}",
            expected=f"sha256 {expected_sha256[:12]}",
            found=f"sha256 {found[:12]} in {path}",
            fix=f"rerun the stage that writes the {what}",
        )
