"""The sparse solver against dense algebra and autograd, and the stage."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from scipy.optimize import minimize

from hilsplat.base.arrays import Scratch
from hilsplat.base.artifacts import read_index, read_json, write_index
from hilsplat.base.errors import MemoryLimitError, MisalignedArtifactError, SettingsError
from hilsplat.base.levels import LEVELS
from hilsplat.baselines import HiLSplatSettings
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.contributions.quadratic import StackedWeights
from hilsplat.contributions.quadratic_builder import GramBuilder
from hilsplat.contributions.rows import Contributions
from hilsplat.contributions.view_matrices import painted_indicator
from hilsplat.field.autoencoder import run_autoencoder
from hilsplat.field.code import LanguageField, load_latents
from hilsplat.field.contrast import Contrast, ViewRelations, distinct, read_parents, view_relations
from hilsplat.field.field import field_losses, run_field
from hilsplat.field.problem import QuadraticProblem, conjugate_gradient
from hilsplat.field.solver import dot, keep_labelled, solve_field
from hilsplat.methods import method
from hilsplat.methods.langsplat import HierarchyTerms, MaskHalves
from hilsplat.methods.method import LabelledView, MethodInputs, run_method
from hilsplat.semantic_tree.build import run_semantic_tree
from hilsplat.settings import AutoencoderSettings, FieldSettings, SemanticTreeSettings
from tests.unit.field.torch_losses import instance_term, part_term
from tests.unit.round_gaussians import round_gaussians
from tests.unit.two_boxes_world import reverse_masks, two_boxes_weights

PIXELS, GAUSSIANS, CHANNELS = 60, 12, 2
PARENT = np.array([-1] * 3 + [0, 0, 1] + [3, 4, 4], np.int32)
NO_PLACES = np.zeros((PIXELS, 2), np.int64)


class Toy:
    """One view with three masks a level on 60 pixels and 12 Gaussians, and its dense matrices."""

    def __init__(self, weights: tuple[float, float, float]) -> None:
        rng = np.random.default_rng(0)
        dense = rng.random((PIXELS, GAUSSIANS)) * (rng.random((PIXELS, GAUSSIANS)) < 0.4)
        dense[:, 0] += 0.01  # no empty row
        dense[:, 5] = 0  # an unseen Gaussian
        self.W = (dense / dense.sum(axis=1, keepdims=True)).astype(np.float32)
        self.labels = rng.integers(-1, 3, (PIXELS, 3)) + np.array([0, 3, 6])
        self.labels[rng.random((PIXELS, 3)) < 0.2] = -1
        self.labels[self.labels == np.array([-1, 2, 5])] = -1
        self.level = np.repeat(np.array([1, 2, 3], np.uint8), 3)
        labels = self.labels.astype(np.int32)
        self.painted = painted_indicator(labels, 9, np.ones(PIXELS, bool))
        self.in_half = rng.random(PIXELS) < 0.5
        self.half = painted_indicator(labels, 9, self.in_half)
        self.pixels = np.asarray(self.painted.sum(axis=1)).ravel().astype(np.float32)
        self.half_pixels = np.asarray(self.half.sum(axis=1)).ravel().astype(np.float32)
        self.A = (sp.diags(1 / self.pixels) @ self.painted @ self.W).astype(np.float32)
        self.A_half = (sp.diags(1 / self.half_pixels) @ self.half @ self.W).astype(np.float32)
        self.latents = rng.normal(size=(9, CHANNELS)).astype(np.float32)
        self.problem = QuadraticProblem.of(
            MaskOperator(sp.csr_matrix(self.A), self.level),
            StackedWeights(sp.csr_matrix(self.W), self.labels >= 0),
            self.pixels,
            self.latents,
            weights,
        )
        self.features = rng.normal(size=(GAUSSIANS, 3, CHANNELS)).astype(np.float32)

    def contrast(self, settings: FieldSettings) -> Contrast:
        relations = ViewRelations(
            np.arange(9),
            np.zeros((9, 9), np.int64),
            self.level.astype(np.int64),
            tuple((np.arange(begin, begin + 3), PARENT[begin:][:3].astype(np.int64)) for begin in (3, 6)),
        )
        half = MaskOperator(sp.csr_matrix(self.A_half), self.level)
        return Contrast(self.problem.masks, half, self.pixels, self.half_pixels, [relations], settings)

    def terms(self, settings: HiLSplatSettings) -> HierarchyTerms:
        """The losses of the trainer."""
        view = LabelledView(0, np.arange(9), sp.csr_matrix(self.W), self.labels.astype(np.int32), NO_PLACES)
        halves = MaskHalves.of(view, self.in_half, self.level, PARENT, self.latents, settings)
        return HierarchyTerms([halves], settings, int(self.pixels.sum()), 1, 2)


def dense_system(toy: Toy, weights: tuple[float, float, float], index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix and the right side of a level's quadratic losses."""
    language, clustering, ridge = weights
    valid, rows = toy.labels[:, index] >= 0, toy.level == index + 1
    W, A = toy.W[valid].astype(np.float64), toy.A[rows].astype(np.float64)
    mass, n = np.diag(W.sum(axis=0)), np.diag(toy.pixels[rows].astype(np.float64))
    hessian = (language + clustering) * W.T @ W - clustering * A.T @ n @ A + ridge * mass
    return hessian, language * A.T @ n @ toy.latents[rows] + ridge * mass @ toy.problem.lifted[:, index]


@pytest.mark.parametrize("blocks", [((0, 12),), ((0, 4), (4, 8), (8, 12))])
@pytest.mark.parametrize("stored", ["weights", "gram"])
def test_each_block_reaches_its_dense_solution_with_the_others_fixed(stored, blocks, tmp_path):
    toy = Toy(weights := (1.0, 0.3, 0.1))
    if stored == "gram":
        builder = GramBuilder(GAUSSIANS, 1, Scratch(tmp_path))
        builder.add(toy.problem.quadratic)
        toy.problem = replace(toy.problem, quadratic=builder.finish())
    toy.problem = replace(toy.problem, blocks=blocks)
    settings = FieldSettings(weight_instance=0.0, weight_part=0.0, cg_steps=30)
    solved, report = solve_field(toy.problem, toy.contrast(settings))
    assert report.get("blocks", 1) == len(blocks)
    assert report["after_cg"]["language"] < report["lifted"]["language"]
    for index in range(3):
        hessian, right = dense_system(toy, weights, index)
        expected = toy.problem.lifted[:, index].astype(np.float64)
        for block in (slice(begin, end) for begin, end in blocks):
            expected[block], *_ = np.linalg.lstsq(  # 0 for the unseen Gaussian
                hessian[block, block],
                right[block] - hessian[block] @ expected + hessian[block, block] @ expected[block],
                rcond=None,
            )
        assert solved[:, index] == pytest.approx(expected, abs=2e-5)
    whole = replace(toy.problem, blocks=((0, 12),)).terms(solved)
    assert report["after_cg"] == pytest.approx(whole | toy.contrast(settings).values(solved), rel=1e-5)


def test_contrastive_losses_of_a_block_count_the_other_blocks():
    toy = Toy((1.0, 0.3, 0.1))
    settings = FieldSettings(weight_instance=0.5, weight_part=0.1, cg_steps=30, lbfgs_steps=200)
    contrast = toy.contrast(settings)
    whole, _ = solve_field(toy.problem, contrast)
    # solved again with half of the Gaussians free, these must return to the solution
    free = replace(
        toy.problem,
        masks=contrast.masks.block(0, 6),
        quadratic=toy.problem.quadratic.block(0, 6),
        mass=toy.problem.mass[:6],
        lifted=toy.problem.lifted[:6],
        blocks=((0, 6),),
        others=(toy.problem.quadratic.across(0, 6, whole), contrast.masks.block(6, 12).means(whole[6:])),
    )
    rest = [operator.block(6, 12).means(whole[6:]) for operator in (contrast.masks, contrast.half_masks)]
    of_block = replace(
        contrast, masks=free.masks, half_masks=contrast.half_masks.block(0, 6), others=(rest[0], rest[1])
    )
    solved, _ = solve_field(free, of_block)
    assert solved == pytest.approx(whole[:6], abs=0.02)


def test_a_solved_problem_stays_solved():
    toy = Toy((0.0, 0.0, 1.0))  # only the ridge: the lifted average is the solution
    assert np.array_equal(conjugate_gradient(toy.problem, 3), toy.problem.lifted)


READINGS = pytest.mark.parametrize(
    "readings",
    [
        {"instance_mode": instance, "part_mode": part, "tau": 0.5}
        for instance in ("literal", "coverage_tree")
        for part in ("literal", "disentangle")
    ],
)


@READINGS
def test_contrastive_gradients_equal_autograd_through_the_means(readings):
    toy = Toy((1.0, 0.3, 0.1))
    contrast = toy.contrast(FieldSettings(**readings, weight_instance=0.5, weight_part=0.25))
    terms = contrast.values(toy.features)
    value, gradient = contrast.weighted(toy.features)

    features = torch.from_numpy(toy.features).double().requires_grad_()
    own = [features[:, level - 1] for level in toy.level]
    means, halves = (
        torch.stack([torch.from_numpy(row).double() @ values for row, values in zip(A, own, strict=True)])
        for A in (toy.A.astype(np.float64), toy.A_half.astype(np.float64))
    )
    n, half = (torch.from_numpy(count).double()[:, None] for count in (toy.pixels, toy.half_pixels))
    others = (n * means - half * halves) / (n - half)
    instance_loss = instance_term(means, contrast.relations[0], contrast.settings)
    part_loss = part_term(means, halves, others, contrast.relations[0], contrast.settings)
    assert terms == pytest.approx({"instance": instance_loss.item(), "part": part_loss.item()}, rel=1e-5)
    total = 0.5 * instance_loss + 0.25 * part_loss
    assert value == pytest.approx(total.item(), rel=1e-5)
    (expected,) = torch.autograd.grad(total, features, retain_graph=True)
    assert gradient == pytest.approx(expected.numpy(), abs=1e-5)
    (of_part,) = torch.autograd.grad(part_loss, features)
    part_alone = toy.contrast(FieldSettings(**readings, weight_instance=0.0, weight_part=1.0))
    value, gradient = part_alone.weighted(toy.features)
    assert value == pytest.approx(part_loss.item(), rel=1e-5)
    assert gradient == pytest.approx(of_part.numpy(), abs=1e-5)


def test_the_first_step_of_lbfgs_starts_at_the_conjugate_gradient_and_lowers_the_objective():
    toy = Toy((1.0, 0.3, 0.1))
    weights = {"language": 1.0, "clustering": 0.3, "ridge": 0.1, "instance": 0.5, "part": 0.1}
    settings = FieldSettings(weight_instance=0.5, weight_part=0.1, cg_steps=3, lbfgs_steps=1)
    _, report = solve_field(toy.problem, toy.contrast(settings))
    assert report["after_cg"]["language"] < report["lifted"]["language"]
    before, after = (
        sum(weight * report[phase][name] for name, weight in weights.items())
        for phase in ("after_cg", "after_lbfgs")
    )
    assert after < before
    without = settings.model_copy(update={"weight_instance": 0.0, "weight_part": 0.0})
    assert "after_lbfgs" not in solve_field(toy.problem, toy.contrast(without))[1]


@pytest.mark.parametrize("length", range(9))
def test_dot_products_contain_every_element(length):
    a, b = np.random.default_rng(length).normal(size=(2, length)).astype(np.float32)
    assert dot(a, b) == pytest.approx(math.fsum(a.astype(float) * b.astype(float)), rel=1e-12)


def test_lbfgs_reaches_the_minimum_of_the_whole_objective():
    toy = Toy((1.0, 0.3, 0.1))
    settings = FieldSettings(weight_instance=0.5, weight_part=0.1, cg_steps=0, lbfgs_steps=200)
    contrast, problem = toy.contrast(settings), toy.problem

    def objective(flat: np.ndarray) -> tuple[float, np.ndarray]:
        features = flat.reshape(toy.features.shape).astype(np.float32)
        curved, right = problem.hessian_product(features), problem.right_side()
        value, gradient = contrast.weighted(features)
        value += float((features * (curved - 2 * right)).sum()) / problem.total_pixels
        gradient = gradient + 2 / problem.total_pixels * (curved - right)
        return value, gradient.reshape(-1).astype(np.float64)

    found, _ = solve_field(problem, contrast)
    start = problem.lifted.reshape(-1).astype(np.float64)
    best = minimize(objective, start, jac=True, method="L-BFGS-B", options={"maxiter": 500}).fun
    assert objective(start)[0] > best + 0.01
    assert objective(found.reshape(-1))[0] == pytest.approx(best, abs=2e-3)


def test_gaussians_with_little_labelled_weight_lose_their_latent():
    features = np.ones((3, 3, 2), np.float32)
    mass = np.array([[4, 0.1, 4], [4, 2, 0], [0, 0, 0]], np.float32)
    kept = keep_labelled(features, mass, np.array([4.0, 4.0, 0.0]), 0.5)
    assert kept[..., 0].tolist() == [[1, 0, 1], [1, 1, 0], [0, 0, 0]]
    assert np.array_equal(keep_labelled(features, mass, np.array([4.0, 4.0, 0.0]), 0.0), features)


def test_pruning_drops_similar_unrelated_masks():
    means = np.array([[1, 0], [1, 0.01], [1, 0.02], [0, 1]], np.float32)
    depth = np.zeros((4, 4), np.int64)
    assert distinct(means, depth, 0.95).tolist() == [0, 3]
    depth[0, 1] = depth[1, 0] = 1  # both siblings are kept; the third mask is similar to both
    assert distinct(means, depth, 0.95).tolist() == [0, 1, 3]
    assert distinct(means, depth, 1.0).tolist() == [0, 1, 2, 3]


@READINGS
def test_the_trainer_has_the_gradient_of_the_solver(readings):
    weights = {"weight_clustering": 0.4, "weight_instance": 0.5, "weight_part": 0.25, **readings}
    toy = Toy((1.0, 0.4, 0.0))
    own = HiLSplatSettings(language="squared", pixel_step=1, min_mask_px=1, **weights)
    padded = np.pad(toy.features.transpose(1, 0, 2), ((0, 0), (0, 0), (0, 2)))
    terms, found = toy.terms(own), np.zeros(toy.features.shape)
    for level in LEVELS:
        attraction, offsets = terms.gradient(0, level, padded, num_views=1)
        rows = terms.views[0].labels[:, level.index]
        W = toy.W[rows >= 0].astype(np.float64)
        by_pixel = attraction * W @ toy.features[:, level.index] + offsets[rows[rows >= 0]]
        found[:, level.index] = W.T @ by_pixel
    counts = toy.pixels.astype(np.int64), toy.half_pixels.astype(np.int64)
    relations = view_relations(np.arange(9), toy.level, PARENT, *counts, own, toy.latents)
    contrast = replace(toy.contrast(FieldSettings(**weights)), relations=[relations])
    _, expected = contrast.weighted(toy.features)
    half = toy.problem.hessian_product(toy.features) - toy.problem.right_side()
    assert found == pytest.approx(expected + 2 / toy.problem.total_pixels * half, abs=1e-5)


@pytest.fixture
def boxes_with_latents(two_boxes_contributions):
    world, contributions = two_boxes_contributions
    tree, autoencoder = world.folder / "semantic_tree", world.folder / "autoencoder"
    run_semantic_tree(contributions, world.masks, tree, SemanticTreeSettings())
    quick = AutoencoderSettings(code="network", latent=3, epochs=1, min_steps=100)
    run_autoencoder(world.clip, tree, contributions, autoencoder, quick, 0)
    return world, contributions, autoencoder


SMALL_MASKS = FieldSettings(min_mask_px=4, weight_part=0.003)


def solved_field(boxes, name: str, settings: FieldSettings = SMALL_MASKS, threads: int = 1, **more) -> Path:
    """The field of a run of the stage."""
    world, contributions, autoencoder = boxes
    out = world.folder / name / "field.safetensors"
    run_field(contributions, world.coverage_tree, autoencoder, out, settings, threads, **more)
    return out


def report_of(field: Path) -> dict:
    return read_json(field.with_suffix(".report.json"))


def test_blocks_and_memory_of_the_stage(boxes_with_latents):
    blocks = SMALL_MASKS.model_copy(update={"block_gaussians": 40})
    field = solved_field(boxes_with_latents, "blocks", blocks, threads=2)
    assert report_of(field)["blocks"] == 3
    whole = LanguageField.load(solved_field(boxes_with_latents, "whole")).features
    apart = np.linalg.norm(LanguageField.load(field).features - whole)
    assert 0 < apart < 0.2 * np.linalg.norm(whole)
    with pytest.raises(MemoryLimitError, match=r"field of 96 Gaussians(.|\n)*found +0.1 GiB"):
        solved_field(boxes_with_latents, "refused", memory_mib=100.0)


def test_stage_is_the_same_on_any_number_of_threads(boxes_with_latents):
    one, two = (solved_field(boxes_with_latents, str(threads), threads=threads) for threads in (1, 2))
    assert one.read_bytes() == two.read_bytes()
    assert LanguageField.load(one).features.shape == (96, 3, 3)
    assert report_of(one)["after_lbfgs"]["language"] >= 0
    assert report_of(one)["gaussians"] == 96


def test_pruning_is_an_option_of_the_stage(boxes_with_latents):
    plain, pruned = (
        report_of(solved_field(boxes_with_latents, name, SMALL_MASKS.model_copy(update=more)))
        for name, more in (("plain", {}), ("pruned", {"prune_cosine": 0.0}))
    )
    assert pruned["contrasted_masks"] < plain["contrasted_masks"]


@READINGS
def test_the_trainer_reaches_the_objective_of_the_solver(boxes_with_latents, monkeypatch, readings):
    world, contributions, autoencoder = boxes_with_latents
    weights = {"weight_clustering": 0.3, "weight_instance": 0.002, "weight_part": 0.002, **readings}
    solved = FieldSettings(min_mask_px=4, ridge=0.0, cg_steps=30, lbfgs_steps=40, **weights)
    trained = HiLSplatSettings(
        name="hi_lsplat", language="squared", pixel_step=1, min_mask_px=4, steps=500, rate=0.005, **weights
    )
    monkeypatch.setattr(method, "load_ply", lambda path: round_gaussians(np.zeros((96, 3))))
    monkeypatch.setattr(
        method, "pixel_weights", lambda _, camera, **__: two_boxes_weights(world.views.index(camera.name))
    )
    out = world.folder / "trained.safetensors"
    folders = world.scene, world.ply, world.masks, contributions, autoencoder, world.coverage_tree
    run_method(MethodInputs(*folders), out, trained, 0)
    masks = Contributions.load(contributions)
    latents, parents = load_latents(autoencoder, masks), read_parents(world.coverage_tree, masks)
    problem, contrast = field_losses(masks, parents, latents, solved, "average", 0, 1)

    def objective(features):
        terms = problem.terms(features) | contrast.values(features)
        names = "clustering", "instance", "part"
        return terms["language"] + sum(weights[f"weight_{name}"] * terms[name] for name in names)

    features, _ = solve_field(problem, contrast)
    assert objective(LanguageField.load(out).features) == pytest.approx(objective(features), rel=0.01)
    assert objective(problem.lifted) > 1.1 * objective(features)


def test_a_field_resumes_from_another_one(boxes_with_latents):
    every = SMALL_MASKS.model_copy(update={"min_labelled_share": 0.0})
    first = solved_field(boxes_with_latents, "first", every)
    onward = SMALL_MASKS.model_copy(update={"start": "langsplat"})
    begun = report_of(solved_field(boxes_with_latents, "second", onward, start=first))["lifted"]
    solved = report_of(first)["after_lbfgs"]
    assert begun.pop("ridge") == 0  # which pulls towards the start
    assert begun == pytest.approx({name: solved[name] for name in begun}, rel=1e-4)
    LanguageField(LanguageField.load(first).features, "other", "code").save(first)
    with pytest.raises(MisalignedArtifactError, match=r"not made from the Gaussians of .*contributions"):
        solved_field(boxes_with_latents, "second", onward, start=first)


def test_a_start_and_its_field_are_given_together(boxes_with_latents):
    onward = SMALL_MASKS.model_copy(update={"start": "langsplat"})
    for settings, start in ((onward, None), (SMALL_MASKS, Path("field.safetensors"))):
        with pytest.raises(SettingsError, match="options do not match"):
            solved_field(boxes_with_latents, "field", settings, start=start)


@pytest.mark.parametrize("stale", ["coverage_tree", "autoencoder", "contributions"])
def test_parts_of_masks_in_another_order_are_refused(boxes_with_latents, stale):
    world, contributions, autoencoder = boxes_with_latents
    reverse_masks(world, "001.png")
    reversed_entries = read_index(world.masks)["views"]
    for folder in {world.coverage_tree, autoencoder, contributions} - {world.folder / stale}:
        index = read_index(folder)  # as if its stage had run again
        write_index(folder, reversed_entries, **{key: index[key] for key in index if key != "views"})
    message = rf"not made from the masks of view 001\.png in .*{stale}|{stale} was not made"
    with pytest.raises(MisalignedArtifactError, match=message):
        solved_field(boxes_with_latents, "field")


def test_baselines_refuse_other_gaussians_and_masks_in_another_order(boxes_with_latents):
    world, *own = boxes_with_latents
    other = world.folder / "other.ply"
    other.write_bytes(b"other")
    with pytest.raises(MisalignedArtifactError, match=r"contributions was not made from .*other\.ply"):
        MethodInputs(world.scene, other, world.masks, *own, world.coverage_tree).view_weights(world.views[0])
    reverse_masks(world, "001.png")
    inputs = MethodInputs(world.scene, world.ply, world.masks, *own, world.coverage_tree)
    with pytest.raises(MisalignedArtifactError, match=r"view 001\.png was not made from .*001\.png\.npz"):
        inputs.view_labels("001.png")
