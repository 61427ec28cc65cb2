"""A small CLIP: crops of masked regions and short phrases in a common space of 128 dimensions."""

from collections.abc import Iterable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int64
from tokenizers import Tokenizer, models, normalizers, pre_tokenizers
from torch import Tensor, nn
from torch.nn import functional

from models.training.sam import Residual, convolution

CROP_PX = 64  # side of the input crops
DIMENSIONS = 128
PAD, UNKNOWN = "[PAD]", "[UNK]"
MAX_WORDS = 16

# generic phrases that relevancy compares queries with (LERF)
CANONICAL = ("object", "things", "stuff", "texture")


def word_tokenizer(phrases: Iterable[str]) -> Tokenizer:
    """Return a tokenizer with one token per lower-case word; id 0 is padding, id 1 any other word."""
    splitter = pre_tokenizers.Whitespace()
    words = sorted({word for phrase in phrases for word, _ in splitter.pre_tokenize_str(phrase.lower())})
    vocabulary = {word: row for row, word in enumerate([PAD, UNKNOWN, *words])}
    tokenizer = Tokenizer(models.WordLevel(vocabulary, unk_token=UNKNOWN))
    tokenizer.normalizer = normalizers.Lowercase()
    tokenizer.pre_tokenizer = splitter
    tokenizer.enable_padding(pad_id=0, pad_token=PAD)
    tokenizer.enable_truncation(MAX_WORDS)
    return tokenizer


class ClipVision(nn.Module):
    """Image encoder, from crops (B, 3, 64, 64) to unit vectors (B, 128)."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            convolution(3, 32, stride=2),
            convolution(32, 64, stride=2),
            Residual(64),
            convolution(64, 128, stride=2),
            Residual(128),
            Residual(128),
            convolution(128, 192, stride=2),
            Residual(192),
            Residual(192),
        )
        self.project = nn.Linear(192, DIMENSIONS)

    def forward(self, pixels: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B D"]:
        """Return the unit vectors of crops."""
        return self.projected(self.layers(pixels))

    def projected(self, features: Float[Tensor, "B C h w"]) -> Float[Tensor, "B D"]:
        """Return unit vectors from the output of `layers` for the crops."""
        return functional.normalize(self.project(features.mean(dim=(2, 3))), dim=-1)


class ClipText(nn.Module):
    """Text encoder, from words (B, W) to unit vectors (B, 128): one attention layer and a mean over words."""

    def __init__(self, num_words: int, width: int = 96) -> None:
        super().__init__()
        self.words = nn.Embedding(num_words, width)
        self.attend = nn.Linear(width, 3 * width)
        self.hidden = nn.Sequential(nn.Linear(width, 2 * width), nn.ReLU(), nn.Linear(2 * width, width))
        self.project = nn.Linear(width, DIMENSIONS)
        self.width = width

    def forward(self, words: Int64[Tensor, "B W"], mask: Int64[Tensor, "B W"]) -> Float[Tensor, "B D"]:
        """Return the unit vectors of texts; `mask` is 1 where there is a word."""
        present = mask.to(self.words.weight.dtype)
        x = self.words(words)
        query, key, value = self.attend(x).split(self.width, dim=-1)
        affinity = torch.matmul(query, key.transpose(1, 2)) / self.width**0.5
        affinity = affinity + (present[:, None, :] - 1) * 1e4
        x = x + torch.matmul(torch.softmax(affinity, dim=-1), value)
        x = x + self.hidden(x)
        pooled = (x * present[..., None]).sum(dim=1) / present.sum(dim=1, keepdim=True).clamp(min=1.0)
        return functional.normalize(self.project(pooled), dim=-1)


class Clip(NamedTuple):
    """A complete small CLIP."""

    vision: ClipVision
    text: ClipText
    tokenizer: Tokenizer


def contrastive_loss(
    image: Float[Tensor, "B D"],  # unit vectors of crops
    text: Float[Tensor, "T D"],  # unit vectors of texts
    valid: Float[Tensor, "B T"],  # 1 where text j describes crop i; every crop has at least one text
    scale: Float[Tensor, ""],  # factor of the cosines (inverse temperature)
) -> Float[Tensor, ""]:
    """Return the mean of both directions' cross-entropy against uniform targets on the valid pairs.

    Texts without a crop are only negatives.
    """
    logits = scale * image @ text.T
    by_image = -(valid * torch.log_softmax(logits, dim=1)).sum(dim=1) / valid.sum(dim=1)
    num_crops = valid.sum(dim=0)
    by_text = -(valid * torch.log_softmax(logits, dim=0)).sum(dim=0) / num_crops.clamp(min=1.0)
    return (by_image.mean() + by_text.sum() / (num_crops > 0).sum()) / 2
