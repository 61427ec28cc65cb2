"""Artifacts of a finished scene, each read once and checked to belong together."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hilsplat.base.artifacts import sha256_of_file
from hilsplat.field.code import Code, autoencoder_file, load_code
from hilsplat.field.language_field import LanguageField
from hilsplat.models.store import is_embedded, meaningless
from hilsplat.scene.finished import SceneParts, is_drawn, require_made_for
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.splat.gaussians import Gaussians

if TYPE_CHECKING:
    from hilsplat.embed.clip import ClipModel


class Opened:
    """Artifacts by path, each opened and hashed once because the variants of a scene share most of them."""

    def __init__(self) -> None:
        self._kept: dict[tuple[Hashable, ...], Any] = {}

    def get(self, how: Callable[..., Any], path: Path, *more: Hashable) -> Any:
        """Return `how(path, *more)`, computed on the first call."""
        key = (how, Path(path).resolve(), *more)
        if key not in self._kept:
            self._kept[key] = how(path, *more)
        return self._kept[key]


@dataclass(frozen=True)
class OpenedParts:
    """The artifacts of `SceneParts`, opened and checked to belong together.

    Attributes:
        scene: cameras and views.
        gaussians: frozen geometry.
        tree: the nodes.
        language: the field; None if the run has not computed it yet.
        code: decodes the field; None if there is no field.
        clip: the model that embedded the masks.
        caution: sentence that explains why this model's answers are meaningless here; empty if they are not.
    """

    scene: Scene
    gaussians: Gaussians
    tree: SemanticTree
    language: LanguageField | None
    code: Code | None
    clip: "ClipModel"
    caution: str

    @staticmethod
    def of(parts: SceneParts, template: str, threads: int, opened: Opened) -> "OpenedParts":
        """Open the parts.

        Args:
            parts: paths of the artifacts.
            template: prompt template of the texts that CLIP embeds.
            threads: number of threads for CLIP.
            opened: artifacts that other variants of the scene have already opened.

        Raises:
            MisalignedArtifactError: the tree or field was made for other Gaussians or cameras, or the field
                for another autoencoder.
            ModelError: the CLIP that embedded the masks is not found.
        """
        from hilsplat.embed.clip import open_clip_of
        from hilsplat.splat.ply import load_ply

        scene = opened.get(Scene.load, parts.scene)
        gaussians = opened.get(load_ply, parts.gaussians)
        tree = opened.get(SemanticTree.load, parts.semantic_tree, parts.clip)
        made_for = {"semantic tree": tree.gaussians_sha256}
        clip = opened.get(open_clip_of, parts.clip, threads, template)
        language = code = None
        if parts.field is not None and parts.autoencoder is not None:
            language = opened.get(LanguageField.load, parts.field)
            made_for["language field"] = language.gaussians_sha256
            code_file = autoencoder_file(parts.autoencoder)
            own = {"language field": language.autoencoder_sha256}
            require_made_for(code_file, opened.get(sha256_of_file, code_file), scene.name, own)
            code = opened.get(load_code, parts.autoencoder)
            clip.require_width(code.channels, f"autoencoder {parts.autoencoder}")
        cameras = parts.scene / "cameras.npz"
        own = {"semantic tree": tree.cameras_sha256}
        require_made_for(cameras, opened.get(sha256_of_file, cameras), scene.name, own)
        require_made_for(parts.gaussians, opened.get(sha256_of_file, parts.gaussians), scene.name, made_for)
        drawn = is_drawn(parts.scene)
        caution = meaningless(clip.model.folder.name) if is_embedded(clip.model.config) and not drawn else ""
        return OpenedParts(scene, gaussians, tree, language, code, clip, caution)
