"""The sparse solver against dense algebra and autograd, and the stage."""

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from scipy.optimize import minimize

from hilsplat.base.artifacts import read_index, read_json, write_index
from hilsplat.base.errors import MisalignedArtifactError, SettingsError
from hilsplat.contributions.mask_operator import MaskOperator
from hilsplat.contributions.quadratic import StackedWeights
from hilsplat.contributions.view_matrices import painted_indicator
from hilsplat.field.autoencoder import run_autoencoder
from hilsplat.field.contrast import Contrast, ViewRelations, compared, distinct
from hilsplat.field.field import run_field
from hilsplat.field.language_field import LanguageField
from hilsplat.field.literal_trainer import Shares, ViewTargets, view_losses
from hilsplat.field.minimise import lbfgs
from hilsplat.field.problem import QuadraticProblem, conjugate_gradient
from hilsplat.field.solver import keep_labelled, solve_field
from hilsplat.methods.method import MethodInputs
from hilsplat.semantic_tree.tree import run_semantic_tree
from hilsplat.settings import AutoencoderSettings, FieldSettings, SemanticTreeSettings
from tests.unit.field.clustering import clustering_loss
from tests.unit.field.latent_regression import latent_regression_loss
from tests.unit.field.torch_losses import instance_term, part_term
from tests.unit.round_gaussians import round_gaussians
from tests.unit.two_boxes_world import reverse_masks

PIXELS, GAUSSIANS, CHANNELS = 60, 12, 2
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


class Toy:
    """One view with three masks a level on 60 pixels and 12 Gaussians, and its dense matrices."""

    def __init__(self, weights: tuple[float, float, float]) -> None:
        rng = np.random.default_rng(0)
        dense = rng.random((PIXELS, GAUSSIANS)) * (rng.random((PIXELS, GAUSSIANS)) < 0.4)
        dense[:, 0] += 0.01  # no empty row
        self.W = (dense / dense.sum(axis=1, keepdims=True)).astype(np.float32)
        self.labels = rng.integers(-1, 3, (PIXELS, 3)) + np.array([0, 3, 6])
        self.labels[rng.random((PIXELS, 3)) < 0.2] = -1
        self.labels[self.labels == np.array([-1, 2, 5])] = -1
        self.level = np.repeat(np.array([1, 2, 3], np.uint8), 3)
        indicator = painted_indicator(self.labels.astype(np.int32), 9, np.ones(PIXELS, bool))
        half = painted_indicator(self.labels.astype(np.int32), 9, rng.random(PIXELS) < 0.5)
        self.painted, self.half = indicator, half
        self.pixels = np.asarray(indicator.sum(axis=1)).ravel().astype(np.float32)
        self.half_pixels = np.asarray(half.sum(axis=1)).ravel().astype(np.float32)
        self.A = (sp.diags(1 / self.pixels) @ indicator @ self.W).astype(np.float32)
        self.A_half = (sp.diags(1 / self.half_pixels) @ half @ self.W).astype(np.float32)
        self.latents = rng.normal(size=(9, CHANNELS)).astype(np.float32)
        self.problem = QuadraticProblem.of(
            MaskOperator.of(sp.csr_matrix(self.A), self.level),
            StackedWeights(sp.csr_matrix(self.W), self.labels >= 0),
            self.pixels,
            self.latents,
            weights,
        )
        self.features = rng.normal(size=(GAUSSIANS, 3, CHANNELS)).astype(np.float32)

    def contrast(self, settings: FieldSettings) -> Contrast:
        parent = np.array([-1] * 3 + [0, 0, 1] + [3, 4, 4])
        relations = ViewRelations(
            np.arange(9),
            np.zeros((9, 9), np.int64),
            self.level.astype(np.int64),
            (np.array([3, 4, 5]), np.array([6, 7, 8])),
            (parent[3:6], parent[6:9]),
        )
        half = MaskOperator.of(sp.csr_matrix(self.A_half), self.level)
        return Contrast(self.problem.masks, half, self.pixels, self.half_pixels, [relations], settings)

    def dense_losses(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Language loss and L_h by rendering every pixel, as means over labelled pixels."""
        language, clustering = 0, 0
        for index in range(3):
            labels = torch.from_numpy(self.labels[:, index])[None]
            rendered = (torch.from_numpy(self.W).double() @ features[:, index])[None]
            count = (labels >= 0).sum() / self.pixels.sum()
            latents = torch.from_numpy(self.latents).double()
            language = language + count * latent_regression_loss(rendered, labels, latents)
            clustering = clustering + count * clustering_loss(rendered, labels)
        return language, clustering


def test_terms_equal_the_losses_of_rendered_pixels():
    toy = Toy((1.0, 0.3, 0.1))
    terms = toy.problem.terms(toy.features)
    language, clustering = toy.dense_losses(torch.from_numpy(toy.features).double())
    assert terms["language"] == pytest.approx(language.item(), rel=1e-5)
    assert terms["clustering"] == pytest.approx(clustering.item(), rel=1e-5)


def test_gradient_equals_autograd_through_rendering():
    toy = Toy((0.7, 0.4, 0.0))
    features = torch.from_numpy(toy.features).double().requires_grad_()
    language, clustering = toy.dense_losses(features)
    (expected,) = torch.autograd.grad(0.7 * language + 0.4 * clustering, features)
    half = toy.problem.hessian_product(toy.features) - toy.problem.right_side()
    assert 2 / toy.problem.total_pixels * half == pytest.approx(expected.numpy(), abs=1e-6)


def test_lifted_average_is_a_weighted_mean_of_latents():
    toy = Toy((1.0, 0.0, 0.1))
    for index in range(3):
        valid = toy.labels[:, index] >= 0
        target = toy.latents[toy.labels[valid, index]]
        weight = toy.W[valid]
        expected = weight.T @ target / weight.sum(axis=0)[:, None]
        assert toy.problem.lifted[:, index] == pytest.approx(expected, abs=1e-5)


def test_unseen_gaussians_stay_zero():
    toy = Toy((1.0, 0.3, 0.1))
    toy.W[:, 5] = 0
    toy.A[:, 5] = 0
    problem = QuadraticProblem.of(
        MaskOperator.of(sp.csr_matrix(toy.A), toy.level),
        StackedWeights(sp.csr_matrix(toy.W), toy.labels >= 0),
        toy.pixels,
        toy.latents,
        (1.0, 0.3, 0.1),
    )
    solved = conjugate_gradient(problem, problem.lifted, 5)
    assert np.isfinite(solved).all()
    assert (solved[5] == 0).all()


def test_conjugate_gradient_reaches_the_dense_solution():
    language, clustering, ridge = weights = (1.0, 0.3, 0.1)
    toy = Toy(weights)
    solved = conjugate_gradient(toy.problem, toy.problem.lifted, 30)
    for index in range(3):
        valid = toy.labels[:, index] >= 0
        rows = toy.level == index + 1
        W = toy.W[valid].astype(np.float64)
        G, mass = W.T @ W, np.diag(W.sum(axis=0))
        A, n = toy.A[rows].astype(np.float64), np.diag(toy.pixels[rows].astype(np.float64))
        hessian = (language + clustering) * G - clustering * A.T @ n @ A + ridge * mass
        right = language * A.T @ n @ toy.latents[rows] + ridge * mass @ toy.problem.lifted[:, index]
        assert solved[:, index] == pytest.approx(np.linalg.solve(hessian, right), abs=2e-5)


def test_a_solved_problem_stays_solved():
    toy = Toy((0.0, 0.0, 1.0))  # only the ridge: the lift is the answer
    assert np.array_equal(conjugate_gradient(toy.problem, toy.problem.lifted, 3), toy.problem.lifted)


def test_lbfgs_finds_the_minimum_of_a_bowl():
    curvature = np.array([1.0, 4.0, 9.0], np.float32)

    def bowl(x: np.ndarray) -> tuple[float, np.ndarray]:
        return float((curvature * (x - 1) ** 2).sum()), 2 * curvature * (x - 1)

    assert lbfgs(bowl, np.zeros(3, np.float32), 20, 0.1) == pytest.approx(np.ones(3), abs=1e-3)


@pytest.mark.parametrize("instance", ["literal", "coverage_tree"])
@pytest.mark.parametrize("part", ["literal", "disentangle"])
def test_contrastive_gradients_equal_autograd_through_the_means(instance, part):
    toy = Toy((1.0, 0.3, 0.1))
    contrast = toy.contrast(FieldSettings(instance_mode=instance, part_mode=part, tau=0.5))
    terms = contrast.values(toy.features)
    value, gradient = contrast.weighted(toy.features, (0.5, 0.25))

    features = torch.from_numpy(toy.features).double().requires_grad_()
    own = [features[:, level - 1] for level in toy.level]
    means, halves = (
        torch.stack([torch.from_numpy(row).double() @ values for row, values in zip(A, own, strict=True)])
        for A in (toy.A.astype(np.float64), toy.A_half.astype(np.float64))
    )
    n, half = (torch.from_numpy(count).double()[:, None] for count in (toy.pixels, toy.half_pixels))
    others = (n * means - half * halves) / (n - half)
    instance_loss = instance_term(means, contrast.relations, contrast.settings)
    part_loss = part_term(means, halves, others, contrast.relations, contrast.settings)
    assert terms == pytest.approx({"instance": instance_loss.item(), "part": part_loss.item()}, rel=1e-5)
    total = 0.5 * instance_loss + 0.25 * part_loss
    assert value == pytest.approx(total.item(), rel=1e-5)
    (expected,) = torch.autograd.grad(total, features, retain_graph=True)
    assert gradient == pytest.approx(expected.numpy(), abs=1e-5)
    (of_part,) = torch.autograd.grad(part_loss, features)
    value, gradient = contrast.weighted(toy.features, (0.0, 1.0))  # the other is not computed
    assert value == pytest.approx(part_loss.item(), rel=1e-5)
    assert gradient == pytest.approx(of_part.numpy(), abs=1e-5)


def test_contrastive_weights_lower_their_terms():
    toy = Toy((1.0, 0.0, 0.1))
    settings = FieldSettings(
        weight_clustering=0.0, weight_instance=1.0, weight_part=0.1, omega=3.0, lbfgs_steps=15
    )
    features, report = solve_field(toy.problem, toy.contrast(settings), settings)
    assert np.isfinite(features).all()
    assert report["after_lbfgs"]["instance"] < report["after_cg"]["instance"]
    without = settings.model_copy(update={"weight_instance": 0.0, "weight_part": 0.0})
    _, plain = solve_field(toy.problem, toy.contrast(without), without)
    assert "after_lbfgs" not in plain
    assert plain["after_cg"]["language"] < plain["lifted"]["language"]


def test_lbfgs_reaches_the_minimum_of_the_whole_objective():
    toy = Toy((1.0, 0.3, 0.1))
    settings = FieldSettings(weight_instance=0.5, weight_part=0.1, cg_steps=0, lbfgs_steps=200)
    contrast, problem = toy.contrast(settings), toy.problem

    def objective(flat: np.ndarray) -> tuple[float, np.ndarray]:
        features = flat.reshape(toy.features.shape).astype(np.float32)
        curved, right = problem.hessian_product(features), problem.right_side()
        value, gradient = contrast.weighted(features, (0.5, 0.1))
        value += float((features * (curved - 2 * right)).sum()) / problem.total_pixels
        gradient = gradient + 2 / problem.total_pixels * (curved - right)
        return value, gradient.reshape(-1).astype(np.float64)

    found, _ = solve_field(problem, contrast, settings)
    start = problem.lifted.reshape(-1).astype(np.float64)
    best = minimize(objective, start, jac=True, method="L-BFGS-B", options={"maxiter": 500}).fun
    assert objective(start)[0] > best + 0.01
    assert objective(found.reshape(-1))[0] == pytest.approx(best, abs=2e-3)


def test_gaussians_that_masks_hardly_hold_keep_no_latent():
    features = np.ones((3, 3, 2), np.float32)
    mass = np.array([[4, 0.1, 4], [4, 2, 0], [0, 0, 0]], np.float32)
    kept = keep_labelled(features, mass, np.array([4.0, 4.0, 0.0]), 0.5)
    assert kept[..., 0].tolist() == [[1, 0, 1], [1, 1, 0], [0, 0, 0]]
    assert np.array_equal(keep_labelled(features, mass, np.array([4.0, 4.0, 0.0]), 0.0), features)


def test_pruning_drops_look_alikes_that_are_unrelated():
    means = np.array([[1, 0], [1, 0.01], [1, 0.02], [0, 1]], np.float32)
    depth = np.zeros((4, 4), np.int64)
    assert distinct(means, depth, 0.95).tolist() == [0, 3]
    depth[0, 1] = depth[1, 0] = 1  # siblings are kept apart; the third is like both
    assert distinct(means, depth, 0.95).tolist() == [0, 1, 3]
    assert distinct(means, depth, 1.0).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("instance", ["literal", "coverage_tree"])
@pytest.mark.parametrize("part", ["literal", "disentangle"])
def test_the_literal_trainer_takes_the_solver_s_objective_on_rendered_maps(instance, part):
    weights = {"weight_language": 0.7, "weight_clustering": 0.4, "weight_instance": 0.5, "weight_part": 0.25}
    settings = FieldSettings(instance_mode=instance, part_mode=part, tau=0.5, **weights)
    toy = Toy((0.7, 0.4, 0.0))
    contrast = toy.contrast(settings)
    shares = Shares(1, toy.problem.total_pixels, *compared(contrast.relations))
    view = ViewTargets(
        np.arange(9), toy.level.astype(np.int64) - 1, toy.painted, toy.half, contrast.relations[0]
    )
    W = toy.W.astype(np.float64)
    maps = np.einsum("pg,gld->pld", W, toy.features)
    losses, by_maps = view_losses(maps, view, toy.latents, settings, shares)
    expected = toy.problem.terms(toy.features) | contrast.values(toy.features)
    assert losses == pytest.approx({name: expected[name] for name in losses}, rel=1e-4)
    _, by_features = contrast.weighted(toy.features, (0.5, 0.25))
    half = toy.problem.hessian_product(toy.features) - toy.problem.right_side()
    by_features = by_features + 2 / toy.problem.total_pixels * half
    assert np.einsum("pg,pld->gld", W, by_maps) == pytest.approx(by_features, abs=1e-5)


def test_langsplats_l1_is_a_mean_over_all_pixels():
    toy = Toy((1.0, 0.0, 0.0))
    settings = FieldSettings(language="l1", trainer="literal", weight_part=0.0)
    relations = toy.contrast(settings).relations[0]
    view = ViewTargets(np.arange(9), toy.level.astype(np.int64) - 1, toy.painted, toy.half, relations)
    maps = np.einsum("pg,gld->pld", toy.W.astype(np.float64), toy.features)
    losses, gradient = view_losses(maps, view, toy.latents, settings, Shares(1, 1.0, 1, 1))
    apart = [
        np.abs(maps[p, i] - toy.latents[toy.labels[p, i]]).sum()
        for p in range(PIXELS)
        for i in range(3)
        if toy.labels[p, i] >= 0
    ]
    assert losses["language"] == pytest.approx(sum(apart) / (PIXELS * CHANNELS))
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


def test_stage_is_the_same_on_any_number_of_threads(boxes_with_latents):
    world, contributions, autoencoder = boxes_with_latents
    out = world.folder / "field.safetensors"
    run_field(contributions, world.coverage_tree, autoencoder, out, SMALL_MASKS, 1)
    before = out.read_bytes()
    run_field(contributions, world.coverage_tree, autoencoder, out, SMALL_MASKS, 2)
    assert out.read_bytes() == before
    field = LanguageField.load(out)
    assert field.features.shape == (96, 3, 3)
    report = read_json(world.folder / "field.report.json")
    assert report["after_lbfgs"]["language"] >= 0
    assert report["gaussians"] == 96


def test_the_median_start_and_pruning_are_options_of_the_stage(boxes_with_latents):
    world, contributions, autoencoder = boxes_with_latents
    reports = {}
    for name, more in (("plain", {}), ("median", {"start": "median"}), ("pruned", {"prune_cosine": 0.0})):
        out = world.folder / name / "field.safetensors"
        settings = SMALL_MASKS.model_copy(update=more)
        run_field(contributions, world.coverage_tree, autoencoder, out, settings, 1)
        reports[name] = read_json(out.with_suffix(".report.json"))
    assert reports["median"]["lifted"] != reports["plain"]["lifted"]
    assert reports["pruned"]["contrasted_masks"] < reports["plain"]["contrasted_masks"]


LITERAL = SMALL_MASKS.model_copy(update={"trainer": "literal", "iterations": 60, "rate": 0.05})


def literal_field(world, contributions, autoencoder, out, settings=LITERAL, ply=None, threads=1, **more):
    rendered = world.scene, ply or world.ply, world.masks
    parts = (contributions, world.coverage_tree, autoencoder)
    run_field(*parts, out, settings, threads, rendered=rendered, **more)


def test_the_literal_trainer_and_baselines_refuse_other_gaussians(boxes_with_latents, monkeypatch):
    world, contributions, autoencoder = boxes_with_latents
    other = world.folder / "other.ply"
    other.write_bytes(b"other")
    with pytest.raises(MisalignedArtifactError, match=r"made for another other\.ply"):
        literal_field(world, contributions, autoencoder, world.folder / "l.safetensors", ply=other)
    parts = (world.scene, other, world.masks, contributions, autoencoder)
    with pytest.raises(MisalignedArtifactError, match=r"made for another other\.ply"):
        MethodInputs(*parts).view_weights(world.views[0])


@pytest.fixture
def flat_boxes(boxes_with_latents, monkeypatch):
    """The two boxes, with Gaussians that render them."""
    row, column = np.divmod(np.arange(96), 12)
    means = np.stack([column - 5.5, row - 3.5, np.full(96, 10.0)], axis=1)
    flat = round_gaussians(means, log_scale=-1.5, opacity_logit=5.0)
    monkeypatch.setattr("hilsplat.field.literal_trainer.load_ply", lambda path: flat)
    return boxes_with_latents


def test_the_literal_trainer_lowers_its_loss_and_is_the_same_on_any_number_of_threads(flat_boxes):
    world, contributions, autoencoder = flat_boxes
    out = world.folder / "literal" / "field.safetensors"
    settings = LITERAL.model_copy(update={"start": "random"})
    literal_field(world, contributions, autoencoder, out, settings)
    report = read_json(world.folder / "literal" / "field.report.json")
    assert [point["step"] for point in report["curve"]] == list(range(2, 61, 2))
    assert report["curve"][-1]["loss"] < 0.7 * report["curve"][0]["loss"]
    assert report["trained"]["language"] < 0.5 * report["start"]["language"]
    before = out.read_bytes()
    literal_field(world, contributions, autoencoder, out, settings, threads=2)
    assert out.read_bytes() == before
    assert LanguageField.load(out).features.shape == (96, 3, 3)


def test_a_field_resumes_from_another_one(flat_boxes):
    world, contributions, autoencoder = flat_boxes
    first, out = (world.folder / name / "field.safetensors" for name in ("first", "second"))
    literal_field(
        world, contributions, autoencoder, first, LITERAL.model_copy(update={"min_labelled_share": 0.0})
    )
    onward = SMALL_MASKS.model_copy(update={"start": "langsplat"})
    parts = (contributions, world.coverage_tree, autoencoder)
    run_field(*parts, out, onward, 1, start=first)
    begun = read_json(out.with_suffix(".report.json"))["lifted"]
    trained = read_json(first.with_suffix(".report.json"))["trained"]
    assert begun.pop("ridge") == 0  # which pulls towards the start
    assert begun == pytest.approx({name: trained[name] for name in begun}, rel=1e-4)
    other = LanguageField(LanguageField.load(first).features, "other", "code")
    other.save(first)
    with pytest.raises(MisalignedArtifactError, match="other Gaussians, or to another code"):
        run_field(*parts, out, onward, 1, start=first)


@pytest.mark.parametrize("more", [{"trainer": "literal"}, {"start": "langsplat"}])
def test_settings_that_need_another_input_say_so(boxes_with_latents, more):
    world, contributions, autoencoder = boxes_with_latents
    settings = SMALL_MASKS.model_copy(update=more)
    with pytest.raises(SettingsError, match="don't fit together"):
        run_field(contributions, world.coverage_tree, autoencoder, world.folder / "l", settings, 1)


@pytest.mark.parametrize("stale", ["coverage_tree", "autoencoder", "contributions"])
def test_parts_of_masks_in_another_order_are_refused(boxes_with_latents, stale):
    world, contributions, autoencoder = boxes_with_latents
    reverse_masks(world, "001.png")
    reversed_entries = read_index(world.masks)["views"]
    for folder in {world.coverage_tree, autoencoder, contributions} - {world.folder / stale}:
        index = read_index(folder)  # as if its stage had run again
        write_index(folder, reversed_entries, **{key: index[key] for key in index if key != "views"})
    parts = (contributions, world.coverage_tree, autoencoder)
    with pytest.raises(MisalignedArtifactError, match=rf"{stale} .*different masks \(view 001\.png\)"):
        run_field(*parts, world.folder / "l.safetensors", SMALL_MASKS, 1)


def test_the_literal_trainer_and_baselines_refuse_masks_in_another_order(flat_boxes):
    world, contributions, autoencoder = flat_boxes
    reverse_masks(world, "001.png")
    with pytest.raises(MisalignedArtifactError, match=r"contains other masks \(view 001\.png\)"):
        literal_field(world, contributions, autoencoder, world.folder / "l.safetensors")
    parts = (world.scene, world.ply, world.masks, contributions, autoencoder)
    with pytest.raises(MisalignedArtifactError, match=r"contains other masks \(view 001\.png\)"):
        MethodInputs(*parts).view_labels("001.png")
