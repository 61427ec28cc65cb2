"""A small promptable segmenter with SAM's interface: point prompts in, three nested masks out.

Three choices make it trainable in minutes on a CPU, for a world whose classes it has seen: a dense U-shaped
encoder that also predicts the centre of each pixel's region at each level; a decoder that is a tiny pixel
network with weights generated from the prompt (dynamic convolution, CondInst); and stride-2 pixel features
computed by resize and a 3x3 convolution, so that masks have no checkerboard artifacts.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from hilsplat.base.levels import Level

FRAME_PX = 384  # side of the exported model's square input
STRIDE = 4  # image pixels per pixel of the embedding
MASK_STRIDE = 2  # image pixels per pixel of a predicted mask
UNIT_PX = 32.0  # unit of relative coordinates and of offsets to centres
HEADS = (Level.SUBPART, Level.PART, Level.WHOLE)  # order of the three output masks, as in SAM: fine to coarse

PACK = (STRIDE // MASK_STRIDE) ** 2
PIXEL = 24
PACKED = PIXEL * PACK
SEMANTIC = 64
OFFSETS = 2 * len(HEADS)
EMBEDDING = PACKED + OFFSETS + SEMANTIC
FREQUENCIES = 3
POSITIONAL = 2 + 4 * FREQUENCIES
HIDDEN = 16
TOKEN = 160
# Mask rows that the decoder computes at once, an even number. The hidden values of 16 prompts in a band fit
# into a core's cache; for whole masks they do not, and memory access takes longer than the arithmetic.
BAND = 6
STEM = 24
WIDTHS = (64, 128, 192, 256)  # channels at strides 4, 8, 16, 32
DEPTHS = (2, 2, 3, 2)  # residual blocks at the same strides
Embeddings = Float[Tensor, "B C s s"]  # output of the encoder
Positional = Float[Tensor, "B D s s"]  # output of `positional_embeddings`
Place = Float[Tensor, "B C_and_D s s"]  # embeddings and positional embeddings
Shared = Float[Tensor, "B K_and_1 h w"]  # output of `shared_features`
Points = Float[Tensor, "B P N 2"]  # x, y of the points of P prompts, in pixels of the encoder's frame
PointLabels = Int64[Tensor, "B P N"]  # 1 inside the region, 0 outside, negative for padding
Scores = Float[Tensor, "B P 3"]  # predicted IoU of one mask for each of `HEADS`
Logits = Float[Tensor, "B P 3 h w"]  # mask logits at stride 2


def convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """Return a 3x3 convolution with batch normalisation and ReLU."""
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(),
    )


class Residual(nn.Module):
    """Two 3x3 convolutions with a skip connection."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.first = convolution(channels, channels)
        self.second = nn.Sequential(
            nn.Conv2d(channels, channels, 3, padding=1, bias=False), nn.BatchNorm2d(channels)
        )

    def forward(self, x: Float[Tensor, "B C H W"]) -> Float[Tensor, "B C H W"]:
        return functional.relu(x + self.second(self.first(x)))


class SamEncoder(nn.Module):
    """Image encoder, from (B, 3, S, S) to (B, 166, S/4, S/4); S is a multiple of 32.

    Channels of the embedding: 96 for 24 features at stride 2 (pixel-unshuffled, lossless), 6 offsets
    from a pixel to the centre of its region per head (x, y; in units of 32 px), and 64 semantic ones.
    It is computed once per image for all prompts.
    """

    def __init__(self) -> None:
        super().__init__()
        self.stem = convolution(3, STEM, stride=2)
        downs, previous = [], STEM
        for width, depth in zip(WIDTHS, DEPTHS, strict=True):
            downs.append(
                nn.Sequential(
                    convolution(previous, width, stride=2), *(Residual(width) for _ in range(depth))
                )
            )
            previous = width
        self.downs = nn.ModuleList(downs)
        self.laterals = nn.ModuleList(nn.Conv2d(coarse, fine, 1) for fine, coarse in pairwise(WIDTHS))
        self.merges = nn.ModuleList(convolution(width, width) for width in WIDTHS[:-1])
        self.semantic = nn.Conv2d(WIDTHS[0], SEMANTIC, 3, padding=1)
        self.offsets = nn.Sequential(convolution(WIDTHS[0], 48), nn.Conv2d(48, OFFSETS, 1))
        self.coarse = nn.Conv2d(WIDTHS[0], 24, 1)
        self.sharpen = convolution(24 + STEM, 32)
        self.pixel = nn.Conv2d(32, PIXEL, 1)

    def forward(self, pixels: Float[Tensor, "B 3 S S"]) -> Embeddings:
        """Return the embedding at stride 4."""
        return torch.cat(self.features(pixels)[:3], dim=1)

    def features(self, pixels: Float[Tensor, "B 3 S S"]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return the embedding's three channel groups, and the layer before the pixel features (stride 2)."""
        stem = self.stem(pixels)
        pyramid, x = [], stem
        for down in self.downs:
            x = down(x)
            pyramid.append(x)
        for scale in (2, 1, 0):
            up = functional.interpolate(self.laterals[scale](x), scale_factor=2.0, mode="nearest")
            x = self.merges[scale](pyramid[scale] + up)
        enlarged = functional.interpolate(
            self.coarse(x), scale_factor=2.0, mode="bilinear", align_corners=False
        )
        sharp = self.sharpen(torch.cat([enlarged, stem], dim=1))
        packed = functional.pixel_unshuffle(self.pixel(sharp), STRIDE // MASK_STRIDE)
        return packed, self.offsets(x), self.semantic(x), sharp


def positional_embeddings(windows: Float[Tensor, "B 3"], cells: int) -> Float[Tensor, "B C cells cells"]:
    """Return the positional embeddings of `cells` x `cells` cells.

    The first two channels are x and y in the network's input frame (units of 32 px), the others sines and
    cosines of the position in the whole image. `windows` contains x0, y0 and side of each batch row's window
    as shares of the whole image, which is (0, 0, 1).
    """
    steps = (torch.arange(cells, dtype=torch.float32) + 0.5) / cells
    local = steps * (cells * STRIDE / UNIT_PX)
    channels = [
        local[None, None, :].expand(len(windows), cells, cells),
        local[None, :, None].expand(len(windows), cells, cells),
    ]
    x = (windows[:, 0, None] + steps * windows[:, 2, None])[:, None, :].expand(-1, cells, -1)
    y = (windows[:, 1, None] + steps * windows[:, 2, None])[:, :, None].expand(-1, -1, cells)
    for power in range(FREQUENCIES):
        for axis in (x, y):
            angle = axis * (torch.pi * 2**power)
            channels += [torch.sin(angle), torch.cos(angle)]
    return torch.stack(channels, dim=1)


def shared_features(embeddings: Embeddings, positional: Positional) -> Shared:
    """Return the pixel features at stride 2 shared by all prompts of an image; the last is constant 1."""
    pixel = functional.pixel_shuffle(embeddings[:, :PACKED], STRIDE // MASK_STRIDE)
    side = int(embeddings.shape[-1]) * (STRIDE // MASK_STRIDE)
    here = positional[:, :2]
    centres = embeddings[:, PACKED : PACKED + OFFSETS] + here.repeat(1, len(HEADS), 1, 1)
    positions = functional.interpolate(
        torch.cat([here, centres], dim=1), size=(side, side), mode="bilinear", align_corners=False
    )
    squared = positions[:, 2:].square()
    squared = squared[:, 0::2] + squared[:, 1::2]
    return torch.cat([pixel, positions, squared, torch.ones_like(pixel[:, :1])], dim=1)


class SamDecoder(nn.Module):
    """Mask decoder: the weights of a two-layer network at every pixel are generated from the prompt.

    Inputs of the pixel network are 24 shared features, the pixel's position relative to the prompt, and, for
    each head, the offset and squared distance between the region centres predicted at the pixel and at the
    prompt. All are affine in features that prompts share, so the first layer is one matrix product per image.
    """

    def __init__(self) -> None:
        super().__init__()
        self.label = nn.Embedding(3, TOKEN)
        self.point = nn.Linear(EMBEDDING + POSITIONAL - 2, TOKEN)
        self.token = nn.Sequential(nn.ReLU(), nn.Linear(TOKEN, TOKEN), nn.ReLU())
        self.inputs = PIXEL + 2 + OFFSETS + len(HEADS)
        self.sizes = (HIDDEN * self.inputs, HIDDEN, len(HEADS) * HIDDEN, len(HEADS))
        self.weights = nn.Linear(TOKEN, sum(self.sizes))
        self.quality = nn.Sequential(
            nn.Linear(TOKEN + 3 * len(HEADS), 64), nn.ReLU(), nn.Linear(64, len(HEADS))
        )
        with torch.no_grad():
            self.weights.weight.mul_(0.3)
            # Most pixels are outside a mask, so the initial bias is negative.
            self.weights.bias[-len(HEADS) :] = -2.0

    def forward(
        self, points: Points, labels: PointLabels, embeddings: Embeddings, positional: Positional
    ) -> tuple[Scores, Logits]:
        """Return predicted IoU and mask logits."""
        place = torch.cat([embeddings, positional], dim=1)
        return self.masks(points, labels, place, shared_features(embeddings, positional))

    def masks(
        self, points: Points, labels: PointLabels, place: Place, shared: Shared
    ) -> tuple[Scores, Logits]:
        """Compute `forward` from inputs shared by an image's prompts, as in the exported decoder."""
        token, *written = self.written(points, labels, place)
        bands, seen = [], []
        for band in self.bands(written, points, shared, BAND):
            bands.append(band)
            # Every fourth pixel is enough for area and confidence, and takes a quarter of the time.
            seen.append(band[..., ::2, ::2].flatten(3))
        return self.seen_iou(token, torch.cat(seen, dim=-1)), torch.cat(bands, dim=3)

    def preview(
        self, points: Points, labels: PointLabels, place: Place, shared: Shared
    ) -> tuple[Scores, Float[Tensor, "B P 3 half_h half_w"]]:
        """Compute `masks` at every second row and column, in a quarter of the time.

        The predicted IoUs equal those of `masks`, which depend only on these pixels.
        """
        token, *written = self.written(points, labels, place)
        bands = self.bands(written, points, shared[:, :, ::2, ::2], BAND // 2)
        logits = torch.cat(list(bands), dim=3)
        return self.seen_iou(token, logits.flatten(3)), logits

    def bands(
        self, written: Sequence[Tensor], points: Points, shared: Shared, rows: int
    ) -> Iterator[Float[Tensor, "B P 3 rows w"]]:
        """Yield mask logits in bands of `rows` rows, for generated weights from `written`.

        The number of points stays variable in the exported graph.
        """
        first, bias, second, shift = written
        # The bias is the weight of the constant feature 1.
        first = torch.cat([first, bias[..., None]], dim=-1).flatten(1, 2)  # (B, P * H, K + 1)
        side = int(shared.shape[-1])  # constant in the exported graph
        hidden_shape = (points.shape[0], points.shape[1], HIDDEN, -1)
        for band in shared.split(rows, dim=2):
            hidden = functional.relu(torch.matmul(first, band.flatten(2))).reshape(hidden_shape)
            logits = torch.matmul(second, hidden) + shift[..., None]  # (B, P, 3, rows * w)
            yield logits.reshape(*points.shape[:2], len(HEADS), -1, side)

    def seen_iou(self, token: Float[Tensor, "B P T"], sampled: Float[Tensor, "B P 3 n"]) -> Scores:
        """Return `predicted_iou` from every second row and column of a mask."""
        return self.predicted_iou(token, sampled, sampled.new_full((1, 1, 1), 4.0))

    def at_pixels(
        self,
        points: Points,
        labels: PointLabels,
        embeddings: Embeddings,
        positional: Positional,
        pixels: Int64[Tensor, "B P K"],
        weights: Float[Tensor, "B P K"],
    ) -> tuple[Scores, Float[Tensor, "B P 3 K"]]:
        """Compute `forward` at some pixels per prompt for training, in a fraction of the time.

        `pixels` are flat indices into the mask, and `weights` the number of mask pixels that each represents.
        """
        place = torch.cat([embeddings, positional], dim=1)
        token, first, bias, second, shift = self.written(points, labels, place)
        shared = shared_features(embeddings, positional)[:, :-1].flatten(2)
        batch, channels, count = shared.shape
        rows = shared.transpose(1, 2).reshape(batch * count, channels)
        flat = pixels + torch.arange(batch, device=pixels.device)[:, None, None] * count
        chosen = rows.index_select(0, flat.flatten()).view(*pixels.shape, channels)  # (B, P, K, C)
        hidden = functional.relu(torch.matmul(chosen, first.transpose(2, 3)) + bias[:, :, None])
        logits = (torch.matmul(hidden, second.transpose(2, 3)) + shift[:, :, None]).transpose(2, 3)
        return self.predicted_iou(token, logits, weights), logits

    def written(
        self, points: Points, labels: PointLabels, place: Place
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return each prompt's token and its generated weights: matrix and bias of both layers."""
        cells = int(place.shape[-1])  # constant in the exported graph
        grid = points / (cells * STRIDE) * 2 - 1
        sampled = functional.grid_sample(place, grid, padding_mode="border", align_corners=False)
        sampled = sampled.permute(0, 2, 3, 1)  # (B, P, N, C + D)
        valid = (labels >= 0).to(sampled.dtype)[..., None]
        inside = (labels == 1).to(sampled.dtype)[..., None]
        features = torch.cat([sampled[..., :EMBEDDING], sampled[..., EMBEDDING + 2 :]], dim=-1)
        token = self.token[0](self.point(features) + self.label(labels.clamp(-1, 1) + 1)) * valid
        token = self.token[1:](token.sum(dim=2) / valid.sum(dim=2).clamp(min=1.0))  # (B, P, T)

        # The anchor is the prompt's position and the centres predicted there; pixels are compared with it.
        here = sampled[..., EMBEDDING : EMBEDDING + 2]
        centres = sampled[..., PACKED : PACKED + OFFSETS] + here.repeat(1, 1, 1, len(HEADS))
        anchor = torch.cat([here, centres], dim=-1) * inside
        anchor = anchor.sum(dim=2) / inside.sum(dim=2).clamp(min=1.0)  # (B, P, 2 + 6)

        parts = self.weights(token).split(self.sizes, dim=-1)
        first, bias = _around_anchor(parts[0].unflatten(-1, (HIDDEN, self.inputs)), parts[1], anchor)
        return token, first, bias, parts[2].unflatten(-1, (len(HEADS), HIDDEN)), parts[3]

    def predicted_iou(
        self,
        token: Float[Tensor, "B P T"],
        logits: Float[Tensor, "B P 3 n"],
        weights: Float[Tensor, "#B #P #n"],
    ) -> Scores:
        """Estimate each mask's IoU from its area, its confidence and the prompt; no gradient to the mask.

        `logits` are those of some pixels of the mask, and `weights` the number of mask pixels that each
        represents.
        """
        weights = weights[:, :, None]
        share = torch.sigmoid(logits.detach())
        inside = (share > 0.5).to(share.dtype) * weights
        area = inside.sum(dim=-1)
        confidence = (share * inside).sum(dim=-1) / area.clamp(min=1.0)
        blur = (share * (1 - share) * weights).sum(dim=-1) / (area + 1)
        size = (area.sqrt() * (MASK_STRIDE / UNIT_PX)).clamp(max=16.0)
        evidence = torch.cat([token.detach(), size, confidence, blur.clamp(max=4.0)], dim=-1)
        return torch.sigmoid(self.quality(evidence))


def _around_anchor(
    weights: Float[Tensor, "B P H K"], bias: Float[Tensor, "B P H"], anchor: Float[Tensor, "B P 8"]
) -> tuple[Float[Tensor, "B P H K"], Float[Tensor, "B P H"]]:
    """Convert a layer on prompt-relative inputs into the same layer on shared inputs.

    With a the anchor and c a pixel's position, w.(c - a) = w.c - w.a, and
    q |c - a|^2 = q |c|^2 - 2 q a.c + q |a|^2: the squared term only shifts the linear weights.
    """
    linear = weights[..., PIXEL : PIXEL + 2 + OFFSETS]  # (B, P, H, 8)
    square = weights[..., PIXEL + 2 + OFFSETS :]  # (B, P, H, 3)
    near = anchor[:, :, None, :]
    centre = anchor[:, :, None, 2:]
    doubled = square[..., [0, 0, 1, 1, 2, 2]]  # one per x and y of each head's centre
    shifted = torch.cat([linear[..., :2], linear[..., 2:] - 2 * doubled * centre], dim=-1)
    constant = (doubled * centre.square()).sum(dim=-1) - (linear * near).sum(dim=-1)
    return torch.cat([weights[..., :PIXEL], shifted, square], dim=-1), bias + constant
