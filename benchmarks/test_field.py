"""Timings of queries on tree and field, mask linkage and the solver, on synthetic scenes of known size.

Queries use a scene of 200,000 Gaussians in front of one camera of 986 x 728 px, divided into blocks that
are the nodes of three levels, with CLIP vectors of 512 numbers. The view is rendered and the text embedded
before the timing, because the time to embed a text depends on the model.
"""

import sys
import time
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
import torch

from benchmarks.goals import Goal
from benchmarks.scenes import random_scene
from hilsplat.base.levels import LEVELS
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.contributions.quadratic import StackedWeights
from hilsplat.field.autoencoder import train_autoencoder
from hilsplat.field.code import Code, LanguageField, LinearCode
from hilsplat.field.problem import QuadraticProblem, conjugate_gradient
from hilsplat.query.language_scene import LanguageScene
from hilsplat.scene.cameras import Cameras
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.linkage import mask_evidence, pooled_linkage
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.semantic_tree.view_pairs import view_pairs
from hilsplat.settings import AutoencoderSettings
from hilsplat.splat.rasterise.api import pixel_weights
from tests.unit.assembled_scene import assembled

IS_TIMED = "--benchmark-disable" not in sys.argv  # otherwise, a small scene suffices
SIZE_HW, GAUSSIANS = ((728, 986), 200_000) if IS_TIMED else ((91, 123), 5000)
BLOCKS = ((6, 8), (12, 16), (24, 32))  # rows and columns of nodes at each level: 48, 192 and 768 nodes
CHANNELS = 512
VIEW = "view"
one_thread = pytest.mark.benchmark(timer=time.process_time, min_rounds=5, max_time=1.5)


def unit(vectors: np.ndarray) -> np.ndarray:
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


@cache
def open_scene(code_name: str, threads: int = 1) -> LanguageScene:
    """Return a scene whose latents have three numbers (network) or sixteen (pca)."""
    gaussians, camera = random_scene(GAUSSIANS, SIZE_HW, sh_degree=0)
    rng = np.random.default_rng(0)
    projected = gaussians.means @ camera.K.T
    x, y = (projected[:, k] / projected[:, 2] / SIZE_HW[1 - k] for k in (0, 1))
    node_of_gaussian = np.zeros((len(gaussians), 3), np.int32)
    level, parent, first = [], [], 0
    for index, (down, across) in enumerate(BLOCKS):
        row, column = (np.clip(v * n, 0, n - 1).astype(int) for v, n in ((y, down), (x, across)))
        node_of_gaussian[:, index] = first + row * across + column
        above = BLOCKS[index - 1]
        for r in range(down):
            for c in range(across):
                level.append(index + 1)
                parent.append(-1 if not index else first - above[0] * above[1] + r // 2 * above[1] + c // 2)
        first += down * across
    kinds = rng.normal(size=(40, CHANNELS))
    clip = unit(kinds[rng.integers(0, 40, first)] + 0.5 * rng.normal(size=(first, CHANNELS)))
    code: Code
    if code_name == "pca":
        code = LinearCode.fit(clip, 16)
    else:
        settings = AutoencoderSettings(latent=3, epochs=1, min_steps=1000)
        code = train_autoencoder(clip, settings, 0)
    features = code.encode_array(clip)[node_of_gaussian]
    num = first
    tree = SemanticTree(
        level=np.array(level, np.uint8),
        parent=np.array(parent, np.int32),
        clip=clip,
        centroid=np.zeros((num, 3), np.float32),
        box=np.zeros((num, 2, 3), np.float32),
        oriented_box=np.zeros((num, 5, 3), np.float32),
        quality=np.ones(num, np.float32),
        views=np.ones(num, np.int32),
        node_of_gaussian=node_of_gaussian,
        membership=np.ones((len(gaussians), 3), np.float32),
        node_of_mask=np.zeros(0, np.int32),
        linked_node=np.zeros(0, np.int32),
        crop_score=np.zeros(0, np.float32),
        crop_rank=np.zeros(0, np.int32),
        view_area_px=np.ones((num, 1), np.float32),
        view_names=(VIEW,),
        gaussians_sha256="",
        cameras_sha256="",
        min_weight=1 / 255,
    )
    cameras = Cameras((VIEW,), np.eye(4)[None], camera.K[None], np.array([SIZE_HW], np.int32))
    nothing = np.zeros((0, 3), np.float32)
    scene = Scene(
        Path(), "made/up", "metre", cameras, {VIEW: "train"}, nothing, nothing.astype(np.uint8), np.eye(4)
    )
    weights = pixel_weights(gaussians, camera, min_weight=1 / 255)

    def encode(texts: Sequence[str]) -> np.ndarray:
        return unit(np.stack([np.random.default_rng(len(t)).normal(size=CHANNELS) for t in texts]) + kinds[7])

    field = LanguageField(features, "", ""), code
    opened = assembled(scene, gaussians, tree, lambda view: weights, encode, field, threads=threads)
    opened.node_relevancy_map(["mug handle"], VIEW)
    return opened


@one_thread
def test_query_on_the_tree(benchmark):
    scene = open_scene("network")
    benchmark.extra_info |= {"case": TREE_QUERY, "count": len(scene.tree), "of": "nodes"}
    assert benchmark(lambda: scene.query("mug handle", level="auto"))


@one_thread
def test_path_query_on_the_tree(benchmark):
    scene = open_scene("network")
    benchmark.extra_info |= {"case": "path query of three texts on the tree"}
    assert benchmark(lambda: scene.query("mug > mug handle > rim"))


@one_thread
def test_mask_of_an_answer(benchmark):
    scene = open_scene("network")
    ids = scene.select("mug handle", level="subpart", threshold=0.5).ids
    benchmark.extra_info |= {"case": MASK, "count": SIZE_HW[0] * SIZE_HW[1], "of": "px"}
    assert benchmark(lambda: scene.views.node_masks(VIEW, ids)).shape == SIZE_HW


@one_thread
def test_relevancy_of_nodes_in_a_view(benchmark):
    scene = open_scene("network")
    benchmark.extra_info |= {"case": MAPS, "count": 3 * SIZE_HW[0] * SIZE_HW[1], "of": "px"}
    assert benchmark(lambda: scene.node_relevancy_map(["mug handle"], VIEW)).shape == (1, 3, *SIZE_HW)


@one_thread
@pytest.mark.parametrize("code", ["network", "pca"])
def test_query_on_the_field(benchmark, code):
    scene = open_scene(code)
    benchmark.extra_info |= {"case": field_case(code), "count": 3 * SIZE_HW[0] * SIZE_HW[1], "of": "px"}
    scene.field.relevancy(["mug handle"], VIEW, exact=False)  # renders and decodes once per view
    assert benchmark(lambda: scene.field.relevancy(["mug handle"], VIEW, exact=False)).max() > 0


@pytest.mark.benchmark(timer=time.process_time, min_rounds=3, max_time=1.5)
def test_relevancy_that_decodes_every_pixel(benchmark):
    scene, count = open_scene("network"), 3 * SIZE_HW[0] * SIZE_HW[1]
    benchmark.extra_info |= {"case": "exact relevancy, 986x728: network, d=3", "count": count, "of": "px"}
    assert benchmark(lambda: scene.field.relevancy(["mug handle"], VIEW)).max() > 0


@pytest.mark.benchmark(min_rounds=5, max_time=1.5)
@pytest.mark.parametrize("code", ["network", "pca"])
def test_query_on_the_field_by_two_threads(benchmark, code):
    scene = open_scene(code, threads=2)
    case = f"{field_case(code)}, 2 threads"
    benchmark.extra_info |= {"case": case, "count": 3 * SIZE_HW[0] * SIZE_HW[1], "of": "px"}
    scene.field.relevancy(["mug handle"], VIEW, exact=False)
    assert benchmark(lambda: scene.field.relevancy(["mug handle"], VIEW, exact=False)).max() > 0


@one_thread
def test_linkage_of_a_synthetic_scene(benchmark):
    """Link 3,000 masks: 25 regions per level in 40 views, each showing half of 60,000 Gaussians."""
    rng = np.random.default_rng(0)
    region = rng.integers(0, 25, 60_000)
    view = np.repeat(np.arange(40, dtype=np.int32), 25)
    visible = rng.random((40, 60_000)) < 0.5
    rows, columns = [], []
    for number in range(40):
        seen = np.flatnonzero(visible[number])
        rows.append(25 * number + region[seen])
        columns.append(seen)
    row, column = np.concatenate(rows), np.concatenate(columns)
    shares = sp.csr_matrix((rng.uniform(0.3, 1, len(row)), (row, column)), shape=(1000, 60_000))
    visible = sp.csr_matrix(visible)

    def link_three_levels() -> int:
        num_nodes = 0
        for _ in LEVELS:
            evidence = mask_evidence(shares, np.ones(60_000), visible, view, view_pairs(visible), 0.2)
            num_nodes += pooled_linkage(evidence, 0.3)()[0].max() + 1
        return num_nodes

    benchmark.extra_info |= {"case": LINKAGE, "count": 3000, "of": "masks"}
    assert benchmark.pedantic(link_three_levels, rounds=3) == 75


@one_thread
def test_conjugate_gradient(benchmark):
    """Run ten steps on the quadratic part: 60,000 Gaussians, d = 8, W of eight views of 256 px."""
    gaussians, camera = random_scene(60_000, (256, 256), sh_degree=0)
    W = sp.vstack([pixel_weights(gaussians, camera, min_weight=1 / 255)] * 8, format="csr")
    labels = np.random.default_rng(0).integers(0, 30, (W.shape[0], 3)) + np.array([0, 30, 60])
    rows = np.arange(W.shape[0])
    B = sum(sp.csr_matrix((np.ones(len(rows)), (labels[:, k], rows)), (90, len(rows))) for k in range(3))
    n = np.asarray(B.sum(axis=1)).ravel().astype(np.float32)
    A = sp.csr_matrix(sp.diags(1 / n) @ B @ W, dtype=np.float32)
    latents = unit(np.random.default_rng(1).normal(size=(90, 8)))
    masks = MaskOperator(A, np.repeat(np.array([1, 2, 3], np.uint8), 30))
    quadratic = StackedWeights(W, np.ones((W.shape[0], 3), bool))
    problem = QuadraticProblem.of(masks, quadratic, n, latents, (1.0, 0.3, 0.1))
    benchmark.extra_info |= {"case": "ten steps of conjugate gradient", "count": 30 * W.nnz, "of": "weights"}
    solved = benchmark.pedantic(lambda: conjugate_gradient(problem, 10), rounds=3)
    assert torch.isfinite(torch.from_numpy(solved)).all()


TREE_QUERY = "query on the tree, 1008 nodes, level auto"
MASK = "mask of an answer, 986x728"
MAPS = "relevancy of nodes at three levels, 986x728"
LINKAGE = "evidence and linkage, 40 views, 3000 masks"


def field_case(code: str) -> str:
    """Return the name of a field query case."""
    size = "d=3, network" if code == "network" else "d=16, pca"
    return f"query on the field at three levels, {size}, 986x728"


GOALS = [
    Goal("query on the tree", "ms", 5, lambda t: t[TREE_QUERY]),
    Goal("the same with a mask of a 986x728 view", "ms", 35, lambda t: t[TREE_QUERY] + t[MASK]),
    Goal("the same with its relevancy at three levels", "ms", 35, lambda t: t[TREE_QUERY] + t[MAPS]),
    Goal("query on the field, linear code, three levels", "ms", 30, lambda t: t[field_case("pca")]),
    Goal("the same, network", "ms", 30, lambda t: t[field_case("network")]),
    Goal("linkage of 3000 masks", "ms", 5000, lambda t: t[LINKAGE]),
]
