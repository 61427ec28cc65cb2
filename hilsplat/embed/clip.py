"""CLIP by onnxruntime: crops of masks and texts as unit vectors of one space."""

import logging
import time
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float16, Float32, Int64, UInt8
from tokenizers import Tokenizer

from hilsplat.base.artifacts import read_full_index, read_json
from hilsplat.base.errors import MisalignedArtifactError, ModelError
from hilsplat.base.files import INSTALLED
from hilsplat.base.processes import in_order
from hilsplat.models.folder import ModelFolder, input_side_px, open_model_folder
from hilsplat.models.network import Network, require_one_space
from hilsplat.models.store import MODELS, user_models
from hilsplat.segment.crops import crop_to_square
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import ClipSettings

logger = logging.getLogger(__name__)

SIGLIP_TOKENS = 64
"""Length of every text of a SigLIP whose configuration names none."""

MODEL_PATTERNS = ("*/config.json", "*/*/config.json")
"""Places of model folders under `models/`."""


class ClipModel:
    """A CLIP, ready to run.

    Attributes:
        digest: SHA-256 of the model's files.
        side_px: side of the square crops the vision network takes.
        max_tokens: longest text the text network takes; None if the folder names no limit.
        precision: "fp32" or "int8", of pictures.
    """

    precision: str = "fp32"

    def __init__(self, model: ModelFolder, threads: int = 1, template: str = "{}") -> None:
        self.model = model
        self.threads = threads
        self.template = template
        self._known_texts: dict[str, np.ndarray] = {}
        self.digest = model.digest
        self.text = model.network("text_model")
        self.ids, (self.words,) = next(iter(self.text.spec.inputs)), self.text.spec.outputs
        self.side_px = input_side_px(model)
        # CLIP's own statistics if the folder names none, as in transformers
        preprocessing = model.preprocessing
        self.mean = np.array(preprocessing.get("image_mean", (0.48145466, 0.4578275, 0.40821073)), np.float32)
        self.std = np.array(preprocessing.get("image_std", (0.26862954, 0.26130258, 0.27577711)), np.float32)
        self.rescale = np.float32(preprocessing.get("rescale_factor", 1 / 255))
        path = model.tokenizer
        try:
            self.tokenizer = Tokenizer.from_file(str(path))
        except Exception as error:  # the tokenizers package raises bare Exception
            raise ModelError(f"{path} cannot be read: {error}", fix="fetch a whole copy") from error
        if not self.tokenizer.get_vocab_size(with_added_tokens=False):
            raise ModelError(f"{path} has no word", fix="fetch a whole copy")
        fixed = self.text.fixed_axis(self.ids, 1)
        text_config = model.config.get("text_config", {})
        self.siglip = model.layout == "siglip"
        declared = text_config.get("max_position_embeddings", SIGLIP_TOKENS if self.siglip else None)
        truncation = self.tokenizer.truncation or {}
        self.max_tokens: int | None = fixed or declared or truncation.get("max_length")
        if self.max_tokens:
            self.tokenizer.enable_truncation(self.max_tokens)
        if fixed or self.siglip:  # SigLIP was trained on padded texts and reads the padding
            self.tokenizer.enable_padding(length=self.max_tokens, pad_id=self._pad_id(text_config))
        else:
            self.tokenizer.no_padding()

    @cached_property
    def vision(self) -> Network:
        """The network of pictures, opened at its first use: it is large, and texts do not need it.

        Raises:
            ModelError: it cannot be read, or has another width than that of texts.
        """
        opened = self.model.network("vision_model")
        (vector,) = opened.spec.outputs
        numbers = opened.declared_axis(vector, 1), self.text.declared_axis(self.words, 1)
        require_one_space(self.model.folder, *numbers)
        return opened

    def use_int8(self, network: Network) -> None:
        """Embed pictures with the int8 version of their network."""
        self.__dict__["vision"], self.precision = network, "int8"

    def _pad_id(self, text_config: dict[str, Any]) -> int:
        """Token that fills a text up: what the tokenizer names, else its configuration, else the model's."""
        named = (self.tokenizer.padding or {}).get("pad_id")
        beside = self.model.tokenizer.with_name("tokenizer_config.json")
        if named is None and beside.is_file():
            token = read_json(beside).get("pad_token")
            token = token.get("content") if isinstance(token, dict) else token
            named = self.tokenizer.token_to_id(token) if token else None
        if named is None:
            named = text_config.get("pad_token_id", 1 if self.siglip else 0)
        return int(named or 0)

    @staticmethod
    def load(folder: Path, threads: int = 1, template: str = "{}", variant: str = "") -> "ClipModel":
        """Open a model folder.

        Args:
            folder: in a layout of `models.layouts`.
            threads: batches of crops embedded at once; results do not depend on it.
            template: sentence around every text, which replaces `{}`.
            variant: ending of the networks' names, such as `fp16`.

        Raises:
            ModelError: it is missing, incomplete or not a CLIP, or its networks do not belong together.
        """
        model = ClipModel(open_model_folder(folder, "clip", variant=variant), threads, template)
        _ = model.vision  # opened and checked at once
        return model

    @property
    def width(self) -> int:
        """Numbers in a vector."""
        return self.text.declared_axis(self.words, 1) or self.embed_texts(["object"]).shape[1]

    def require_width(self, numbers: int, what: str) -> None:
        """Refuse something made for vectors of another width.

        Raises:
            MisalignedArtifactError: the widths differ.
        """
        if self.width != numbers:
            raise MisalignedArtifactError(
                f"{what} does not belong to the CLIP in {self.model.folder}",
                expected=f"vectors of {self.width} numbers, as this CLIP gives",
                found=f"{numbers} numbers",
                fix="use the CLIP it was made with (clip.model), or rerun the clip stage and those after it",
            )

    def prepare(self, crops: UInt8[np.ndarray, "B side side 3"]) -> Float32[np.ndarray, "B 3 side side"]:
        """Normalise crops, channel first."""
        values = (crops.astype(np.float32) * self.rescale - self.mean) / self.std
        return np.ascontiguousarray(values.transpose(0, 3, 1, 2))

    def embed_crops(self, crops: UInt8[np.ndarray, "B side side 3"]) -> Float32[np.ndarray, "B C"]:
        """Unit vectors of square crops of `side_px`."""
        pixels = next(iter(self.vision.spec.inputs))
        step = self.vision.fixed_axis(pixels, 0) or len(crops)  # open_clip's exports take one picture
        pieces = np.split(self.prepare(crops), range(step, len(crops), step))
        return unit(np.concatenate([self.vision(**{pixels: piece})[0] for piece in pieces]))

    def seconds(self, network: Network) -> float:
        """Measure the seconds per crop of the picture network, or of a version of it."""
        pixels = next(iter(self.vision.spec.inputs))
        crops = np.zeros((self.vision.fixed_axis(pixels, 0) or 1, self.side_px, self.side_px, 3), np.uint8)
        network(**{pixels: self.prepare(crops)})
        start = time.perf_counter()
        network(**{pixels: self.prepare(crops)})
        return (time.perf_counter() - start) / len(crops)

    def embed_picture(self, picture: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, " C"]:
        """Unit vector of a whole picture, centred in a black square like the crops of masks."""
        inside = np.ones(picture.shape[:2], np.bool_)
        return self.embed_crops(crop_to_square(picture, inside, "keep", self.side_px)[None])[0]

    def embed_masks(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        masks: HierarchicalMasks,
        settings: ClipSettings | None = None,
        rows: Int64[np.ndarray, " m"] | None = None,
    ) -> Float16[np.ndarray, "m C"]:
        """Return a unit vector for each mask of a view, computed from its crop (`segment.crops`).

        Args:
            image: the view.
            masks: its masks.
            settings: what fills the crop outside the mask, and crops per network call; None: defaults.
            rows: the masks to embed; None: all.
        """
        settings = settings or ClipSettings()
        chosen = range(len(masks)) if rows is None else rows.tolist()

        def embed(start: int) -> np.ndarray:
            batch = chosen[start : start + settings.batch]
            return self.embed_crops(np.stack([self.crop(image, masks, row, settings) for row in batch]))

        parts = list(in_order(embed, range(0, len(chosen), settings.batch), self.threads))
        if not parts:
            return np.zeros((0, self.width), dtype=np.float16)
        return np.concatenate(parts).astype(np.float16)

    def crop(
        self, image: UInt8[np.ndarray, "H W 3"], masks: HierarchicalMasks, row: int, settings: ClipSettings
    ) -> UInt8[np.ndarray, "side side 3"]:
        """Cut out a mask; only its box is unpacked, since a photograph may have 40 million pixels."""
        x0, y0, x1, y1 = box = tuple(masks.box_xyxy[row].tolist())
        as_langsplat = settings.crop == "langsplat"
        inside = masks.window(row, box)
        return crop_to_square(image[y0:y1, x0:x1], inside, settings.background, self.side_px, as_langsplat)

    def embed_texts(self, texts: list[str]) -> Float32[np.ndarray, "T C"]:
        """Unit vectors of texts, in order, each inserted into the template.

        Texts run one by one, so the vector of a query never depends on other queries. A repeated text
        costs nothing.

        Raises:
            ModelError: a text has no token.
        """
        for text in texts:
            if text not in self._known_texts:
                self._known_texts[text] = self._embed_text(text)
        return np.stack([self._known_texts[text] for text in texts])

    def unknown_words(self, text: str) -> list[str]:
        """Words of a text outside the model's vocabulary; a tokenizer of word pieces knows every word."""
        unknown = self.tokenizer.token_to_id(getattr(self.tokenizer.model, "unk_token", None) or "")
        encoding = self.tokenizer.encode(text)
        places = zip(encoding.ids, encoding.offsets, strict=True)
        words = [text[start:end] for number, (start, end) in places if number == unknown]
        return [word for word in words if any(letter.isalnum() for letter in word)]

    def _embed_text(self, text: str) -> Float32[np.ndarray, " C"]:
        """The unit vector of one text."""
        if not text.strip() or not sum(self.tokenizer.encode(text).attention_mask):
            raise ModelError(f"text {text!r} has no token", fix="give each query at least one word")
        sentence = self.template.replace("{}", text)
        if self.siglip:  # trained on lower-case texts
            sentence = sentence.lower()
        encoding = self.tokenizer.encode(sentence)
        if encoding.overflowing:
            logger.warning("text cut off after %d tokens: %r", self.max_tokens, text)
        mask = np.array([encoding.attention_mask], dtype=np.int64)
        ids = np.array([encoding.ids], dtype=np.int64)
        (vector,) = self.text(**{self.ids: ids, "attention_mask": mask})
        return unit(vector)[0]


def unit(vectors: Float32[np.ndarray, "N C"]) -> Float32[np.ndarray, "N C"]:
    """Scale rows to length 1; a zero row stays zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return (vectors / np.where(length > 0, length, 1)).astype(np.float32)


def open_clip_of(clip_folder: Path, threads: int = 1, template: str = "{}") -> ClipModel:
    """Open the CLIP that embedded the masks of a clip artifact, wherever its folder is now.

    Its digest identifies it. The search covers the recorded path and every folder in `models/`, each relative
    to the working directory, to the folders above the artifact (such as the project that holds the results)
    and to the installation, and the user's models. The network of pictures is opened at its first use.

    Args:
        clip_folder: what the clip stage wrote.
        threads: as in `ClipModel.load`.
        template: as in `ClipModel.load`.

    Raises:
        ModelError: no CLIP found has the digest of the one that embedded the masks.
    """
    index = read_full_index(clip_folder, "model", "model_sha256")
    recorded, wanted = Path(index["model"]), index["model_sha256"]
    variant = index.get("model_variant", "")
    roots = list(dict.fromkeys([Path.cwd(), *Path(clip_folder).resolve().parents, INSTALLED]))
    stores = [place for place in (*(root / MODELS for root in roots), user_models()) if place.is_dir()]
    configs = [config for store in stores for pattern in MODEL_PATTERNS for config in store.glob(pattern)]
    seen: dict[Path, str] = {}
    for folder in [*(root / recorded for root in roots), *sorted(config.parent for config in configs)]:
        place = folder.resolve()
        if place in seen or not place.is_dir():
            continue
        try:
            model = open_model_folder(folder, "clip", variant=variant)
        except ModelError:
            continue  # SAM, or half a copy
        if model.digest == wanted:
            return ClipModel(model, threads, template)
        seen[place] = model.digest
    raise ModelError(
        f"the CLIP that embedded the masks in {clip_folder} was not found",
        expected=f"a model folder with digest {wanted[:12]}; it was {recorded}",
        found=", ".join(f"{folder} with digest {digest[:12]}" for folder, digest in seen.items())
        or f"no CLIP at {recorded} or in {', '.join(map(str, stores)) or 'any folder models/'}",
        fix=f"fetch it (hilsplat models get), copy its folder into {user_models()}, or rerun the clip stage "
        "with the CLIP you have",
    )
