"""SAM's mask decoder for many prompts on one image, factored exactly (timings in docs/benchmarks.md).

The plain decoder projects every pixel of the image embedding ten times per prompt, although prompts differ
only in a few tokens. Before its layer norm, the image embedding after layer 1 is

    X + b + F^T B        X: depends on the image alone, channels x pixels
                         F: softmax weights of H heads x T tokens in each pixel, H (T - 1) rows
                         B: values of the tokens after the output projection, H (T - 1) x channels

The weights of a head sum to 1, so the last token contributes the constant b, and each other token its
difference from the last. The layer norm is then one scale per pixel, computed from |X|^2, from products of X
that all prompts share, and from B's Gram matrix. Every later projection of the image embedding is the sum
of a projection of X, computed once per image, and a projection of few factors: 2 H (T - 1) after layer 2. No
per-prompt array except the masks is as large as the embedding. Results differ from the network's only by
rounding; `SamModel` checks this on a few prompts before it uses this class.

The two attentions of a layer, its layer norm and the next attention process one block of pixels at a time
for several prompts (`decoder_kernels`). Operations on tokens alone use plain numpy in this module.

`TorchDecoder` (`torch_decoder`) overrides the methods that process pixels, and uses the others for tensors.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnxruntime
from jaxtyping import Float, Float32, Float64

from cpusplat.lanes import WIDTH
from hilsplat.base.errors import ModelError
from hilsplat.models.network import DTYPES, Array, one_thread_session
from hilsplat.models.onnx_graph import Graph
from hilsplat.segment import decoder_kernels as kernels
from hilsplat.segment.decoder_network import DecoderNetwork
from hilsplat.segment.decoder_weights import DecoderGraph, Linear

LOG2_E = np.float32(1 / np.log(2))  # converts scores to base 2
BLOCK = 64
"""Maximum pixels per block. A block's arrays fit into a core's L2 cache; 128 and 256 are 2 % slower."""
PROMPTS = 16  # prompts per call, applied to each block one after the other while the block is in the cache
HEADS_PER_ATTENTION = 8  # if the model's configuration doesn't specify them


@dataclass(frozen=True)
class ImageTerms:
    """Arrays that the decoder computes once per image."""

    grid_hw: tuple[int, int]  # size of the image embedding
    keys: Array  # keys and values of the first token-to-pixel attention (`kernels.read_image`)
    values: Array
    first: kernels.FirstLayer
    second: kernels.SecondLayer
    masks: kernels.MaskImage


Kept = Mapping[str, Array]
"""Arrays from which all logits of previewed prompts are computed, one row per prompt."""


class FactoredDecoder:
    """Factored mask decoder of a SAM or SAM 2 model; raises a ModelError for any other architecture."""

    xp: Any = np  # library of the arrays
    score_scale = LOG2_E  # the kernels' scores are base-2 logarithms

    def __init__(self, network: DecoderNetwork, heads: int = HEADS_PER_ATTENTION) -> None:
        graph = DecoderGraph(network.graph)
        self._network = network
        self.heads = heads
        base = "mask_decoder/transformer"
        layers = [f"{base}/layers.{number}" for number in (0, 1)]
        self._self = [graph.attention(f"{layer}/self_attn") for layer in layers]
        self._norms = [[graph.norm(f"{layer}/layer_norm{k}") for k in (1, 2, 3)] for layer in layers]
        self._mlps = [graph.perceptron(f"{layer}/mlp") for layer in layers]
        self._reads = [graph.attention(f"{layer}/cross_attn_token_to_image") for layer in layers]
        self._reads.append(graph.attention(f"{base}/final_attn_token_to_image"))
        self._updates = [graph.attention(f"{layer}/cross_attn_image_to_token") for layer in layers]
        self._last_norm = graph.norm(f"{base}/layer_norm_final_attn")
        self._iou_head = graph.perceptron("mask_decoder/iou_prediction_head")
        self._iou_sigmoid = graph.has_sigmoid("mask_decoder/iou_prediction_head")
        self._mask_heads = [
            graph.perceptron(f"mask_decoder/output_hypernetworks_mlps.{k}") for k in (1, 2, 3)
        ]
        # inputs of these modules: the prompt tokens; the image features without and with positions
        tokens, image_side = ["self_attn/q_proj"], [f"cross_attn_token_to_image/{part}_proj" for part in "vk"]
        self._graphs = [
            graph.until(*(f"{layers[0]}/{module}" for module in modules)) for modules in (tokens, image_side)
        ]
        _relax_shapes(self._graphs[0])
        self._tokens, self._image_side = (one_thread_session(subgraph) for subgraph in self._graphs)
        self.inner = len(self._reads[0].q.bias)
        tokens0, tokens9 = (self._token_rows(np.full((1, 2), position)) for position in (0.0, 9.0))
        is_constant = (tokens0 == tokens9).all(axis=-1).reshape(-1)
        self._iou_token = int(np.argmin(is_constant)) - 5  # SAM 2 has a token for the object score before it
        self.dim = self.inner // heads
        self._fold(graph, layers)

    def _fold(self, graph: DecoderGraph, layers: list[str]) -> None:
        """Multiply consecutive weight matrices, in float64."""
        norms = [graph.norm(f"{layer}/layer_norm4") for layer in layers]
        self._eps = norms[0].eps
        (g1, b1), (g2, b2) = ((wide(norm.scale), wide(norm.shift)) for norm in norms)
        # output projections of values (inner, channels): before and after the next layer norm
        out0, out1 = (centred(wide(update.out.weight).T, 1) for update in self._updates)
        scaled = out0 * g1
        both = np.concatenate([centred(scaled, 1), out1])
        finer = both * g2
        self._g1, self._b1, self._g2, self._b2 = map(single, (g1, b1, g2, b2))
        self._out0, self._out1, self._both = single(out0), single(out1), single(both)
        self._bias0 = single(centred(wide(self._updates[0].out.bias)))
        self._bias1 = single(centred(b1 + wide(self._updates[1].out.bias)))
        self._gram0, self._gram1 = single(out0 @ out0.T), single(both @ both.T)
        read1, read2, update1 = self._reads[1], self._reads[2], self._updates[1]
        self._low_read1 = single(wide(read1.k.weight) @ scaled.T)
        self._values1 = single(scaled @ read1.v.weight.T)
        self._low_update1 = single(wide(update1.q.weight) @ scaled.T)
        self._low_read2 = single(wide(read2.k.weight) @ finer.T)
        self._values2 = single(finer @ read2.v.weight.T)
        # rows are (dy, dx, channel) and centred, so that the mean in the upscaling's layer norm is 0
        weight, bias = map(wide, graph.upscaling("mask_decoder/upscale_conv1"))
        bias = np.tile(centred(bias), 4)
        upscale = centred(weight.transpose(2, 3, 1, 0), 2).reshape(-1, len(weight))
        self._upscale, self._factor_masks = single(upscale), single(finer @ upscale.T)
        second, second_bias = graph.upscaling("mask_decoder/upscale_conv2")
        norm = graph.norm("mask_decoder/upscale_layer_norm")
        self._upscale_eps = norm.eps
        self._upscaling = kernels.Upscaling(
            norm_scale=norm.scale,
            norm_shift=norm.shift,
            fixed=single(upscale @ b2 + bias),
            second=np.ascontiguousarray(second.transpose(2, 3, 1, 0)).reshape(-1),
            bias=second_bias,
        )

    def image(self, features: Mapping[str, Array]) -> ImageTerms:
        """Compute the terms shared by all prompts from an encoder's outputs (float32, by name).

        A ModelError is raised if the image embedding cannot be divided into blocks.
        """
        sides = self._image_sides(features)
        x, with_positions = (wide(side.reshape(side.shape[-2:]).T) for side in sides)  # (channels, pixels)
        pe = with_positions - x
        side = features.get("image_embeddings", features.get("image_embeddings.2"))
        assert side is not None
        pixels = min(BLOCK, x.shape[1])
        if x.shape[1] % pixels or pixels % WIDTH:
            raise ModelError(f"the decoder cannot be factored for image features of shape {side.shape[2:]}")
        read0, read1, read2 = self._reads
        update0, update1 = self._updates
        xc = centred(x, 0)
        gx = xc * self._g1[:, None]
        x1 = centred(gx, 0)
        gx1 = x1 * self._g2[:, None]
        b1, b2 = self._b1[:, None], self._b2[:, None]

        blocks, by_pixel = self._blocks, self._by_pixel

        def projected(layer: Linear, rows: Array) -> Array:
            return wide(layer.weight) @ rows

        def offset(layer: Linear, rows: Array) -> Array:
            return projected(layer, rows) + wide(layer.bias)[:, None]

        first = kernels.FirstLayer(
            queries=blocks(offset(update0.q, x + pe)),
            before=blocks(wide(self._out0) @ xc),
            square=single((xc * xc).sum(axis=0)),
            cross=single(wide(self._bias0) @ xc),
            scaled_keys=blocks(projected(read1.k, gx)),
            fixed_keys=blocks(offset(read1.k, pe + b1)),
            values=by_pixel(projected(read1.v, gx)),
        )
        second = kernels.SecondLayer(
            scaled_queries=blocks(projected(update1.q, gx)),
            fixed_queries=blocks(offset(update1.q, pe + b1)),
            before_first=blocks(wide(self._both[: self.inner]) @ x1),
            before_second=blocks(wide(self._both[self.inner :]) @ x1),
            square=single((x1 * x1).sum(axis=0)),
            cross_first=single(wide(centred(self._g1 * self._bias0)) @ x1),
            cross_second=single(wide(self._bias1) @ x1),
            scaled_keys=blocks(projected(read2.k, gx1)),
            fixed_keys=blocks(offset(read2.k, pe + b2)),
            values=by_pixel(projected(read2.v, gx1)),
        )
        detail = finest = np.zeros(0, np.float32)
        height, width = side.shape[2:]
        if "image_embeddings.0" in features:  # SAM 2
            half = features["image_embeddings.1"][0].reshape(-1, height, 2, width, 2)
            half = ordered(half, 2, 4, 0, 1, 3)
            detail = blocks(centred(wide(half), 2).reshape(-1, height * width))
            whole = features["image_embeddings.0"][0].reshape(-1, height, 2, 2, width, 2, 2)
            finest = blocks(ordered(whole, 2, 5, 3, 6, 0, 1, 4).reshape(-1, height * width))
        return ImageTerms(
            grid_hw=(height, width),
            keys=blocks(offset(read0.k, x + pe)),
            values=by_pixel(offset(read0.v, x)),
            first=first,
            second=second,
            masks=kernels.MaskImage(blocks(wide(self._upscale) @ gx1), detail, finest),
        )

    def decode(
        self, image: ImageTerms, points_xy: Float[np.ndarray, "P 2"], *, fine: bool
    ) -> tuple[Float32[Array, "P 3"], Float32[Array, "P 3 h w"], Kept]:
        """Return predicted IoUs, logits and the arrays that `logits` needs, for one point per prompt.

        Points are inside the object, in px of the network's input. With `fine`, all 4 x 4 logits of each
        pixel of the embedding are computed, otherwise only the first logit.
        """
        pe = self._token_rows(points_xy)
        read0, read1, read2 = self._reads
        update0, update1 = self._updates

        q = self._attend_tokens(0, pe, pe)
        values = self._read_image(image, self._scores(read0.q(q + pe)))
        q = self._perceptron(0, q + read0.out(joined(values)))

        keys0, (change0, last0) = self._scores(update0.k(q + pe)), self._token_values(update0.v(q))
        c0 = self._bias0 + last0 @ self._out0
        d0 = c0 * self._g1
        d0c = centred(d0)
        q = self._attend_tokens(1, q, pe)
        rows = self._scores(read1.q(q + pe))
        first = kernels.FirstPrompts(
            update_keys=keys0,
            twice_changes=2 * change0,
            gram=_between(change0, self._gram0),
            last=last0,
            square=(c0 * c0).sum(axis=1),
            linear=2 * _along(change0, c0 @ self._out0.T),
            queries=rows,
            low=_low(rows, self._low_read1, change0),
            offset=self._offsets(rows, read1.k, [d0]),
        )
        of_factors = _through(change0, self._values1, self.heads)
        s1, e, values = self._update_and_read_first(
            image, first, of_factors, self._split(d0 @ read1.v.weight.T)
        )
        q = self._perceptron(1, q + read1.out(joined(values + self._split(read1.v(self._b1)))))

        keys1, (change1, last1) = self._scores(update1.k(q + pe)), self._token_values(update1.v(q))
        kc = self._bias1 + last1 @ self._out1
        changes = self.xp.concatenate([change0, change1], axis=1)
        d0g, kg = d0c * self._g2, kc * self._g2
        squares = [(x * y).sum(axis=1) for x, y in ((d0c, d0c), (d0c, kc), (kc, kc))]
        rows = self._scores(read2.q(q + pe))
        second = kernels.SecondPrompts(
            update_keys=keys1,
            update_low=_low(keys1, self._low_update1, change0),
            update_offset=self._offsets(keys1, update1.q, [d0]),
            twice_changes=2 * changes,
            linear=2 * self.xp.stack([_along(changes, x @ self._both.T) for x in (d0c, kc)], axis=-1),
            gram=_between(changes, self._gram1),
            last=self.xp.stack([last0, last1], axis=1),
            square=self.xp.stack(squares, axis=1),
            queries=rows,
            low=_low(rows, self._low_read2, changes),
            offset=self._offsets(rows, read2.k, [d0g, kg]),
        )
        of_factors = _through(changes, self._values2, self.heads)
        of_scales = [self._split(x @ read2.v.weight.T) for x in (d0g, kg)]
        s2, e, values = self._update_and_read_second(image, second, s1, e, of_factors, *of_scales)
        q = self._last_norm(q + read2.out(joined(values + self._split(read2.v(self._b2)))))

        iou = _perceptron(self._iou_head, q[:, self._iou_token])[:, 1:]
        if self._iou_sigmoid:
            iou = 1 / (1 + self.xp.exp(-iou))
        first_mask = self._iou_token + 2  # the first of four masks is for unambiguous prompts
        combine = [_perceptron(head, q[:, first_mask + k]) for k, head in enumerate(self._mask_heads)]
        kept = {
            "keys0": keys0,
            "keys1": keys1,
            "low": second.update_low,
            "offset": second.update_offset,
            "s1": s1,
            "s2": s2,
            "changes": changes,
            "both_scales": d0g @ self._upscale.T,
            "second_scale": kg @ self._upscale.T,
            "combine": self.xp.stack(combine, axis=1),
        }
        return single(iou), self._logits(image, kept, e, fine=fine), kept

    def logits(self, image: ImageTerms, kept: Kept) -> Float32[Array, "P 3 h w"]:
        """Compute all logits of previewed prompts."""
        return self._logits(image, kept, self._factors(image, kept), fine=True)

    def _image_sides(self, features: Mapping[str, Array]) -> list[Array]:
        """Return the image features without and with positions, (1, ..., pixels, channels)."""
        return self._run(self._image_side, features, np.zeros((1, 2)))

    def _blocks(self, rows: Float[Array, "r P"]) -> Float32[Array, "*n"]:
        """Return an image array in the order of the kernels."""
        shape = (len(rows), -1, min(BLOCK, rows.shape[1]))
        return np.ascontiguousarray(single(rows).reshape(shape).transpose(1, 0, 2)).reshape(-1)

    def _by_pixel(self, rows: Float64[Array, "HD P"]) -> Float32[Array, "*n"]:
        """Return the image array of an attention's values in the order of the kernels."""
        shape = (self.heads, self.dim, -1, min(BLOCK, rows.shape[1]))
        values = single(rows).reshape(shape).transpose(2, 0, 3, 1)
        return np.pad(values, [(0, 0)] * 3 + [(0, up(self.dim) - self.dim)]).reshape(-1)

    def _read_image(self, image: ImageTerms, rows: Array) -> Float32[Array, "n H T D"]:
        """Compute the first token-to-pixel attention."""
        sizes = self._sizes(image, *rows.shape[::2])
        sums = PixelSums(sizes, 0)
        kernels.read_image(sizes, flat(rows), image.keys, image.values, sums.top, sums.sums)
        return sums.values()

    def _update_and_read_first(
        self, image: ImageTerms, prompts: kernels.FirstPrompts, *parts: Array
    ) -> tuple[Array, Array, Array]:
        """Compute the first pixel-to-token attention, its layer norm, and the attention that follows.

        `parts` are the values of the factors and of the pixels' scales (`PixelSums.values`). Returns the
        scales (n, P), scaled factors, and values of the tokens (n, H, T, D).
        """
        number, _, tokens, _ = prompts.update_keys.shape
        sizes, factors = self._sizes(image, number, tokens), self.heads * (tokens - 1)
        offset = np.concatenate([prompts.offset, np.zeros_like(prompts.offset)], axis=-1)
        prompts = prompts._replace(gram=doubled_below(prompts.gram), offset=offset)
        sums, s1 = PixelSums(sizes, factors), self._scales(image, number)
        e = np.empty(s1.size * up(factors), np.float32)
        kernels.update_and_read_first(
            sizes, len(self._bias0), self._eps, image.first, kernels.FirstPrompts(*map(flat, prompts)),
            sums.top, sums.sums, s1.reshape(-1), e,
        )  # fmt: skip
        return s1, e, sums.values(*parts)

    def _update_and_read_second(
        self, image: ImageTerms, prompts: kernels.SecondPrompts, s1: Array, e: Array, *parts: Array
    ) -> tuple[Array, Array, Array]:
        """Compute the second layer and the last attention; arguments as in `_update_and_read_first`."""
        number, _, tokens, _ = prompts.update_keys.shape
        sizes, factors = self._sizes(image, number, tokens), 2 * self.heads * (tokens - 1)
        prompts = prompts._replace(gram=doubled_below(prompts.gram))
        sums, s2 = PixelSums(sizes, factors), self._scales(image, number)
        e2 = np.empty(s2.size * up(factors), np.float32)
        kernels.update_and_read_second(
            sizes, len(self._bias0), self._eps, image.second, kernels.SecondPrompts(*map(flat, prompts)),
            s1.reshape(-1), e, sums.top, sums.sums, s2.reshape(-1), e2,
        )  # fmt: skip
        return s2, e2, sums.values(*parts)

    def _scales(self, image: ImageTerms, number: int) -> Array:
        return np.empty((number, image.grid_hw[0] * image.grid_hw[1]), np.float32)

    def _factors(self, image: ImageTerms, kept: Kept) -> Array:
        """Recompute the scaled factors of both layers."""
        number, _, tokens, _ = kept["keys0"].shape
        e = np.empty(kept["s1"].size * up(2 * self.heads * (tokens - 1)), np.float32)
        flats = (flat(kept[name]) for name in ("keys0", "keys1", "low", "offset", "s1", "s2"))
        kernels.rebuild_factors(
            self._sizes(image, number, tokens), image.first.queries, image.second.scaled_queries,
            image.second.fixed_queries, *flats, e,
        )  # fmt: skip
        return e

    def _logits(self, image: ImageTerms, kept: Kept, e: Array, *, fine: bool) -> Array:
        """Compute logits from the scaled factors of the image embedding."""
        changes = kept["changes"]
        number, _, others, _ = changes.shape
        through = changes @ self._factor_masks.reshape(2 * self.heads, self.dim, -1)
        factors = flat(through.reshape(number, 2 * self.heads * others, -1).swapaxes(1, 2))
        height, width = (side * (4 if fine else 1) for side in image.grid_hw)
        out = np.empty((number, kept["combine"].shape[1], height, width), np.float32)
        prompts = kernels.MaskPrompts(
            out.shape[1], factors, *(flat(kept[name]) for name in kernels.MaskPrompts._fields[2:])
        )
        kernels.mask_logits(
            self._sizes(image, number, others + 1), fine, self._upscale_eps, self._upscaling, image.masks,
            prompts, flat(kept["s1"]), flat(kept["s2"]), e, up(2 * self.heads * others), image.grid_hw[1],
            out.reshape(-1),
        )  # fmt: skip
        return out

    def _token_rows(self, points_xy: Float[np.ndarray, "P 2"]) -> Float32[Array, "P T C"]:
        """Return the tokens of each prompt before the first layer."""
        names = [node.name for node in self._tokens.get_inputs() if node.name.startswith("image_")]
        blank = dict.fromkeys(names, np.zeros((1, 1, 1, 1), np.float32))
        (tokens,) = self._run(self._tokens, blank, points_xy)
        return tokens.reshape(len(points_xy), *tokens.shape[-2:])

    def _run(
        self,
        session: onnxruntime.InferenceSession,
        features: Mapping[str, Array],
        points_xy: Float[np.ndarray, "P 2"],
    ) -> list[np.ndarray]:
        """Run a subgraph of the decoder for prompts of one point."""
        feeds = self._network.feeds(features, points_xy[:, None])
        types = {node.name: DTYPES[node.type] for node in session.get_inputs()}
        return session.run(None, {name: np.asarray(feeds[name], dtype) for name, dtype in types.items()})

    def _sizes(self, image: ImageTerms, number: int, tokens: int) -> tuple[int, ...]:
        """Return the sizes that `decoder_kernels.read_image` documents."""
        pixels = image.grid_hw[0] * image.grid_hw[1]
        block = min(BLOCK, pixels)
        return number, pixels // block, self.heads, tokens, self.dim, block, up(self.dim)

    def _attend_tokens(self, layer: int, q: Array, pe: Array) -> Array:
        """Apply a layer's self-attention; the first layer uses neither positions nor a residual."""
        attention, norm = self._self[layer], self._norms[layer][0]
        x = q + pe if layer else q
        queries, keys, values = map(self._split, (attention.q(x), attention.k(x), attention.v(q)))
        scores = queries @ keys.swapaxes(2, 3) / np.float32(queries.shape[3] ** 0.5)
        update = attention.out(joined(self._softmax(scores) @ values))
        return norm(q + update if layer else update)

    def _softmax(self, scores: Array) -> Array:
        weights = np.exp(scores - scores.max(axis=3, keepdims=True))
        return weights / weights.sum(axis=3, keepdims=True)

    def _perceptron(self, layer: int, q: Array) -> Array:
        """Apply the two norms after a layer's attention to the image, and the perceptron between them."""
        _, norm, last_norm = self._norms[layer]
        q = norm(q)
        return last_norm(q + _perceptron(self._mlps[layer], q))

    def _split(self, x: Float32[Array, "*n i"]) -> Float32[Array, "n H T D"]:
        """Split heads: (n, T, H D) -> (n, H, T, D); one vector per prompt (n, H D) counts as one token."""
        if x.ndim < 3:
            x = x.reshape(-1, 1, x.shape[-1])
        return x.reshape(*x.shape[:2], self.heads, -1).swapaxes(1, 2)

    def _scores(self, x: Float32[Array, "n T i"]) -> Float32[Array, "n H T D"]:
        """Scale queries or keys of tokens so that their products with pixels are scores."""
        return self._split(x) * (self.score_scale / np.float32(self.dim**0.5))

    def _token_values(self, x: Float32[Array, "n T i"]) -> tuple[Array, Array]:
        """Return tokens' values minus the last token's (n, H, T - 1, D), and the last token's (n, H D)."""
        values = self._split(x)
        return values[:, :, :-1] - values[:, :, -1:], contiguous(x[:, -1])

    def _offsets(self, rows: Array, layer: Linear, vectors: list[Array]) -> Array:
        """Return products of rows with projected vectors (n, C): (n, H, T, D) -> (n, H, T, vectors)."""
        number, heads, _, dim = rows.shape
        projected = [(vector @ layer.weight.T).reshape(number, heads, dim, 1) for vector in vectors]
        return self.xp.concatenate([rows @ vector for vector in projected], axis=-1)


class PixelSums:
    """Running sums of a token-to-pixel attention with factors (`decoder_kernels.pixel_weights`)."""

    def __init__(self, sizes: tuple[int, ...], factors: int) -> None:
        rows = sizes[0] * sizes[2] * sizes[3]
        width = sizes[6] + up(factors) + WIDTH
        self.sizes, self.factors = sizes, factors
        self.top, self.sums = np.empty(rows, np.float32), np.empty(rows * width, np.float32)

    def values(self, factor_values: Array | None = None, *scale_values: Array) -> Float32[Array, "n H T D"]:
        """Return the weighted means of the pixels' values.

        Factors have values (n, H, F, D); the pixels' scales multiply `scale_values` (n, H, 1, D).
        """
        number, _, heads, tokens, dim, _, depth = self.sizes
        sums = self.sums.reshape(number, heads, tokens, -1)
        values = sums[..., :dim]
        if factor_values is not None:
            values = values + sums[..., depth : depth + self.factors] @ factor_values
        total, *scales = (sums[..., k, None] for k in range(-WIDTH, -WIDTH + 3))
        for scale, value in zip(scales, scale_values, strict=False):
            values = values + scale * value
        return values / total


def _relax_shapes(graph: Graph) -> None:
    """Remove the declared shapes of the image features; the tokens depend only on the number of images."""
    for value in graph.model.graph.input:
        if value.name.startswith("image_"):
            for side in value.type.tensor_type.shape.dim:
                side.Clear()


def _perceptron(layers: list[Linear], x: Array) -> Array:
    """Apply linear layers with ReLUs between them."""
    for layer in layers[:-1]:
        x = layer(x).clip(0, None)
    return layers[-1](x)


def _along(changes: Float32[Array, "n K J D"], vectors: Float32[Array, "n KD"]) -> Array:
    """Return the product of each change with its head's part of a vector, (n, K, J)."""
    number, heads, _, dim = changes.shape
    return (changes @ vectors.reshape(number, heads, dim, 1))[..., 0]


def _low(rows: Array, base: Float32[Array, "HD KD"], changes: Array) -> Array:
    """Return rows^T base changes for all pairs: (n, H, T, D), (n, K, J, D) -> (n, H, T, K, J)."""
    number, heads, tokens, dim = rows.shape
    kinds = changes.shape[1]
    left = (rows @ base.reshape(heads, dim, -1)).reshape(number, heads, tokens, kinds, dim)
    right = changes[:, None].swapaxes(3, 4)  # (n, 1, K, D, J)
    return (left.swapaxes(2, 3) @ right).swapaxes(2, 3)


def _between(changes: Float32[Array, "n K J D"], base: Float32[Array, "KD KD"]) -> Array:
    """Return changes^T base changes for all pairs, (n, K J, K J)."""
    number, heads, others, _ = changes.shape
    return _low(changes, base, changes).reshape(number, heads * others, -1)


def _through(changes: Array, base: Float32[Array, "KD HD"], heads: int) -> Array:
    """Multiply changes by a matrix and split heads: (n, K, J, D) -> (n, H, K J, D)."""
    number, kinds, others, dim = changes.shape
    products = changes @ base.reshape(kinds, dim, -1)
    return products.reshape(number, kinds * others, heads, -1).swapaxes(1, 2)


def doubled_below(gram: Float32[np.ndarray, "n F F"]) -> Float32[np.ndarray, "n F F"]:
    """Return lower triangular matrices with the same quadratic forms as the symmetric `gram`."""
    return 2 * np.tril(gram, -1) + gram * np.eye(gram.shape[-1], dtype=np.float32)


def joined(x: Float32[Array, "n H T D"]) -> Float32[Array, "n T HD"]:
    return x.swapaxes(1, 2).reshape(x.shape[0], x.shape[2], -1)


def wide(x: Array) -> Array:
    return x.astype(np.float64) if isinstance(x, np.ndarray) else x.double()


def single(x: Array) -> Array:
    return x.astype(np.float32) if isinstance(x, np.ndarray) else x.float()


def contiguous(x: Array) -> Array:
    return np.ascontiguousarray(x) if isinstance(x, np.ndarray) else x.contiguous()


def ordered(x: Array, *axes: int) -> Array:
    return x.transpose(axes) if isinstance(x, np.ndarray) else x.permute(axes)


def centred(x: Array, axis: int = -1) -> Array:
    return x - x.mean(axis=axis, keepdims=True)


def flat(x: Array) -> Float32[np.ndarray, " n"]:
    """Return a contiguous, flat float32 array, as the kernels expect."""
    return np.ascontiguousarray(x, np.float32).reshape(-1)


def up(number: int) -> int:
    return -(-number // WIDTH) * WIDTH  # the next multiple of the SIMD width
