"""Compiled loops of the factored decoder (`factored_decoder`), one block of pixels at a time.

Arrays are flat float32. Image arrays are stored block by block, each block as (rows, BLOCK) with pixels
last, or with pixels first where a sum runs over pixels. H: heads; T: tokens; D: channels of a head; P: pixels
of a block. A prompt has H (T - 1) factors per layer: each head's softmax weights of all tokens but the last.
"""

from collections import namedtuple
from typing import NamedTuple

import numpy as np

from cpusplat.compiled import compiled
from cpusplat.lane_products import MAX_ROWS, WIDE_COLUMNS, rows_of_products
from cpusplat.lanes import (
    WIDTH,
    exp2_negative,
    lane_max,
    lane_sum,
    lanes,
    larger,
    load,
    load_same,
    reciprocal,
    root,
    store,
    transpose,
)

LEAST = np.float32(-126)  # lowest exponent of a normal float32
one_row, three_rows, four_rows, six_rows, seven_rows, eight_rows = map(rows_of_products, (1, 3, 4, 6, 7, 8))

ZERO, ONE, TWO = np.float32(0), np.float32(1), np.float32(2)


class FirstLayer(NamedTuple):
    """Image arrays of the first layer, block by block."""

    queries: np.ndarray  # queries of the pixel-to-token attention
    before: np.ndarray  # products of the pixels' features with the output projection of the values
    square: np.ndarray  # squared length of each pixel's features
    cross: np.ndarray  # products of the pixels' features with the bias that is added to them
    scaled_keys: np.ndarray  # keys of the token-to-pixel attention: the part scaled by the layer norm
    fixed_keys: np.ndarray
    values: np.ndarray  # values of the token-to-pixel attention, before the layer norm's scale


class FirstPrompts(NamedTuple):
    """Prompt arrays of the first layer."""

    update_keys: np.ndarray  # keys of the pixel-to-token attention
    twice_changes: np.ndarray  # twice the difference between each token's values and the last token's
    gram: np.ndarray  # products of these differences after the output projection (`doubled_below`)
    last: np.ndarray  # values of the last token
    square: np.ndarray  # squared length of the constant that the last token and the bias add to every pixel
    linear: np.ndarray  # twice the products of that constant with the differences
    queries: np.ndarray  # queries of the token-to-pixel attention
    low: np.ndarray  # products of `queries` with the keys of the factors
    offset: np.ndarray  # products of `queries` with the keys of that constant


SecondLayer = namedtuple(
    "SecondLayer",
    "scaled_queries fixed_queries before_first before_second square cross_first cross_second "
    "scaled_keys fixed_keys values",
)
"""Image arrays of the second layer; names as in `FirstLayer`. Queries and products have
two parts, for the values of the first and of the second layer."""
SecondPrompts = namedtuple(
    "SecondPrompts",
    "update_keys update_low update_offset twice_changes linear gram last square queries low offset",
)
"""Prompt arrays of the second layer; names as in `FirstPrompts`."""


Upscaling = namedtuple("Upscaling", "norm_scale norm_shift fixed second bias")
"""Weights of the two upscalings and of the layer norm between them."""
MaskImage = namedtuple("MaskImage", "scaled detail finest")
"""Image arrays for mask logits: the upscaled image embedding, and the finer features of SAM 2."""


class MaskPrompts(NamedTuple):
    """Prompt arrays for mask logits."""

    masks: int  # per prompt
    factors: np.ndarray  # after the first upscaling
    both_scales: np.ndarray  # constants of the first layer after the first upscaling
    second_scale: np.ndarray  # constants of the second layer after the first upscaling
    combine: np.ndarray  # channel weights of each mask


@compiled
def multiply(y, y0, y_step, a, a0, a_step, x, x0, x_step, rows, inner, columns, begin):
    """Compute y[r, c] = sum over k of a[r, k] x[k, c]; unless `begin`, add the sum to y[r, c] instead.

    Each flat array comes with the index of its first element and a row stride. `columns`: multiple of 16.
    """
    c = 0
    while c < columns:
        wide = c + WIDE_COLUMNS <= columns
        r = 0
        while r < rows:
            left = rows - r
            to, of, at = y0 + r * y_step + c, a0 + r * a_step, x0 + c
            if left >= 8 and MAX_ROWS == 8:
                eight_rows(y, to, y_step, a, of, a_step, x, at, x_step, inner, begin, wide)
                r += 8
            elif left == 7 and MAX_ROWS == 8:
                seven_rows(y, to, y_step, a, of, a_step, x, at, x_step, inner, begin, wide)
                r += 7
            elif left == 6 or left > 8:
                six_rows(y, to, y_step, a, of, a_step, x, at, x_step, inner, begin, wide)
                r += 6
            elif left >= 4:
                four_rows(y, to, y_step, a, of, a_step, x, at, x_step, inner, begin, wide)
                r += 4
            elif left == 3:
                three_rows(y, to, y_step, a, of, a_step, x, at, x_step, inner, begin, wide)
                r += 3
            else:
                one_row(y, to, y_step, a, of, a_step, x, at, x_step, inner, begin, wide)
                r += 1
        c += WIDE_COLUMNS if wide else WIDTH


@compiled
def linear(x, weights, bias, rows, inner, y):
    """Compute y (rows, outer) = x (rows, inner) W + bias; outer is a multiple of 16.

    `weights` contains W in panels of 16 columns, each (inner, 16).
    """
    outer = len(bias)
    for r in range(rows):
        for c in range(0, outer, WIDTH):
            store(y, r * outer + c, load(bias, c))
    for c in range(0, outer, WIDTH):
        multiply(y, c, outer, x, 0, inner, weights, c * inner, WIDTH, rows, inner, WIDTH, False)


@compiled
def dense(y, y0, a, a0, x, x0, rows, inner, columns, begin):
    """Run `multiply` with contiguous matrices."""
    multiply(y, y0, columns, a, a0, inner, x, x0, columns, rows, inner, columns, begin)


@compiled
def by_head(y, y0, a, a0, x, x0, heads, rows, inner, columns):
    """Run `dense` for each head."""
    for h in range(heads):
        to, of, at = y0 + h * rows * columns, a0 + h * rows * inner, x0 + h * inner * columns
        dense(y, to, a, of, x, at, rows, inner, columns, True)


@compiled
def multiply_below(y, y_step, a, a0, x, rows, columns):
    """Add to `y` the product of a square matrix's lower triangle and `x`."""
    for r in range(0, rows, MAX_ROWS):
        many = min(MAX_ROWS, rows - r)
        multiply(y, r * y_step, y_step, a, a0 + r * rows, rows, x, 0, y_step, many, r + many, columns, False)


@compiled
def scale_and_shift(y, x, x0, scale, shift, shift0, rows, pixels):
    """Compute y = scale * x + shift for rows of pixels; `scale` is one row."""
    for c in range(0, pixels, WIDTH):
        factor = load(scale, c)
        for r in range(rows):
            at = r * pixels + c
            store(y, at, factor * load(x, x0 + at) + load(shift, shift0 + at))


@compiled
def token_shares(s, offset, offset0, scale, heads, tokens, pixels, e, e0):
    """Compute each head's softmax over the tokens at each pixel; the last token's share is omitted.

    `offset[h, t] * scale[p]` is added to the base-2 scores `s` (H, T, P), which are overwritten; the result
    is `e` (H, T - 1, P).
    """
    for h in range(heads):
        for c in range(0, pixels, WIDTH):
            factor = load(scale, c)
            most = lanes(np.float32(-1e30))
            for t in range(tokens):
                at = (h * tokens + t) * pixels + c
                value = load(s, at) + load_same(offset, offset0 + h * tokens + t) * factor
                store(s, at, value)
                most = larger(most, value)
            total = lanes(ZERO)
            for t in range(tokens):
                at = (h * tokens + t) * pixels + c
                value = exp2_negative(larger(load(s, at) - most, lanes(LEAST)))
                store(s, at, value)
                total = total + value
            total = reciprocal(total)
            for t in range(tokens - 1):
                value = load(s, (h * tokens + t) * pixels + c) * total
                store(e, e0 + (h * (tokens - 1) + t) * pixels + c, value)


@compiled
def pixel_weights(s, scaled, offset, offset0, u, v, top, top0, sums, sums0, width, rows, pixels):
    """Compute the weights of a block's pixels in softmaxes over all pixels, and update the running sums.

    The maximum score over all blocks is known only at the end, so the running sums are scaled down whenever
    a block contains a new maximum.

    Args:
        s: base-2 scores (rows, P), overwritten by weights.
        scaled: weights times `u`.
        offset: (rows, 2); `offset[r, 0] * u[p] + offset[r, 1] * v[p]` is added to the scores.
        top: largest score of each row so far.
        sums: (rows, width); the last 16 columns begin with the sums of weights, weights * u and weights * v.
    """
    for r in range(rows):
        first, second = load_same(offset, offset0 + 2 * r), load_same(offset, offset0 + 2 * r + 1)
        most = lanes(np.float32(-1e30))
        for c in range(r * pixels, (r + 1) * pixels, WIDTH):
            p = c - r * pixels
            value = load(s, c) + first * load(u, p) + second * load(v, p)
            store(s, c, value)
            most = larger(most, value)
        highest = lane_max(most)
        end = sums0 + (r + 1) * width
        before = top[top0 + r]
        if highest > before:
            shrink = lanes(np.float32(2.0 ** max(before - highest, LEAST)))
            for c in range(sums0 + r * width, end, WIDTH):
                store(sums, c, load(sums, c) * shrink)
            top[top0 + r] = highest
        else:
            highest = before
        total = by_u = by_v = lanes(ZERO)
        for c in range(r * pixels, (r + 1) * pixels, WIDTH):
            p = c - r * pixels
            value = exp2_negative(larger(load(s, c) - lanes(highest), lanes(LEAST)))
            store(s, c, value)
            total = total + value
            with_u = value * load(u, p)
            store(scaled, c, with_u)
            by_u = by_u + with_u
            by_v = by_v + value * load(v, p)
        sums[end - WIDTH] += lane_sum(total)
        sums[end - WIDTH + 1] += lane_sum(by_u)
        sums[end - WIDTH + 2] += lane_sum(by_v)


@compiled
def weighted_sums(sums, sums0, width, weights, values, values0, heads, tokens, pixels, depth):
    """Add a block to the sums over pixels (H * T, width) of values (H, P, depth) by weights (H * T, P)."""
    for h in range(heads):
        multiply(
            sums, sums0 + h * tokens * width, width, weights, h * tokens * pixels, pixels,
            values, values0 + h * pixels * depth, depth, tokens, pixels, depth, False,
        )  # fmt: skip


@compiled
def read_image(sizes, rows, keys, values, top, sums):
    """Compute the first token-to-pixel attention, whose keys and values depend on the image only.

    Args:
        sizes: prompts, blocks, H, T, D, P, depth.
        rows: token queries (prompts, H, T, D), times log2(e).
        keys: (blocks, H, D, P).
        values: (blocks, H, P, depth).
        top, sums: as in `pixel_weights`, (prompts, H * T) and (prompts, H * T, depth + 16); overwritten.
    """
    number, blocks, heads, tokens, dim, pixels, depth = sizes
    all_rows, width = heads * tokens, depth + WIDTH
    s, scaled = np.empty(all_rows * pixels, np.float32), np.empty(all_rows * pixels, np.float32)
    ones, none = np.ones(pixels, np.float32), np.zeros(2 * all_rows, np.float32)
    zeros = np.zeros(pixels, np.float32)
    top[:], sums[:] = np.float32(-1e30), ZERO
    for b in range(blocks):
        for i in range(number):
            base = b * heads * dim * pixels
            by_head(s, 0, rows, i * all_rows * dim, keys, base, heads, tokens, dim, pixels)
            at = i * all_rows * width
            pixel_weights(
                s, scaled, none, 0, ones, zeros, top, i * all_rows, sums, at, width, all_rows, pixels
            )
            weighted_sums(
                sums, at, width, s, values, b * heads * pixels * depth, heads, tokens, pixels, depth
            )


@compiled
def first_factors(sizes, b, i, rows, queries, s, e, none, ones):
    """Compute each token's share in each pixel at the first layer (H, T - 1, P)."""
    _, _, heads, tokens, dim, pixels, _ = sizes
    base = b * heads * dim * pixels
    by_head(s, 0, rows, i * heads * tokens * dim, queries, base, heads, tokens, dim, pixels)
    token_shares(s, none, 0, ones, heads, tokens, pixels, e, 0)


@compiled
def second_factors(sizes, b, i, rows, low, offset, scaled_q, fixed_q, s1, q, s, e):
    """Write the second layer's shares to `e`, in the rows that follow those of the first layer."""
    _, _, heads, tokens, dim, pixels, _ = sizes
    all_rows, factors = heads * tokens, heads * (tokens - 1)
    base = b * heads * dim * pixels
    scale_and_shift(q, scaled_q, base, s1, fixed_q, base, heads * dim, pixels)
    by_head(s, 0, rows, i * all_rows * dim, q, 0, heads, tokens, dim, pixels)
    dense(s, 0, low, i * all_rows * factors, e, 0, all_rows, factors, pixels, False)
    token_shares(s, offset, i * all_rows, s1, heads, tokens, pixels, e, factors * pixels)


@compiled
def read_by_factors(sizes, b, i, image, prompt, u, v, factors, padded, e, e_t, k, s, scaled, top, sums):
    """Add a block to a token-to-pixel attention whose keys and values are sums of factored terms.

    Args:
        sizes, b, i: as in `read_image`; indices of block and prompt.
        image, prompt: arrays of the first or second layer; `u` scales the image's keys and values.
        u, v: scales of the pixels (P), as in `pixel_weights`.
        e: factors (padded, P); only the first `factors` rows are used.
        e_t, k, s, scaled: buffers for transposed factors, keys, scores and weights; overwritten.
        top, sums: as in `pixel_weights`; a row of `sums` begins with the sums of values, then of factors.
    """
    _, _, heads, tokens, dim, pixels, depth = sizes
    all_rows, base = heads * tokens, b * heads * dim * pixels
    width = depth + padded + WIDTH
    at = i * all_rows * width
    scale_and_shift(k, image.scaled_keys, base, u, image.fixed_keys, base, heads * dim, pixels)
    by_head(s, 0, prompt.queries, i * all_rows * dim, k, 0, heads, tokens, dim, pixels)
    dense(s, 0, prompt.low, i * all_rows * factors, e, 0, all_rows, factors, pixels, False)
    pixel_weights(
        s, scaled, prompt.offset, 2 * i * all_rows, u, v, top, i * all_rows, sums, at, width, all_rows, pixels
    )
    weighted_sums(
        sums, at, width, scaled, image.values, b * heads * pixels * depth, heads, tokens, pixels, depth
    )
    for r in range(0, padded, WIDTH):
        for c in range(0, pixels, WIDTH):
            transpose(e, r * pixels + c, pixels, e_t, c * padded + r, padded)
    multiply(sums, at + depth, width, s, 0, pixels, e_t, 0, padded, all_rows, pixels, padded, False)


@compiled
def update_and_read_first(sizes, channels, eps, image, prompt, top, sums, s1_out, e_out):
    """Compute the first pixel-to-token attention, its layer norm, and the second token-to-pixel attention.

    Args:
        sizes: as in `read_image`.
        channels, eps: parameters of the layer norm.
        image, prompt: `FirstLayer`, `FirstPrompts`.
        top, sums: as in `pixel_weights`; sums (prompts, H * T, depth + padded + 16); overwritten.
        s1_out: layer norm scale of each pixel (prompts, blocks, P).
        e_out: factors times the scale in `s1_out` (prompts, blocks, padded, P).
    """
    number, blocks, heads, tokens, dim, pixels, _ = sizes
    all_rows, factors = heads * tokens, heads * (tokens - 1)
    padded = (factors + WIDTH - 1) // WIDTH * WIDTH
    s, scaled = np.empty(all_rows * pixels, np.float32), np.empty(all_rows * pixels, np.float32)
    e, e_t = np.zeros(padded * pixels, np.float32), np.empty(padded * pixels, np.float32)
    y, k = np.empty(factors * pixels, np.float32), np.empty(heads * dim * pixels, np.float32)
    last, s1 = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    ones, zeros = np.ones(pixels, np.float32), np.zeros(pixels, np.float32)
    none = np.zeros(all_rows, np.float32)
    top[:], sums[:] = np.float32(-1e30), ZERO
    share, small = lanes(np.float32(1 / channels)), lanes(np.float32(eps))
    for b in range(blocks):
        base = b * heads * dim * pixels
        for i in range(number):
            first_factors(sizes, b, i, prompt.update_keys, image.queries, s, e, none, ones)
            changes, rows = prompt.twice_changes, tokens - 1
            by_head(y, 0, changes, i * factors * dim, image.before, base, heads, rows, dim, pixels)
            multiply_below(y, pixels, prompt.gram, i * factors * factors, e, factors, pixels)
            dense(last, 0, prompt.last, i * heads * dim, image.before, base, 1, heads * dim, pixels, True)
            for c in range(0, pixels, WIDTH):
                p = b * pixels + c
                total = load(image.square, p) + load_same(prompt.square, i)
                total = total + lanes(TWO) * (load(image.cross, p) + load(last, c))
                for f in range(factors):
                    term = load(y, f * pixels + c) + load_same(prompt.linear, i * factors + f)
                    total = total + load(e, f * pixels + c) * term
                scale = lanes(ONE) / root(total * share + small)
                store(s1, c, scale)
                store(s1_out, (i * blocks + b) * pixels + c, scale)
                for f in range(factors):
                    value = load(e, f * pixels + c) * scale
                    store(e, f * pixels + c, value)
                    store(e_out, ((i * blocks + b) * padded + f) * pixels + c, value)
            read_by_factors(
                sizes, b, i, image, prompt, s1, zeros, factors, padded, e, e_t, k, s, scaled, top, sums
            )


@compiled
def update_and_read_second(sizes, channels, eps, image, prompt, s1_in, e_in, top, sums, s2_out, e_out):
    """Compute the second pixel-to-token attention, its layer norm, and the final token-to-pixel attention.

    Args:
        image, prompt: `SecondLayer`, `SecondPrompts`.
        s1_in, e_in: outputs of `update_and_read_first`.
        s2_out: layer norm scale of each pixel (prompts, blocks, P).
        e_out: factors of both layers times the scale in `s2_out` (prompts, blocks, padded, P).
    """
    number, blocks, heads, tokens, dim, pixels, _ = sizes
    all_rows, factors = heads * tokens, heads * (tokens - 1)
    padded_in = (factors + WIDTH - 1) // WIDTH * WIDTH
    both = 2 * factors
    padded = (both + WIDTH - 1) // WIDTH * WIDTH
    s, scaled = np.empty(all_rows * pixels, np.float32), np.empty(all_rows * pixels, np.float32)
    e, e_t = np.zeros(padded * pixels, np.float32), np.empty(padded * pixels, np.float32)
    y, k = np.empty(both * pixels, np.float32), np.empty(heads * dim * pixels, np.float32)
    last, late = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    s1, s2 = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    s12 = np.empty(pixels, np.float32)
    top[:], sums[:] = np.float32(-1e30), ZERO
    share, small, two = lanes(np.float32(1 / channels)), lanes(np.float32(eps)), lanes(TWO)
    for b in range(blocks):
        base = b * heads * dim * pixels
        for i in range(number):
            at = (i * blocks + b) * pixels
            s1[:] = s1_in[at : at + pixels]
            e[: factors * pixels] = e_in[at * padded_in : at * padded_in + factors * pixels]
            second_factors(
                sizes, b, i, prompt.update_keys, prompt.update_low, prompt.update_offset,
                image.scaled_queries, image.fixed_queries, s1, k, s, e,
            )  # fmt: skip
            at_first, at_second = i * both * dim, (i * both + factors) * dim
            changes, rows, half = prompt.twice_changes, tokens - 1, factors * pixels
            by_head(y, 0, changes, at_first, image.before_first, base, heads, rows, dim, pixels)
            by_head(y, half, changes, at_second, image.before_second, base, heads, rows, dim, pixels)
            for c in range(0, pixels, WIDTH):
                scale = load(s1, c)
                for f in range(both):
                    term = load(y, f * pixels + c) + load_same(prompt.linear, 2 * (i * both + f))
                    store(y, f * pixels + c, scale * term + load_same(prompt.linear, 2 * (i * both + f) + 1))
            multiply_below(y, pixels, prompt.gram, i * both * both, e, both, pixels)
            inner, at_last = heads * dim, 2 * i * heads * dim
            dense(last, 0, prompt.last, at_last, image.before_first, base, 1, inner, pixels, True)
            dense(late, 0, prompt.last, at_last + inner, image.before_second, base, 1, inner, pixels, True)
            for c in range(0, pixels, WIDTH):
                p = b * pixels + c
                scale = load(s1, c)
                # square: |a|^2, a b and |b|^2; the first scale multiplies a, but not b
                total = load(image.square, p) + load_same(prompt.square, 3 * i)
                total = total + two * (load(image.cross_first, p) + load(last, c))
                total = total * scale
                mixed = load(image.cross_second, p) + load(late, c) + load_same(prompt.square, 3 * i + 1)
                total = (total + two * mixed) * scale + load_same(prompt.square, 3 * i + 2)
                for f in range(both):
                    total = total + load(e, f * pixels + c) * load(y, f * pixels + c)
                second = lanes(ONE) / root(total * share + small)
                store(s2, c, second)
                store(s12, c, second * scale)
                store(s2_out, at + c, second)
                for f in range(both):
                    value = load(e, f * pixels + c) * second
                    store(e, f * pixels + c, value)
                    store(e_out, at * padded + f * pixels + c, value)
            read_by_factors(
                sizes, b, i, image, prompt, s12, s2, both, padded, e, e_t, k, s, scaled, top, sums
            )


@compiled
def gelu(x):
    """Return x times the normal CDF at x, within 1e-6 (Abramowitz and Stegun 7.1.26)."""
    size = larger(x, lanes(ZERO) - x)
    t = reciprocal(lanes(ONE) + lanes(np.float32(0.3275911 / 2**0.5)) * size)
    tail = lanes(np.float32(0.5 * 1.061405429)) * t + lanes(np.float32(0.5 * -1.453152027))
    tail = tail * t + lanes(np.float32(0.5 * 1.421413741))
    tail = tail * t + lanes(np.float32(0.5 * -0.284496736))
    tail = tail * t + lanes(np.float32(0.5 * 0.254829592))
    power = larger(size * size * lanes(np.float32(-0.5 / np.log(2))), lanes(LEAST))
    return larger(x, lanes(ZERO)) - size * tail * t * exp2_negative(power)


@compiled
def rebuild_factors(
    sizes, queries, scaled_queries, fixed_queries, keys0, keys1, low, offset, s1_in, s2_in, e_out
):
    """Recompute `e_out` of `update_and_read_second` from the scales that it returned."""
    number, blocks, heads, tokens, dim, pixels, _ = sizes
    all_rows, factors = heads * tokens, heads * (tokens - 1)
    both = 2 * factors
    padded = (both + WIDTH - 1) // WIDTH * WIDTH
    s, e = np.empty(all_rows * pixels, np.float32), np.empty(padded * pixels, np.float32)
    q, ones = np.empty(heads * dim * pixels, np.float32), np.ones(pixels, np.float32)
    none = np.zeros(all_rows, np.float32)
    for b in range(blocks):
        for i in range(number):
            at = (i * blocks + b) * pixels
            s1, s2 = s1_in[at : at + pixels], s2_in[at : at + pixels]
            first_factors(sizes, b, i, keys0, queries, s, e, none, ones)
            for f in range(factors):
                for c in range(0, pixels, WIDTH):
                    store(e, f * pixels + c, load(e, f * pixels + c) * load(s1, c))
            second_factors(sizes, b, i, keys1, low, offset, scaled_queries, fixed_queries, s1, q, s, e)
            for f in range(both):
                for c in range(0, pixels, WIDTH):
                    value = load(e, f * pixels + c) * load(s2, c)
                    store(e_out, at * padded + f * pixels + c, value)


@compiled
def mask_logits(sizes, fine, eps, weights, image, prompt, s1_in, s2_in, e_in, padded, grid_width, out):
    """Compute mask logits from the factors of both layers.

    Args:
        fine: compute all 4 x 4 logits of each pixel of the embedding; otherwise only the first logit.
        eps: epsilon of the layer norm between the two upscalings.
        weights, image, prompt: `Upscaling`, `MaskImage`, `MaskPrompts`.
        e_in, padded: factors times their scales (prompts, blocks, padded, P).
        grid_width: width of the image embedding, pixels.
        out: (prompts, masks, rows, columns), flat.
    """
    number, blocks, heads, tokens, _, pixels, _ = sizes
    both = 2 * heads * (tokens - 1)
    wide, narrow, masks = len(weights.norm_scale), len(weights.bias), prompt.masks
    parts = step = 4 if fine else 1
    out_width = grid_width * step
    out_size = blocks * pixels * step * step
    x, y = np.empty(wide * pixels, np.float32), np.empty(narrow * pixels, np.float32)
    of_cells = np.empty(masks * pixels, np.float32)
    s12, s2 = np.empty(pixels, np.float32), np.empty(pixels, np.float32)
    share, small = lanes(np.float32(1 / wide)), lanes(np.float32(eps))
    for b in range(blocks):
        for i in range(number):
            at = (i * blocks + b) * pixels
            s2[:] = s2_in[at : at + pixels]
            s12[:] = s2 * s1_in[at : at + pixels]
            for big in range(parts):
                row = big * wide
                for c in range(0, pixels, WIDTH):
                    scale, second = load(s12, c), load(s2, c)
                    for f in range(wide):
                        k = i * 4 * wide + row + f
                        index = (b * 4 * wide + row + f) * pixels + c
                        value = scale * (load(image.scaled, index) + load_same(prompt.both_scales, k))
                        value = value + second * load_same(prompt.second_scale, k)
                        value = value + load_same(weights.fixed, row + f)
                        if len(image.detail):
                            value = value + load(image.detail, index)
                        store(x, f * pixels + c, value)
                of = (i * 4 * wide + row) * both
                dense(x, 0, prompt.factors, of, e_in, at * padded, wide, both, pixels, False)
                for c in range(0, pixels, WIDTH):
                    square = lanes(ZERO)
                    for f in range(wide):
                        value = load(x, f * pixels + c)
                        square = square + value * value
                    scale = lanes(ONE) / root(square * share + small)
                    for f in range(wide):
                        value = load(x, f * pixels + c) * scale
                        value = value * load_same(weights.norm_scale, f) + load_same(weights.norm_shift, f)
                        store(x, f * pixels + c, gelu(value))
                for little in range(parts):
                    dense(y, 0, weights.second, little * narrow * wide, x, 0, narrow, wide, pixels, True)
                    for f in range(narrow):
                        for c in range(0, pixels, WIDTH):
                            value = load(y, f * pixels + c) + load_same(weights.bias, f)
                            if len(image.finest):
                                index = ((b * 4 + big) * 4 + little) * narrow + f
                                value = value + load(image.finest, index * pixels + c)
                            store(y, f * pixels + c, gelu(value))
                    dense(of_cells, 0, prompt.combine, i * masks * narrow, y, 0, masks, narrow, pixels, True)
                    shift = (2 * (big // 2) + little // 2) * out_width + 2 * (big % 2) + little % 2
                    for m in range(masks):
                        to = (i * masks + m) * out_size + shift
                        for p in range(pixels):
                            q = b * pixels + p
                            index = to + (q // grid_width) * step * out_width + (q % grid_width) * step
                            out[index] = of_cells[m * pixels + p]
