"""A scene as the viewer page shows it: its Gaussians, and each variant once it accepts queries."""

import logging
import shlex
from dataclasses import replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, UInt8

from hilsplat.base.artifacts import read_index, run_command
from hilsplat.base.errors import ArtifactError, HilsplatError, SettingsError, first_line, nearest
from hilsplat.base.images import to_uint8
from hilsplat.base.lineage import sha256_of_file
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.query.language_scene import LanguageScene
from hilsplat.query.names import FILE, read_names, tree_digest
from hilsplat.query.scene_state import SceneState
from hilsplat.query.scene_views import Opened
from hilsplat.scene.finished import (
    FinishedScene,
    SceneParts,
    finished_variants,
    require_scene_folder,
    scenes_in,
)
from hilsplat.scene.scene import Scene
from hilsplat.segment.origin import masks_label
from hilsplat.semantic_tree.tree import ViewNodes
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import pixel_weights
from hilsplat.splat.spz import fractional_bits, spz_bytes
from hilsplat.viewer import payload
from hilsplat.viewer.frames import Paint, faded, painted, pick
from hilsplat.viewer.wire import MAX_GAUSSIANS, MAX_NODES, Style, rows_of
from hilsplat.web.file_changes import version_of
from hilsplat.web.scene_thread import ShownScene

VIEWS_MIB = 256.0  # memory limit for cached per-view results, such as compositing weights

CACHED_RELEVANCIES = 8
"""Number of cached field relevancies (per variant, text and level), each with one byte per Gaussian."""

ANSWERING = ("semantic_tree", "clip", "masks", "autoencoder", "field.safetensors")
"""Parts of a variant on which its answers depend."""

logger = logging.getLogger(__name__)


class ViewerScene(ShownScene):
    """The existing parts of a scene. Not thread-safe: use it and all returned objects on a single thread.

    Args:
        folder: `results/<dataset>/<scene>`, or a copy of that folder.
        variant: the initially selected variant, which may not exist yet.

    Raises:
        ArtifactError: the scene has no poses or no Gaussians yet, or too many to show.
    """

    def __init__(self, folder: Path, variant: str = "default", threads: int = 1) -> None:
        super().__init__()
        self.folder, self.first, self.threads = Path(folder).absolute(), variant, threads
        self.results = self.folder.parent.parent
        self.opened = Opened(VIEWS_MIB)
        self.ply = ply = self.folder / "gaussians.ply"
        require_scene_folder(self.folder)
        if not ply.exists():
            raise ArtifactError(
                f"{folder} has no Gaussians to show yet: {ply} is missing", fix=run_command(ply)
            )
        variants = [self.folder / name for name in self.variants]
        answering = [variant / part for variant in variants for part in ANSWERING]
        self.identify((self.folder / "scene", ply, *answering))
        self.note((self.folder / "scene", ply))
        self.scene = self.opened.get(Scene.load, self.folder / "scene")
        self.gaussians: Gaussians = self.opened.get(load_ply, ply)
        if len(self.gaussians) > MAX_GAUSSIANS:
            raise ArtifactError(
                f"{ply} is too large for the page",
                expected=f"at most {MAX_GAUSSIANS} Gaussians",
                found=f"{len(self.gaussians)}",
                fix="lower gaussians.max_gaussians",
            )
        self._variants: dict[str, tuple[SceneParts, LanguageScene]] = {}
        self.field_relevancy = lru_cache(CACHED_RELEVANCIES)(self._field_relevancy)
        self.paint = lru_cache(1)(self._paint)
        self.remaining = lru_cache(1)(self._remaining)

    def opened_again(self) -> "ViewerScene":
        return ViewerScene(self.folder, self.first, self.threads)

    def beside(self, name: str) -> "ViewerScene":
        """Open another scene of the results folder; raise SettingsError if it has no such scene."""
        if name not in (known := scenes_in(self.results)):  # reject anything but listed names, such as paths
            raise SettingsError(f"{self.results} has no scene {name!r}", expected=nearest(name, known))
        return ViewerScene(self.results / name, self.first, self.threads)

    def listed(self) -> list[dict[str, Any]]:
        """Return name, state and date of each scene of the results folder, and whether it can be shown."""
        scenes = []
        for name in scenes_in(self.results):
            folder = self.results / name
            try:
                state = SceneState.read(folder)
                told = {"state": state.state, "date": state.date}
            except HilsplatError as error:
                told = {"state": first_line(error), "date": ""}
            can_open = (folder / self.ply.name).is_file()
            scenes.append({"name": name, **told, "can_open": can_open, "current": folder == self.folder})
        return scenes

    def news(self) -> dict[str, Any]:
        names = dict.fromkeys(list(self._variants), version_of(self.folder / FILE))
        return {**super().news(), "variants": self.variants, "names": names}

    @property
    def variants(self) -> list[str]:
        """Variants that currently accept queries, the initially selected variant first."""
        names = finished_variants(self.folder)
        return sorted(names, key=lambda name: (name != self.first, name != "default", name))

    def answering(self, variant: str) -> LanguageScene:
        """Return a variant, which is opened on first use and reopened once its field exists.

        Raises:
            SettingsError: the variant does not exist (yet).
            StaleSceneError: the variant must be opened, but a previously opened part was rewritten.
            HilsplatError: a part cannot be opened.
        """
        field = self.folder / variant / "field.safetensors"
        known = self._variants.get(variant)
        is_new = known is not None and known[1].decoded_field is None and field.exists()
        if known is None or (is_new and FinishedScene.locate(self.folder, variant).parts != known[0]):
            if variant not in self.variants:  # reject anything but listed names, such as paths
                raise SettingsError(
                    f"variant {variant!r} cannot be queried here",
                    expected=", ".join(self.variants) or "none yet: the scene isn't finished",
                )
            with self.unchanged():
                finished = FinishedScene.locate(self.folder, variant)
                self.note(finished.parts.as_inputs().values())
                scene = LanguageScene.of(finished, threads=self.threads, opened=self.opened)
            if len(scene.tree) > MAX_NODES:
                raise ArtifactError(
                    f"the semantic tree {finished.parts.semantic_tree} is too large for the page",
                    expected=f"at most {MAX_NODES} nodes",
                    found=f"{len(scene.tree)}",
                    fix="query the scene with hilsplat query, or raise semantic_tree.min_views",
                )
            known = finished.parts, scene
        parts, scene = known
        if scene.names.version != version_of(self.folder / FILE):  # another variant, or another program
            with self.unchanged():  # otherwise nodes of the opened tree could get names of a rebuilt one
                scene = replace(scene, names=read_names(self.folder, parts.semantic_tree))
        self._variants[variant] = parts, scene
        return scene

    def parts(self, variant: str) -> SceneParts:
        return self._variants[variant][0]

    def described(self) -> dict[str, Any]:
        state = {"variants": self.variants, "of": self.state}
        state["gaussians_sha256"] = self.splats_tag
        state["restart"] = shlex.join(["hilsplat", "view", str(self.folder)])
        return payload.described_scene(self.scene, self.gaussians) | state

    def described_variant(self, variant: str) -> dict[str, Any]:
        """Describe a variant: its nodes, in row order, and the models of its masks and vectors."""
        scene, parts = self.answering(variant), self.parts(variant)
        with self.unchanged():
            models = {"clip": Path(read_index(parts.clip)["model"]).name, "masks": masks_label(parts.masks)}
            tree = tree_digest(parts.semantic_tree)[:16]
        outline = {"variant": variant, "tree": tree, **payload.described_nodes(scene)}
        return {**outline, **models, "caution": scene.caution}

    @cached_property
    def order(self) -> np.ndarray:
        """Rows of the Gaussians, in the order in which the page loads them."""
        return payload.arrival_order(self.gaussians)

    @cached_property
    def _bits(self) -> int:
        return fractional_bits(self.gaussians)

    def chunk(self, number: int) -> bytes:
        """Return a chunk of the Gaussians as SPZ; raise SettingsError if there is no such chunk."""
        num_chunks = -(-len(self.gaussians) // payload.CHUNK)
        if number >= num_chunks:
            raise SettingsError(f"chunk {number} does not exist", expected=f"0 to {num_chunks - 1}")
        return self.spz(self.order[number * payload.CHUNK : (number + 1) * payload.CHUNK])

    def marked(self, bits: str) -> Bool[np.ndarray, " N"]:
        """Return which rows of `gaussians.ply` the page marks; raise SettingsError if the bits do not fit."""
        count = len(self.gaussians)
        packed = rows_of(bits, 1, -(-count // 8)).ravel()
        marked = np.zeros(count, np.bool_)
        marked[self.order] = np.unpackbits(packed, count=count, bitorder="little")
        return marked

    def bits_of(self, marked: Bool[np.ndarray, " N"]) -> bytes:
        """Return one bit for each Gaussian in the page's order, the inverse of `marked` before base64."""
        return np.packbits(marked[self.order], bitorder="little").tobytes()

    def kept_rows(self, removed: str) -> np.ndarray:
        """Return the rows of the Gaussians that remain, in the page's order; raise SettingsError if none."""
        rows = self.order[~self.marked(removed)[self.order]]
        if not len(rows):
            raise SettingsError("every Gaussian is removed", fix="undo, or restore some Gaussians")
        return rows

    def _remaining(self, removed: str) -> Gaussians:
        """Return all Gaussians, removed ones invisible: rows keep their numbers."""
        return faded(self.gaussians, ~self.marked(removed)) if removed else self.gaussians

    def spz(self, rows: np.ndarray) -> bytes:
        return spz_bytes(self.gaussians, rows, self._bits)

    @cached_property
    def splats_tag(self) -> str:
        """Digest of the Gaussians, for the browser's cache."""
        with self.unchanged():
            return self.opened.get(sha256_of_file, self.ply)[:32]

    def _field_relevancy(self, variant: str, text: str, level: str) -> UInt8[np.ndarray, " N"]:
        """Return `FieldAnswers.gaussian_relevancy`, in steps of 1/255."""
        return to_uint8(self.answering(variant).field.gaussian_relevancy(text, level))

    def _paint(self, variant: str, style: Style) -> Paint | None:
        """Resolve a style for each Gaussian; None means the scene's own colours.

        Raises:
            SettingsError: the style does not fit the tree.
        """
        if style.table or style.ramp:
            scene = self.answering(variant)
            relevancy = self.field_relevancy(variant, style.text, style.level) if style.ramp else None
            paint = Paint.of(style, scene.tree.node_of_gaussian, len(scene.tree), relevancy)
        elif style.marked:
            paint = Paint.plain(len(self.gaussians))
        else:
            return None
        return paint.marking(self.marked(style.marked)) if style.marked else paint

    def warm_up(self) -> None:
        """Compile the loops of rendering, picking and masks before the page opens."""
        camera = self.scene.cameras[self.scene.cameras.names[0]].scaled((8, 8))
        painted(self.gaussians, camera, None, self.threads)
        pick(self.gaussians, None, camera, 4.0, 4.0, self.threads)
        weights = pixel_weights(self.gaussians, camera, min_weight=0.0, threads=self.threads)
        node = np.zeros(len(self.gaussians), np.int32)  # one node, because the tree may not exist yet
        ViewNodes.of(normalised_weights(weights), node).mask(np.ones(1, np.bool_))
        if self.first in self.variants:
            try:
                self.answering(self.first)
            except HilsplatError as error:  # the page can still show the Gaussians
                logger.warning("the scene cannot be queried: %s", error)
