"""The factored mask decoder (`factored_decoder`) and the reading of its masks, in torch on a card.

Arrays have one row per prompt, and pixels last. H: heads; T: tokens; D: channels of a head; P: pixels of the
image embedding; F: factors of a layer, H (T - 1). `sam` and `generate` read the masks of
arrays.
"""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int32, Int64
from torch import Tensor

from hilsplat.models.layouts import NetworkSpec
from hilsplat.models.torch_network import TorchNetwork, tensor_of
from hilsplat.segment.decoder_kernels import Upscaling
from hilsplat.segment.decoder_network import DecoderNetwork
from hilsplat.segment.decoder_weights import Attention, Linear, Norm
from hilsplat.segment.factored_decoder import HEADS_PER_ATTENTION, FactoredDecoder, ImageTerms, single


def on_device(value: Any, device: torch.device) -> Any:
    """Return a copy of weights with tensors in place of arrays; other values are returned unchanged."""
    if isinstance(value, np.ndarray):
        return torch.from_numpy(np.array(value)).to(device)
    if isinstance(value, list):
        return [on_device(item, device) for item in value]
    if not isinstance(value, Linear | Norm | Attention | Upscaling):
        return value
    names = value._fields if isinstance(value, Upscaling) else [field.name for field in fields(value)]
    return type(value)(*(on_device(getattr(value, name), device) for name in names))


class TorchDecoder(FactoredDecoder):
    """`FactoredDecoder` whose arrays are tensors on a device."""

    xp = torch
    score_scale = 1.0  # type: ignore[assignment]
    device: torch.device | None = None  # while the weights are read

    def __init__(
        self, network: DecoderNetwork, heads: int = HEADS_PER_ATTENTION, device: str = "cuda"
    ) -> None:
        super().__init__(network, heads)
        self.device = torch.device(device)
        for name, value in vars(self).items():
            setattr(self, name, on_device(value, self.device))
        graph, inputs = self._graphs[1], tuple(network.network.inputs)
        self._side_names = [value.name for value in graph.model.graph.output]
        self._sides = TorchNetwork(network.network.path, NetworkSpec({}, {}, inputs), graph, device=device)

    @torch.inference_mode()
    def image(self, features: Mapping[str, Any]) -> ImageTerms:
        on_card: dict[str, Any] = {
            name: tensor_of(value, np.float32).to(self.device) for name, value in features.items()
        }
        return super().image(on_card)

    @torch.inference_mode()
    def decode(self, image: Any, points_xy: Float[np.ndarray, "P 2"], *, fine: bool) -> Any:
        return super().decode(image, points_xy, fine=fine)

    @torch.inference_mode()
    def logits(self, image: Any, kept: Any) -> Any:
        return super().logits(image, kept)

    def _image_sides(self, features: Mapping[str, Any]) -> list[Any]:
        feeds = self._network.feeds(features, np.zeros((1, 1, 2)))
        return list(self._sides.values(feeds, self._side_names))

    def _token_rows(self, points_xy: Float[np.ndarray, "P 2"]) -> Any:
        rows = super()._token_rows(points_xy)
        return rows if self.device is None else torch.from_numpy(rows).to(self.device)

    def _blocks(self, rows: Any) -> Any:
        return single(rows)

    _by_pixel = _blocks

    def _softmax(self, scores: Any) -> Any:
        return scores.softmax(dim=-1)

    def _by_head(self, rows: Tensor, image: Tensor) -> Tensor:
        """Multiply rows (n, H, R, D) with each head's rows of an image array (H D, P) -> (n, H, R, P)."""
        number, heads, length, inner = rows.shape
        flat = rows.swapaxes(0, 1).reshape(heads, number * length, inner)
        return (flat @ image.reshape(heads, inner, -1)).view(heads, number, length, -1).swapaxes(0, 1)

    def _means(self, weights: Tensor, values: Tensor) -> Tensor:
        """Sum values (H D, P) by weights (n, H, T, P) -> (n, H, T, D)."""
        number, heads, tokens, pixels = weights.shape
        flat = weights.swapaxes(0, 1).reshape(heads, number * tokens, pixels)
        sums = flat @ values.view(heads, -1, pixels).swapaxes(1, 2)
        return sums.view(heads, number, tokens, -1).swapaxes(0, 1)

    def _read_image(self, image: Any, rows: Any) -> Any:
        return self._means(self._softmax(self._by_head(rows, image.keys)), image.values)

    def _shares(self, scores: Tensor) -> Tensor:
        """Return each token's share in each pixel, except the last token's: (n, H, T, P) -> (n, F, P)."""
        return scores.softmax(dim=2)[:, :, :-1].flatten(1, 2)

    def _times_factors(self, low: Tensor, e: Tensor) -> Tensor:
        """Multiply products of tokens with the factors' keys (n, H, T, ...) with factors -> (n, H, T, P)."""
        number, heads, tokens = low.shape[:3]
        return (low.reshape(number, heads * tokens, -1) @ e).view(number, heads, tokens, -1)

    def _first_factors(self, image: Any, keys: Tensor) -> Tensor:
        return self._shares(self._by_head(keys, image.first.queries))

    def _second_factors(
        self, image: Any, keys: Tensor, low: Tensor, offset: Tensor, s1: Tensor, e: Tensor
    ) -> Tensor:
        scale, terms = s1[:, None, None], image.second
        scores = scale * (self._by_head(keys, terms.scaled_queries) + offset)
        scores = scores + self._by_head(keys, terms.fixed_queries) + self._times_factors(low, e)
        return self._shares(scores)

    def _read(self, terms: Any, prompts: Any, e: Tensor, scales: list[Tensor], parts: tuple[Any, ...]) -> Any:
        """Compute a token-to-pixel attention whose keys and values are sums of factored terms.

        Args:
            terms, prompts: arrays of the layer.
            scales: scales of the pixels (n, P); the first multiplies the image's keys and values.
            parts: values of the factors (n, H, F, D), and of each scale (n, H, 1, D).
        """
        of_factors, *of_scales = parts
        by_pixel = [scale[:, None, None] for scale in scales]
        scores = by_pixel[0] * self._by_head(prompts.queries, terms.scaled_keys)
        scores = (
            scores + self._by_head(prompts.queries, terms.fixed_keys) + self._times_factors(prompts.low, e)
        )
        for column, scale in enumerate(by_pixel):
            scores = scores + prompts.offset[..., column, None] * scale
        weights = self._softmax(scores)
        scaled = weights * by_pixel[0]
        values = self._means(scaled, terms.values) + (weights @ e[:, None].swapaxes(2, 3)) @ of_factors
        values = values + scaled.sum(dim=-1, keepdim=True) * of_scales[0]
        for scale, value in zip(by_pixel[1:], of_scales[1:], strict=True):
            values = values + (weights * scale).sum(dim=-1, keepdim=True) * value
        return values

    def _update_and_read_first(self, image: Any, prompts: Any, *parts: Any) -> tuple[Any, Any, Any]:
        terms = image.first
        e = self._first_factors(image, prompts.update_keys)
        y = self._by_head(prompts.twice_changes, terms.before).flatten(1, 2)
        y = y + prompts.gram @ e + prompts.linear.flatten(1)[..., None]
        total = terms.square + prompts.square[:, None] + 2 * (terms.cross + prompts.last @ terms.before)
        s1 = self._scale(total + (e * y).sum(dim=1))
        e = e * s1[:, None]
        return s1, e, self._read(terms, prompts, e, [s1], parts)

    def _update_and_read_second(
        self, image: Any, prompts: Any, s1: Any, e: Any, *parts: Any
    ) -> tuple[Any, Any, Any]:
        terms, heads = image.second, self.heads
        more = self._second_factors(
            image, prompts.update_keys, prompts.update_low, prompts.update_offset, s1, e
        )
        e = torch.cat([e, more], dim=1)
        y = torch.cat(
            [
                self._by_head(prompts.twice_changes[:, :heads], terms.before_first),
                self._by_head(prompts.twice_changes[:, heads:], terms.before_second),
            ],
            dim=1,
        ).flatten(1, 2)
        by_first, by_second = (prompts.linear[..., part].flatten(1)[..., None] for part in (0, 1))
        y = s1[:, None] * (y + by_first) + by_second + prompts.gram @ e
        # |a|^2, a b and |b|^2; the first scale multiplies a, but not b
        aa, ab, bb = (prompts.square[:, part, None] for part in range(3))
        total = s1 * (terms.square + aa + 2 * (terms.cross_first + prompts.last[:, 0] @ terms.before_first))
        total = total + 2 * (terms.cross_second + prompts.last[:, 1] @ terms.before_second + ab)
        total = s1 * total + bb
        s2 = self._scale(total + (e * y).sum(dim=1))
        e = e * s2[:, None]
        return s2, e, self._read(terms, prompts, e, [s1 * s2, s2], parts)

    def _scale(self, squares: Tensor) -> Tensor:
        """Return the scale of a layer norm from the sum of squares over channels."""
        return (squares / len(self._bias0) + self._eps).rsqrt()

    def _factors(self, image: Any, kept: Any) -> Any:
        keys0, keys1, low, offset, s1, s2 = (
            kept[name] for name in ("keys0", "keys1", "low", "offset", "s1", "s2")
        )
        e = self._first_factors(image, keys0) * s1[:, None]
        more = self._second_factors(image, keys1, low, offset, s1, e)
        return torch.cat([e, more], dim=1) * s2[:, None]

    def _logits(self, image: Any, kept: Any, e: Any, *, fine: bool) -> Any:
        weights, terms, parts = self._upscaling, image.masks, 4 if fine else 1
        wide, narrow = len(weights.norm_scale), len(weights.bias)
        s2 = kept["s2"][:, None]
        s12 = s2 * kept["s1"][:, None]
        rows = slice(parts * wide)
        changes = kept["changes"]
        through = changes @ self._factor_masks.view(len(changes[0]), self.dim, -1)[..., rows]
        x = through.flatten(1, 2).swapaxes(1, 2) @ e
        x = x + s12 * (terms.scaled[rows] + kept["both_scales"][:, rows, None])
        x = x + s2 * kept["second_scale"][:, rows, None] + weights.fixed[rows, None]
        if len(terms.detail):
            x = x + terms.detail[rows]
        number, pixels = len(x), x.shape[-1]
        x = x.view(number, parts, wide, pixels)
        x = x * (x.square().mean(dim=2, keepdim=True) + self._upscale_eps).rsqrt()
        x = F.gelu(x * weights.norm_scale[:, None] + weights.norm_shift[:, None])
        y = weights.second.view(-1, wide)[: parts * narrow] @ x
        y = y.view(number, parts, parts, narrow, pixels) + weights.bias[:, None]
        if len(terms.finest):
            y = y + terms.finest.view(4, 4, narrow, pixels)[:parts, :parts]
        masks = kept["combine"]
        of_cells = masks @ F.gelu(y).permute(0, 3, 1, 2, 4).flatten(2)
        height, width = image.grid_hw
        if not fine:
            return of_cells.view(number, -1, height, width)
        # (n, M, dy, dx, dy of the second upscaling, dx, H, W) -> (n, M, 4 H, 4 W)
        of_cells = of_cells.view(number, masks.shape[1], 2, 2, 2, 2, height, width)
        return of_cells.permute(0, 1, 6, 2, 4, 7, 3, 5).reshape(number, -1, 4 * height, 4 * width)


@torch.inference_mode()
def steps_and_areas(
    logits: Tensor, step: float, thresholds: tuple[int, int], size_hw: tuple[int, int]
) -> tuple[Tensor, Int64[np.ndarray, "2 K"]]:
    """Return logits (K, h, w) as int8 steps, and the areas above each threshold in the top left `size_hw`."""
    steps = (logits / step).round().clamp(-127, 127).to(torch.int8)
    visible = steps[:, : size_hw[0], : size_hw[1]]
    limits = np.clip(thresholds, -128, 127).tolist()  # torch converts other numbers to int8 modulo 256
    areas = torch.stack([(visible > limit).sum(dim=(1, 2)) for limit in limits])
    return steps, np.asarray(areas.cpu())


@torch.inference_mode()
def positive_boxes(logits: Tensor) -> Int32[np.ndarray, "K 4"]:
    """Return the box (xyxy, end exclusive) of the positive logits (K, h, w) of each mask, else all 0."""
    inside, sides = logits > 0, []
    for axis in (1, 2):  # columns, then rows
        hit = inside.any(dim=axis).to(torch.int8)
        first, last = hit.argmax(dim=1), hit.shape[1] - hit.flip(1).argmax(dim=1)
        sides.append(torch.stack([first, last]) * hit.any(dim=1))
    (x0, x1), (y0, y1) = sides
    return np.asarray(torch.stack([x0, y0, x1, y1], dim=1).int().cpu())


@torch.inference_mode()
def windows(
    logits: Tensor, rows: Int64[np.ndarray, " m"], boxes: Int32[np.ndarray, "m 4"], reach: int
) -> np.ndarray:
    """Return the logits (K, h, w) of some masks in boxes, row by row, as `generate.edge_windows` does."""
    chosen = logits[torch.from_numpy(rows).to(logits.device)]
    if not len(rows):
        return np.asarray(chosen.cpu()).reshape(-1)
    inside = (chosen > 0).to(torch.float16 if logits.is_cuda else torch.float32)
    near = _largest(inside, reach) > 0
    whole = _largest(1 - inside, reach) == 0
    chosen = chosen.masked_fill(~near, -127).masked_fill(whole, 127)
    x0, y0, x1, y1 = torch.from_numpy(boxes).to(logits.device).T[..., None, None]
    y, x = (torch.arange(side, device=logits.device) for side in chosen.shape[1:])
    within = (y[:, None] >= y0) & (y[:, None] < y1) & (x >= x0) & (x < x1)
    return np.asarray(chosen[within].cpu())


def _largest(values: Tensor, reach: int) -> Tensor:
    """Return the largest value within a distance of `reach` along both axes."""
    values = F.max_pool2d(values, (2 * reach + 1, 1), 1, (reach, 0))
    return F.max_pool2d(values, (1, 2 * reach + 1), 1, (0, reach))
