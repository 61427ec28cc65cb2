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
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.contributions.quadratic import StackedWeights
from hilsplat.contributions.quadratic_builder import GramBuilder
from hilsplat.contributions.view_matrices import painted_indicator
from hilsplat.field.autoencoder import run_autoencoder
from hilsplat.field.code import LanguageField
from hilsplat.field.contrast import Contrast, ViewRelations, distinct, num_compared
from hilsplat.field.field import run_field
from hilsplat.field.literal_trainer import ViewTargets, view_losses
from hilsplat.field.problem import QuadraticProblem, conjugate_gradient
from hilsplat.field.solver import dot, keep_labelled, solve_field
from hilsplat.methods.method import MethodInputs
from hilsplat.semantic_tree.build import run_semantic_tree
from hilsplat.settings import AutoencoderSettings, FieldSettings, SemanticTreeSettings
from tests.unit.field.torch_losses import instance_term, part_term
from tests.unit.round_gaussians import round_gaussians
from tests.unit.two_boxes_world import reverse_masks

PIXELS, GAUSSIANS, CHANNELS = 60, 12, 2


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
        self.half = painted_indicator(labels, 9, rng.random(PIXELS) < 0.5)
        self.pixels = np.asarray(self.painted.sum(axis=1)).ravel().astype(np.float32)
        self.half_pixels = np.asarray(self.half.sum(axis=1)).ravel().astype(np.float32)
        self.A = (sp.diags(1 / self.pixels) @ self.painted @ self.W).astype(np.float32)
        self.A_half = (sp.diags(1 / self.half_pixels) @ self.half @ self.W).astype(np.float32)
        self.latents = rng.normal(size=(9, CHANNELS)).astype(np.float32)
        self.problem = QuadraticProblem.of(
            MaskOperator.of(sp.csr_matrix(self.A), self.level),
            StackedWeights(sp.csr_matrix(self.W), self.labels >= 0),
            self.pixels,
            self.latents,
            weights,
        )
        self.features = rng.normal(size=(GAUSSIANS, 3, CHANNELS)).astype(np.float32)

    def view(self, settings: FieldSettings) -> ViewTargets:
        """The view as the literal trainer's input."""
        relations = self.contrast(settings).relations[0]
        return ViewTargets(np.arange(9), self.level.astype(np.int64) - 1, self.painted, self.half, relations)

    def contrast(self, settings: FieldSettings) -> Contrast:
        parent = np.array([-1] * 3 + [0, 0, 1] + [3, 4, 4])
        relations = ViewRelations(
            np.arange(9),
            np.zeros((9, 9), np.int64),
            self.level.astype(np.int64),
            ((np.array([3, 4, 5]), parent[3:6]), (np.array([6, 7, 8]), parent[6:9])),
        )
        half = MaskOperator.of(sp.csr_matrix(self.A_half), self.level)
        return Contrast(self.problem.masks, half, self.pixels, self.half_pixels, [relations], settings)


def dense_system(toy: Toy, weights: tuple[float, float, float], index: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the matrix and the right side of a level's quadratic losses."""
    language, clustering, ridge = weights
    valid, rows = toy.labels[:, index] >= 0, toy.level == index + 1
    W, A = toy.W[valid].astype(np.float64), toy.A[rows].astype(np.float64)
    mass, n = np.diag(W.sum(axis=0)), np.diag(toy.pixels[rows].astype(np.float64))
    hessian = (language + clustering) * W.T @ W - clustering * A.T @ n @ A + ridge * mass
    return hessian, language * A.T @ n @ toy.latents[rows] + ridge * mass @ toy.problem.lifted[:, index]


def test_conjugate_gradient_reaches_the_dense_solution():
    toy = Toy(weights := (1.0, 0.3, 0.1))
    solved = conjugate_gradient(toy.problem, 30)
    for index in range(3):
        hessian, right = dense_system(toy, weights, index)
        expected, *_ = np.linalg.lstsq(hessian, right, rcond=None)  # 0 for the unseen Gaussian
        assert solved[:, index] == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize("stored", ["weights", "gram"])
def test_each_block_is_solved_with_the_others_fixed(stored, tmp_path):
    toy = Toy(weights := (1.0, 0.3, 0.1))
    if stored == "gram":
        builder = GramBuilder(GAUSSIANS, 1, Scratch(tmp_path))
        builder.add(toy.problem.quadratic)
        toy.problem = replace(toy.problem, quadratic=builder.finish())
    blocks = (0, 4), (4, 8), (8, 12)
    toy.problem = replace(toy.problem, blocks=blocks)
    settings = FieldSettings(weight_instance=0.0, weight_part=0.0, cg_steps=30)
    solved, report = solve_field(toy.problem, toy.contrast(settings))
    assert (report["blocks"], report["after_cg"]["language"] < report["lifted"]["language"]) == (3, True)
    for index in range(3):
        hessian, right = dense_system(toy, weights, index)
        expected = toy.problem.lifted[:, index].astype(np.float64)
        for block in (slice(begin, end) for begin, end in blocks):
            expected[block], *_ = np.linalg.lstsq(
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
        others=(
            toy.problem.quadratic.across(0, 6, whole),
            contrast.masks.block(6, 12).means(whole[6:]),
        ),
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
def test_the_literal_trainer_has_the_objective_of_the_solver(readings):
    weights = {"weight_language": 0.7, "weight_clustering": 0.4, "weight_instance": 0.5, "weight_part": 0.25}
    settings = FieldSettings(**readings, **weights)
    toy = Toy((0.7, 0.4, 0.0))
    contrast = toy.contrast(settings)
    shares = 1, toy.problem.total_pixels, *num_compared(contrast.relations)
    W = toy.W.astype(np.float64)
    maps = np.einsum("pg,gld->pld", W, toy.features)
    losses, by_maps = view_losses(maps, toy.view(settings), toy.latents, settings, shares)
    expected = toy.problem.terms(toy.features) | contrast.values(toy.features)
    assert losses == pytest.approx({name: expected[name] for name in losses}, rel=1e-4)
    _, by_features = contrast.weighted(toy.features)
    half = toy.problem.hessian_product(toy.features) - toy.problem.right_side()
    by_features = by_features + 2 / toy.problem.total_pixels * half
    assert np.einsum("pg,pld->gld", W, by_maps) == pytest.approx(by_features, abs=1e-5)


def test_langsplats_l1_is_a_mean_over_all_pixels():
    toy = Toy((1.0, 0.0, 0.0))
    settings = FieldSettings(language="l1", trainer="literal", weight_part=0.0)
    maps = np.einsum("pg,gld->pld", toy.W.astype(np.float64), toy.features)
    losses, gradient = view_losses(maps, toy.view(settings), toy.latents, settings, (1, 1.0, 1, 1))
    apart = np.abs(maps - toy.latents[toy.labels])[toy.labels >= 0]
    assert losses["language"] == pytest.approx(apart.sum() / (PIXELS * CHANNELS))
    assert not gradient[toy.labels < 0].any()


@pytest.fixture
def boxes_with_latents(two_boxes_contributions):
    world, contributions = two_boxes_contributions
    tree, autoencoder = world.folder / "semantic_tree", world.folder / "autoencoder"
    run_semantic_tree(contributions, world.masks, tree, SemanticTreeSettings())
    quick = AutoencoderSettings(code="network", latent=3, epochs=1, min_steps=100)
    run_autoencoder(world.clip, tree, contributions, autoencoder, quick, 0)
    return world, contributions, autoencoder


SMALL_MASKS = FieldSettings(min_mask_px=4, weight_part=0.003)
LITERAL = SMALL_MASKS.model_copy(update={"trainer": "literal", "iterations": 60, "rate": 0.05})


def solved_field(boxes, name: str, settings: FieldSettings = SMALL_MASKS, threads: int = 1, **more) -> Path:
    """The field of a run of the stage."""
    world, contributions, autoencoder = boxes
    out = world.folder / name / "field.safetensors"
    if settings.trainer == "literal":
        more.setdefault("rendered", (world.scene, world.ply, world.masks))
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


def test_the_median_start_and_pruning_are_options_of_the_stage(boxes_with_latents):
    plain, median, pruned = (
        report_of(solved_field(boxes_with_latents, name, SMALL_MASKS.model_copy(update=more)))
        for name, more in (("plain", {}), ("median", {"start": "median"}), ("pruned", {"prune_cosine": 0.0}))
    )
    assert median["lifted"] != plain["lifted"]
    assert pruned["contrasted_masks"] < plain["contrasted_masks"]


@pytest.fixture
def flat_boxes(boxes_with_latents, monkeypatch):
    """The two boxes, with Gaussians that render them."""
    row, column = np.divmod(np.arange(96), 12)
    means = np.stack([column - 5.5, row - 3.5, np.full(96, 10.0)], axis=1)
    flat = round_gaussians(means, log_scale=-1.5, opacity_logit=5.0)
    monkeypatch.setattr("hilsplat.field.literal_trainer.load_ply", lambda path: flat)
    return boxes_with_latents


def test_the_literal_trainer_lowers_its_loss_and_is_the_same_on_any_number_of_threads(flat_boxes):
    settings = LITERAL.model_copy(update={"start": "random"})
    one, two = (solved_field(flat_boxes, str(threads), settings, threads) for threads in (1, 2))
    report = report_of(one)
    assert [point["step"] for point in report["curve"]] == list(range(2, 61, 2))
    assert report["curve"][-1]["loss"] < 0.7 * report["curve"][0]["loss"]
    assert report["trained"]["language"] < 0.5 * report["start"]["language"]
    assert one.read_bytes() == two.read_bytes()
    assert LanguageField.load(one).features.shape == (96, 3, 3)


def test_a_field_resumes_from_another_one(flat_boxes):
    first = solved_field(flat_boxes, "first", LITERAL.model_copy(update={"min_labelled_share": 0.0}))
    onward = SMALL_MASKS.model_copy(update={"start": "langsplat"})
    begun = report_of(solved_field(flat_boxes, "second", onward, start=first))["lifted"]
    trained = report_of(first)["trained"]
    assert begun.pop("ridge") == 0  # which pulls towards the start
    assert begun == pytest.approx({name: trained[name] for name in begun}, rel=1e-4)
    LanguageField(LanguageField.load(first).features, "other", "code").save(first)
    with pytest.raises(MisalignedArtifactError, match=r"not made from the Gaussians of .*contributions"):
        solved_field(flat_boxes, "second", onward, start=first)


@pytest.mark.parametrize("update", [{"trainer": "literal"}, {"start": "langsplat"}])
def test_settings_without_their_input_are_refused(boxes_with_latents, update):
    settings = SMALL_MASKS.model_copy(update=update)
    with pytest.raises(SettingsError, match="options do not match"):
        solved_field(boxes_with_latents, "field", settings, rendered=None)


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


def test_the_literal_trainer_and_baselines_refuse_other_gaussians_and_masks_in_another_order(flat_boxes):
    world, *own = flat_boxes
    other = world.folder / "other.ply"
    other.write_bytes(b"other")
    rendered = world.scene, other, world.masks
    with pytest.raises(MisalignedArtifactError, match=r"contributions was not made from .*other\.ply"):
        solved_field(flat_boxes, "literal", LITERAL, rendered=rendered)
    with pytest.raises(MisalignedArtifactError, match=r"contributions was not made from .*other\.ply"):
        MethodInputs(*rendered, *own).view_weights(world.views[0])
    reverse_masks(world, "001.png")
    with pytest.raises(MisalignedArtifactError, match=r"view 001\.png was not made from .*001\.png\.npz"):
        solved_field(flat_boxes, "literal", LITERAL)
    with pytest.raises(MisalignedArtifactError, match=r"view 001\.png was not made from .*001\.png\.npz"):
        MethodInputs(world.scene, world.ply, world.masks, *own).view_labels("001.png")
