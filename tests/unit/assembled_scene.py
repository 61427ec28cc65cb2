"""A language scene assembled from parts: functions return the weights of views and the vectors of texts."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import scipy.sparse as sp

from hilsplat.embed.clip import ClipModel
from hilsplat.field.code import Code, LanguageField
from hilsplat.query.field_answers import FieldAnswers
from hilsplat.query.language_scene import LanguageScene
from hilsplat.query.scene_views import SceneViews, ViewStore
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.settings import EvaluateSettings
from hilsplat.splat.gaussians import Gaussians


@dataclass(frozen=True)
class GivenViews(SceneViews):
    weights: Callable[[str], sp.csr_matrix] = field(kw_only=True)

    def pixel_weights(self, view: str) -> sp.csr_matrix:
        return self.weights(view)


class GivenClip(ClipModel):
    def __init__(self, embed: Callable[[Sequence[str]], np.ndarray], world_only: bool = False) -> None:
        self.embed = embed
        self.model: Any = SimpleNamespace(config={"world_only": world_only}, folder=Path("models/clip-tiny"))

    def embed_texts(self, texts: Sequence[str]) -> np.ndarray:
        return self.embed(texts)

    def unknown_words(self, text: str) -> list[str]:
        return []


def assembled(
    scene: Scene,
    gaussians: Gaussians,
    tree: SemanticTree,
    weights: Callable[[str], sp.csr_matrix],
    embed: Callable[[Sequence[str]], np.ndarray],
    field: tuple[LanguageField, Code] | None = None,
    settings: EvaluateSettings | None = None,
    threads: int = 1,
) -> LanguageScene:
    settings = settings or EvaluateSettings()
    views, clip = GivenViews(scene, gaussians, tree, threads, weights=weights), GivenClip(embed)
    return LanguageScene(
        views, clip, settings, FieldAnswers(views, *field, clip, settings) if field else None
    )


def with_views(scene: LanguageScene, **changes: Any) -> LanguageScene:
    """The scene with changed views, and nothing cached."""
    views = replace(scene.views, cache=ViewStore(), **changes)
    decoded_field = scene.decoded_field and replace(scene.decoded_field, views=views)
    return replace(scene, views=views, decoded_field=decoded_field)
