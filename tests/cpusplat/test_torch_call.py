"""`rasterization` on tensors: against gsplat's reference in float64, and with its strategies."""

import numpy as np
import pytest

from cpusplat import rasterization
from tests.cpusplat.scenes import random_gaussians, two_cameras

torch = pytest.importorskip("torch", reason="torch is not installed")

NAMES = ("means", "quats", "scales", "opacities", "colors")
MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def tensors(arrays: dict, dtype: type | None = None) -> dict:
    """The arrays as tensors that gather gradients; cameras and numbers as they are."""
    return {
        name: torch.tensor(value, dtype=dtype).requires_grad_() if name in NAMES else value
        for name, value in arrays.items()
    }


def reference(gaussians: dict, cameras: dict, mode: str, sh_degree: int | None, backgrounds: np.ndarray):
    """As `rasterization`, by gsplat's functions in float64; also means2d of each view."""
    gsplat_on_cpu = pytest.importorskip("tests.cpusplat.gsplat_on_cpu", reason="gsplat is not installed")
    means, quats, scales, opacities, colors = (gaussians[name] for name in NAMES)
    viewmats, Ks = (torch.tensor(cameras[name]).double() for name in ("viewmats", "Ks"))
    images, alphas, means2d = [], [], []
    for number, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
        if sh_degree is None:
            channels = colors if colors.ndim == 2 else colors[number]
        else:
            centre = -viewmat[:3, :3].T @ viewmat[:3, 3]
            channels = gsplat_on_cpu.spherical_harmonics(sh_degree, means - centre, colors) + 0.5
            channels = channels.clamp(min=0)
        depth = means @ viewmat[2, :3] + viewmat[2, 3]
        channels = torch.cat([channels, depth[:, None]], dim=1)
        rows, size = (means, quats, scales, opacities, channels), (cameras["width"], cameras["height"])
        image, alpha, meta = gsplat_on_cpu.rasterization_of_view(*rows, viewmat, K, *size)
        shown = image[..., :-1] + (1 - alpha) * torch.tensor(backgrounds[number]).double()
        depth = image[..., -1:] / alpha.clamp(min=1e-10) if "ED" in mode else image[..., -1:]
        parts = ([shown] if "RGB" in mode else []) + ([depth] if "D" in mode else [])
        images.append(torch.cat(parts, dim=-1))
        alphas.append(alpha)
        meta["means2d"].retain_grad()
        means2d.append(meta["means2d"])
    return torch.cat(images), torch.cat(alphas), means2d


@pytest.mark.parametrize("colours", ["shared", "of each view", "harmonics"])
@pytest.mark.parametrize("mode", MODES)
def test_images_and_gradients_agree_with_gsplats_reference(mode, colours):
    rng, n = np.random.default_rng(1), 60
    arrays, cameras = random_gaussians(n, seed=3), two_cameras()
    sh_degree = {"RGB": 1, "RGB+D": 2}.get(mode, 3) if colours == "harmonics" else None
    if colours == "of each view":
        arrays["colors"] = rng.normal(size=(2, n, 4)).astype(np.float32)
    elif colours == "harmonics":
        # more than the kernels have room for; those beyond the degree get no gradient
        arrays["colors"] = (0.4 * rng.normal(size=(n, 36, 3))).astype(np.float32)
    channels = 4 if colours == "of each view" else 3
    backgrounds = rng.random((2, channels), np.float32)
    ours, exact = tensors(arrays), tensors(arrays, torch.float64)
    options = {"render_mode": mode, "sh_degree": sh_degree}
    found, alphas, meta = rasterization(**ours, **cameras, **options, backgrounds=torch.tensor(backgrounds))
    expected, expected_alphas, means2d = reference(exact, cameras, mode, sh_degree, backgrounds)
    assert found.dtype == torch.float32 and found.shape == expected.shape
    for a, b in ((found, expected), (alphas, expected_alphas)):
        difference = (a - b).detach().abs().flatten()
        assert difference.quantile(0.999) < 1e-5 * max(1, b.abs().max().item())
    weight, of_alphas = (torch.tensor(rng.normal(size=shape)) for shape in (found.shape, alphas.shape))
    if "ED" in mode:  # depth is undefined where nothing is
        weight = weight * (expected_alphas.detach() > 0.1)
    meta["means2d"].retain_grad()
    for image, alpha in ((found, alphas), (expected, expected_alphas)):
        ((image * weight).sum() + (alpha * of_alphas).sum()).backward()
    used = NAMES if "RGB" in mode else NAMES[:4]
    for name in used:
        error = (ours[name].grad - exact[name].grad).norm() / exact[name].grad.norm()
        assert error < 2e-4, name
    for own, other in zip(meta["means2d"].grad, means2d, strict=True):
        assert (own - other.grad[0]).norm() / other.grad.norm() < 2e-4


def test_losses_on_projected_means_and_depths_reach_the_means():
    arrays, cameras = random_gaussians(40, seed=5), two_cameras()
    rng = np.random.default_rng(2)
    of_means, of_depths = torch.tensor(rng.normal(size=(2, 40, 2))), torch.tensor(rng.normal(size=(2, 40)))
    ours = tensors(arrays)
    _, alphas, meta = rasterization(**ours, **cameras)
    drawn = (meta["radii"] > 0).all(dim=-1)
    ((meta["means2d"] * of_means).sum() + (meta["depths"] * of_depths).sum() + alphas.sum()).backward()
    blended = tensors(arrays)
    rasterization(**blended, **cameras)[1].sum().backward()
    means = torch.tensor(arrays["means"]).double().requires_grad_()
    total = 0
    for number in range(2):
        viewmat, K = (torch.tensor(cameras[name][number]).double() for name in ("viewmats", "Ks"))
        at = means @ viewmat[:3, :3].T + viewmat[:3, 3]
        pixels = at[:, :2] / at[:, 2:] * torch.stack([K[0, 0], K[1, 1]])
        by_view = (pixels * of_means[number]).sum(dim=1) + at[:, 2] * of_depths[number]
        total = total + by_view[drawn[number]].sum()
    total.backward()
    torch.testing.assert_close(
        ours["means"].grad, blended["means"].grad + means.grad.float(), rtol=1e-4, atol=1e-3
    )


@pytest.mark.parametrize("mode", MODES)
def test_tensors_and_arrays_give_the_same_bytes(mode):
    arrays, cameras = random_gaussians(80), two_cameras()
    arrays["colors"] = np.stack([arrays["colors"], 2 * arrays["colors"]])
    behind = np.full((2, 3), 0.5, np.float32)
    of_tensors = rasterization(
        **tensors(arrays), **cameras, render_mode=mode, backgrounds=torch.tensor(behind)
    )
    of_arrays = rasterization(**arrays, **cameras, render_mode=mode, backgrounds=behind)
    for a, b in zip(of_tensors[:2], of_arrays[:2], strict=True):
        np.testing.assert_array_equal(a.detach().numpy(), b)
    assert of_tensors[2].keys() == of_arrays[2].keys()


@pytest.mark.parametrize("name", NAMES)
def test_no_gradient_is_computed_from_parameters_that_changed_in_place(name):
    gaussians, cameras = tensors(random_gaussians(30)), two_cameras()
    colors, _, _ = rasterization(**gaussians, **cameras)
    with torch.no_grad():
        gaussians[name].mul_(0.5)
    if name == "colors":  # drawn from a copy
        gaussians["means"].grad = None
        colors.sum().backward()
        expected = tensors(random_gaussians(30))
        rasterization(**expected, **cameras)[0].sum().backward()
        assert torch.equal(gaussians["means"].grad, expected["means"].grad)
    else:
        with pytest.raises(RuntimeError, match="modified by an inplace operation"):
            colors.sum().backward()


def test_second_order_gradients_are_refused():
    gaussians = tensors(random_gaussians(30))
    colors, _, meta = rasterization(**gaussians, **two_cameras())
    for of in (gaussians["means"], meta["means2d"]):
        with pytest.raises(NotImplementedError, match="second-order"):
            torch.autograd.grad(colors.sum(), of, create_graph=True)


@pytest.mark.parametrize("name", [*NAMES, "backgrounds"])
def test_tensors_among_arrays_are_refused(name):
    arrays = {**random_gaussians(30), "backgrounds": np.ones((2, 3), np.float32)}
    every = {key: torch.tensor(values) for key, values in arrays.items()}
    for mixed in (arrays | {name: every[name]}, every | {name: arrays[name]}):
        with pytest.raises(TypeError, match="arrays and tensors"):
            rasterization(**mixed, **two_cameras())


def test_gradients_of_cameras_are_refused():
    cameras = two_cameras()
    cameras["viewmats"] = torch.tensor(cameras["viewmats"]).requires_grad_()
    with pytest.raises(NotImplementedError, match=r"viewmats are not supported.*viewmats.detach\(\)"):
        rasterization(**tensors(random_gaussians(3)), **cameras)


def test_gsplats_default_strategy_densifies_by_the_gradients_of_projected_means():
    strategy_of = pytest.importorskip("gsplat.strategy", reason="gsplat is not installed").DefaultStrategy
    torch.manual_seed(0)
    arrays, cameras, n = random_gaussians(60), two_cameras(), 60
    params = {name: torch.nn.Parameter(torch.tensor(arrays[name])) for name in NAMES}
    for name, inverse in (("scales", torch.log), ("opacities", torch.logit)):
        params[name] = torch.nn.Parameter(inverse(params[name].detach()))
    optimizers = {name: torch.optim.Adam([values], lr=1e-3) for name, values in params.items()}
    strategy = strategy_of(
        refine_start_iter=0, refine_every=2, grow_grad2d=1e-9, prune_opa=0.0, reset_every=100
    )
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    for step in (1, 2):
        drawn = params | {"scales": params["scales"].exp(), "opacities": params["opacities"].sigmoid()}
        colors, _, info = rasterization(**drawn, **cameras)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        colors.square().mean().backward()
        if step == 2:
            gathered = state["grad2d"].clone()
        strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
        if step == 1:
            scale = torch.tensor([info["width"], info["height"]]) / 2 * info["n_cameras"]
            expected = (info["means2d"].grad * scale).norm(dim=-1).sum(dim=0)
            torch.testing.assert_close(state["grad2d"], expected)
    assert gathered.gt(0).any() and len(params["means"]) == n + int(gathered.gt(0).sum())
