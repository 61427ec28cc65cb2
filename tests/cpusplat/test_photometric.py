"""The photometric loss against a plain torch one."""

import math

import numpy as np
import pytest

from cpusplat import photometric_loss, psnr, ssim


def torch_ssim(torch, image, target):
    """SSIM as 3DGS writes it: a dense 11x11 window per channel, zero padding; float64."""
    taps = torch.exp(-((torch.arange(11, dtype=torch.float64) - 5) ** 2) / (2 * 1.5**2))
    taps = taps / taps.sum()
    window = torch.outer(taps, taps).expand(3, 1, 11, 11)

    def blur(values):
        return torch.nn.functional.conv2d(values.permute(2, 0, 1)[None], window, padding=5, groups=3)

    a, b = blur(image), blur(target)
    aa, bb, ab = blur(image**2) - a**2, blur(target**2) - b**2, blur(image * target) - a * b
    c1, c2 = 0.01**2, 0.03**2
    return ((2 * a * b + c1) * (2 * ab + c2) / ((a**2 + b**2 + c1) * (aa + bb + c2))).mean()


def pair(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    target = rng.random((height, width, 3), dtype=np.float32)
    image = np.clip(target + 0.2 * rng.normal(size=target.shape), 0, 1).astype(np.float32)
    return image, target


@pytest.mark.parametrize("size", [(24, 33), (7, 5), (40, 16)])
def test_loss_and_gradient_agree_with_torch(size):
    torch = pytest.importorskip("torch", reason="torch is not installed")
    image, target = pair(*size)
    x = torch.tensor(image, dtype=torch.float64, requires_grad=True)
    t = torch.tensor(target, dtype=torch.float64)
    expected = 0.8 * (x - t).abs().mean() + 0.2 * (1 - torch_ssim(torch, x, t))
    expected.backward()
    loss, gradient = photometric_loss(image, target, ssim_weight=0.2)
    assert loss == pytest.approx(expected.item(), rel=1e-5)
    assert np.abs(gradient - x.grad.numpy()).max() < 1e-4 * x.grad.abs().max()
    assert ssim(image, target) == pytest.approx(torch_ssim(torch, x, t).item(), rel=1e-5)


@pytest.mark.parametrize("compare", [lambda *pair: photometric_loss(*pair, ssim_weight=0.2), ssim, psnr])
def test_images_of_different_sizes_or_with_whole_numbers_are_refused(compare):
    image, target = pair(8, 9)
    for other in (target[:4], target[:, :4], target[:1], target[..., :1], (255 * target).astype(np.uint8)):
        with pytest.raises(ValueError, match=r"two float images \[H, W, 3\] of one size"):
            compare(image, other)
        with pytest.raises(ValueError, match="two float images"):
            compare(other, image)
    with pytest.raises(ValueError, match="two float images"):
        compare(image[:0], target[:0])


def test_psnr_of_a_constant_offset():
    # mean square 0.01, so -10 log10(0.01) = 20 dB
    black = np.zeros((4, 4, 3), np.float32)
    assert psnr(black + np.float32(0.1), black) == pytest.approx(20.0, abs=1e-5)
    assert psnr(black, black) == math.inf
