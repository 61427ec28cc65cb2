"""A flat world of coloured blocks whose tree, field and annotations are exact."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse as sp

from hilsplat.base.images import write_png
from hilsplat.base.levels import LEVELS, Level
from hilsplat.datasets.hierarchy import AnnotatedNode, HierarchyAnnotations, write_hierarchy
from hilsplat.scene.scene import Scene
from hilsplat.settings import EvaluateSettings
from tests.unit.evaluate.builders import box, cameras_of, masks_of
from tests.unit.round_gaussians import round_gaussians

SIDE_PX = 64
BLOCK_PX = 2
NODES = (  # text, level, parent, rows, columns
    ("bear", 1, -1, (8, 56), (8, 40)),
    ("chest", 1, -1, (32, 56), (44, 60)),
    ("head", 2, 0, (8, 24), (12, 36)),
    ("lid", 2, 1, (32, 40), (44, 60)),
    ("nose", 3, 2, (14, 22), (20, 28)),
)
TEXTS = tuple(node[0] for node in NODES)


def region(row):
    """True region of a node."""
    return box(*NODES[row][3:], (SIDE_PX, SIDE_PX))


def encode_texts(texts):
    """A text is its own axis; canonical phrases share one that no node has."""
    vectors = np.zeros((len(texts), 8), np.float32)
    for row, text in enumerate(texts):
        vectors[row, TEXTS.index(text) if text in TEXTS else 7] = 1
    return vectors


@pytest.fixture(scope="session")
def block_world(tmp_path_factory):
    """Folder of a finished scene, its annotations, and the opened scene."""
    from hilsplat.base.artifacts import write_index
    from hilsplat.field.code import Autoencoder, LanguageField
    from tests.unit.assembled_scene import assembled
    from tests.unit.evaluate.plain_tree import plain_tree

    class Uncoded(Autoencoder):
        """Latents are the CLIP vectors themselves."""

        def decode_array(self, latents):
            return np.asarray(latents, np.float32)

    folder = tmp_path_factory.mktemp("blocks")
    labels = {level: np.full((SIDE_PX, SIDE_PX), -1, np.int32) for level in LEVELS}
    for row, (_, level, *_) in enumerate(NODES):
        labels[Level(level)][region(row)] = row
    image = np.full((SIDE_PX, SIDE_PX, 3), 90, np.uint8)
    for row in range(len(NODES)):
        image[region(row)] = np.random.default_rng(row).integers(60, 255, 3)
    pose = np.eye(4)
    pose[2, 3] = 2.0
    K = np.array([[60.0, 0, 32], [0, 60.0, 32], [0, 0, 1]])
    cameras = cameras_of([pose, pose], K, (SIDE_PX, SIDE_PX))
    for view in cameras.names:
        write_png(folder / "scene" / "images" / view, image)
    split, points = {"000.png": "train", "001.png": "test"}, np.zeros((0, 3), np.float32)
    points_and_colours = points, points.astype(np.uint8)
    scene = Scene(
        folder / "scene", "synthetic/blocks", "metre", cameras, split, *points_and_colours, np.eye(4)
    )
    scene.save()
    nodes = [AnnotatedNode(row, level, parent, text) for row, (text, level, parent, *_) in enumerate(NODES)]
    write_hierarchy(folder / "truth", nodes, {"001.png": labels}, {"001.png": range(len(NODES))})
    regions, ones = np.stack(list(map(region, range(len(NODES))))), np.ones(len(NODES), np.float32)
    levels = [node[1] for node in NODES]
    masks_of(regions, levels).save(folder / "masks" / "000.png.npz")
    write_index(folder / "clip", {"000.png": {}}, model="models/clip-tiny")
    write_index(folder / "masks", {"000.png": {}}, segmenter="sam", model="models/sam-tiny")

    blocks = SIDE_PX // BLOCK_PX
    ys, xs = np.divmod(np.arange(SIDE_PX**2), SIDE_PX)
    block_of_pixel = (ys // BLOCK_PX) * blocks + xs // BLOCK_PX
    weights = sp.csr_matrix(np.eye(blocks**2, dtype=np.float32)[block_of_pixel])
    middle = BLOCK_PX * np.stack(np.divmod(np.arange(blocks**2), blocks)).T + BLOCK_PX // 2
    node_of_gaussian = np.stack([labels[level][middle[:, 0], middle[:, 1]] for level in LEVELS], axis=1)
    clip = encode_texts(TEXTS)
    features = np.where((node_of_gaussian >= 0)[..., None], clip[node_of_gaussian], 0).astype(np.float32)
    means = np.stack([middle[:, 1] / 32 - 1, middle[:, 0] / 32 - 1, np.zeros(len(middle))], axis=1)
    colours = (image[middle[:, 0], middle[:, 1]] / 255 - 0.5) / 0.282
    plain = round_gaussians(means, log_scale=-4.0, opacity_logit=3.0)
    gaussians = replace(plain, sh=colours.astype(np.float32)[:, None])
    masks = np.arange(len(NODES), dtype=np.int32)
    tree = plain_tree(
        levels,
        [node[2] for node in NODES],
        node_of_gaussian,
        clip=clip,
        node_of_mask=masks,
        linked_node=masks,
        crop_score=ones,
        crop_rank=np.zeros(len(NODES), np.int32),
        view_area_px=regions.sum(axis=(1, 2), dtype=np.float32)[:, None],
    )
    field = LanguageField(features, "0", "0"), Uncoded(8, 8, {})
    answers = assembled(scene, gaussians, tree, lambda view: weights, encode_texts, field)
    annotations = HierarchyAnnotations.load(folder / "truth")
    return SimpleNamespace(folder=folder, scene=scene, annotations=annotations, answers=answers)


@pytest.fixture
def opened(block_world, monkeypatch):
    """Parts of the block world, its truth, and the evaluate stage."""
    from hilsplat.evaluate import stage
    from hilsplat.evaluate.figures import panel
    from hilsplat.evaluate.scores import read_scores
    from hilsplat.scene.finished import SceneParts

    answers, folder = block_world.answers, block_world.folder

    def from_parts(_, settings, **__):
        return replace(answers, settings=settings, decoded_field=replace(answers.field, settings=settings))

    for module in (stage, panel):
        monkeypatch.setattr(module, "LanguageScene", SimpleNamespace(from_parts=from_parts))
    names = ("scene", "gaussians", "semantic_tree", "field", "autoencoder", "clip", "masks")
    parts = SceneParts(**{name: folder / name for name in names})

    def evaluate(out, settings=None, **changes):
        given = {"dataset": "synthetic", "scene": "blocks", "truth": folder / "truth", **changes}
        stage.run_evaluate(parts, out, settings or EvaluateSettings(), **given)
        return read_scores([out])

    return SimpleNamespace(parts=parts, truth=folder / "truth", evaluate=evaluate)
