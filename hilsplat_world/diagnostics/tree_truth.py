"""Fit of the 3D semantic tree to the nodes of a synthetic world, measured over Gaussians."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Int32
from scipy.optimize import linear_sum_assignment

from hilsplat.base.levels import LEVELS, NONE, Level
from hilsplat.base.tables import markdown_table, write_csv
from hilsplat.contributions.compositing import normalised_weights
from hilsplat.datasets.hierarchy import HierarchyAnnotations
from hilsplat.scene.scene import Scene
from hilsplat.semantic_tree.tree import SemanticTree
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.api import pixel_weights

MATCH_IOU = 0.5
COLUMNS = (
    *("scene", "level", "nodes", "true_nodes", "precision", "recall", "mean_iou", "purity"),
    *("parent_accuracy", "view_consistency"),
)


@dataclass(frozen=True)
class TreeMeasure:
    """Results for one level of a tree."""

    nodes: int
    true_nodes: int  # number of ground-truth nodes that have any Gaussian
    precision: float  # share of nodes matched one to one with a true node at IoU 0.5
    recall: float  # share of true nodes matched
    mean_iou: float  # mean over true nodes of the matched node's IoU, 0 if unmatched
    purity: float  # share of the nodes' mass that is in the true node that each overlaps most
    parent_accuracy: float  # share of matches whose parent overlaps the true parent most; nan if no parents
    view_consistency: float  # mean pooled IoU of the nodes' masks across views
    pairs: tuple[tuple[int, int], ...] = ()  # (matched node, its true node)


def measure_tree(
    tree: SemanticTree, votes: Float[np.ndarray, "N t"], truth: HierarchyAnnotations
) -> dict[Level, TreeMeasure]:
    """Compare the tree's nodes with ground-truth ("true") nodes.

    At each level, a Gaussian belongs to the true node that has most of its visible weight, and is weighted by
    its total weight in labelled pixels. `votes` is the visible weight of each Gaussian in each true node.
    """
    true_level = np.array([node.level for node in truth.nodes])
    true_parent = np.array([node.parent for node in truth.nodes])
    overlaps: dict[Level, np.ndarray] = {}
    main_of = np.full(len(tree), NONE)
    for level in LEVELS:
        ids = np.flatnonzero(true_level == int(level))
        own_votes = votes[:, ids]
        mass = own_votes.sum(axis=1)
        true_of = np.where(mass > 0, ids[own_votes.argmax(axis=1)] if len(ids) else NONE, NONE)
        node_of = tree.node_of_gaussian[:, level.index]
        counted = (true_of != NONE) | (node_of != NONE)
        weight = np.where(mass > 0, mass, 0.0)[counted]
        # The last row and column mean "no node", so that missed Gaussians count in the unions.
        rows = np.where(node_of[counted] == NONE, len(tree), node_of[counted])
        columns = np.where(true_of[counted] == NONE, len(truth.nodes), true_of[counted])
        shape = (len(tree) + 1, len(truth.nodes) + 1)
        overlaps[level] = sp.csr_matrix((weight, (rows, columns)), shape=shape).toarray()
        nodes = tree.nodes_of(level)
        inside = overlaps[level][nodes][:, :-1]
        if inside.size:
            main_of[nodes] = np.where(inside.max(axis=1) > 0, inside.argmax(axis=1), NONE)

    measures = {}
    for level in LEVELS:
        overlap, nodes = overlaps[level], tree.nodes_of(level)
        ids = np.flatnonzero((true_level == int(level)) & (overlap[:, :-1].sum(axis=0) > 0))
        intersection = overlap[np.ix_(nodes, ids)]
        union = overlap[nodes].sum(axis=1)[:, None] + overlap[:, ids].sum(axis=0)[None] - intersection
        iou = intersection / np.maximum(union, 1e-12)
        row, column = linear_sum_assignment(-iou)
        good = iou[row, column] > MATCH_IOU
        matched, partner = nodes[row[good]], ids[column[good]]
        has_parent = true_parent[partner] != NONE
        parent = tree.parent[matched[has_parent]]
        parent_main = np.where(parent != NONE, main_of[np.maximum(parent, 0)], NONE)
        right = parent_main == true_parent[partner[has_parent]]
        size = overlap[nodes].sum()
        measures[level] = TreeMeasure(
            nodes=len(nodes),
            true_nodes=len(ids),
            precision=float(good.sum() / max(len(nodes), 1)),
            recall=float(good.sum() / max(len(ids), 1)),
            mean_iou=float(iou[row, column].sum() / max(len(ids), 1)),
            purity=float(overlap[nodes][:, :-1].max(axis=1).sum() / max(size, 1e-12)) if len(nodes) else 0.0,
            parent_accuracy=float(right.mean()) if len(right) else float("nan"),
            view_consistency=float(tree.quality[nodes].mean()) if len(nodes) else 0.0,
            pairs=tuple(zip(matched.tolist(), partner.tolist(), strict=True)),
        )
    return measures


def true_votes(
    scene: Scene,
    gaussians_ply: Path,
    truth: HierarchyAnnotations,
    views: Iterable[str],
    min_weight: float,
    threads: int,
) -> Float[np.ndarray, "N t"]:
    """Return the visible weight of each Gaussian in each true node over the views."""
    gaussians = load_ply(gaussians_ply)
    votes = np.zeros((len(gaussians), len(truth.nodes)))
    for view in views:
        raw = pixel_weights(gaussians, scene.cameras[view], min_weight=min_weight, threads=threads)
        weights = normalised_weights(raw).astype(np.float64)
        for level in LEVELS:
            labels: Int32[np.ndarray, " P"] = truth.label_image(view, level).reshape(-1)
            labelled = np.flatnonzero(labels >= 0)
            one = sp.csr_matrix(
                (np.ones(len(labelled)), (labelled, labels[labelled])), shape=(len(labels), len(truth.nodes))
            )
            votes += (weights.T @ one).toarray()
    return votes


def run_tree_truth(
    scene_folder: Path, gaussians_ply: Path, semantic_tree: Path, truth: Path, out: Path, threads: int
) -> str:
    """Measure a tree, write a CSV with one row per level and return it as a Markdown table."""
    scene, annotations = Scene.load(scene_folder), HierarchyAnnotations.load(truth)
    tree = SemanticTree.load(semantic_tree)
    votes = true_votes(scene, gaussians_ply, annotations, scene.views("train"), tree.min_weight, threads)
    rows = []
    for level, measure in measure_tree(tree, votes, annotations).items():
        values = [getattr(measure, name) for name in COLUMNS[2:]]
        texts = [str(value) if isinstance(value, int) else f"{value:.4f}" for value in values]
        rows.append([scene.name, level.label, *texts])
    write_csv(out, COLUMNS, rows)
    return markdown_table(COLUMNS, rows, 2)
