"""CLIP: unit vectors of mask crops and texts in a shared space."""

import logging
import string
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float16, Float32, Int64, UInt8
from tokenizers import Tokenizer

from hilsplat.base.artifacts import read_index, read_json
from hilsplat.base.errors import MisalignedArtifactError, ModelError, SettingsError, foreign
from hilsplat.base.files import INSTALLED
from hilsplat.models.card import CPU, Batches, in_turn, network_device
from hilsplat.models.folder import WHOLE_COPY, ModelFolder, input_side_px, open_model_folder
from hilsplat.models.memory import CARD_CROPS, card_mib
from hilsplat.models.network import Array, Network, require_one_space
from hilsplat.models.repeatable import random_pixels, require_repeatable_once
from hilsplat.models.store import MODELS, user_models
from hilsplat.segment.crops import crop_to_square
from hilsplat.segment.masks import HierarchicalMasks
from hilsplat.settings import ClipSettings

logger = logging.getLogger(__name__)

CLIP_STATISTICS = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
SIGLIP_STATISTICS = (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)
"""Mean and deviation of pixels if `preprocessor_config.json` lacks them, as in transformers."""
SIGLIP_TOKENS = 64  # text length (tokens) of a SigLIP model whose configuration does not specify it
NO_PUNCTUATION = str.maketrans("", "", string.punctuation)
MAX_CROPS = 256  # per call on a card, after the first call
MAX_TEXTS = 20_000  # number of texts whose vectors, of 2 to 5 KB, are kept for later queries
MODEL_PATTERNS = ("*/config.json", "*/*/config.json")  # configurations of the models in `models/`


class ClipModel:
    """A loaded CLIP model; texts are inserted into the prompt template at `{}`."""

    precision: str = "fp32"  # precision of the vision network: "fp32", "int8" or "fp16"
    device: str = CPU  # of the vision network (`models.card`)

    def __init__(self, model: ModelFolder, template: str = "{}", device: str = CPU) -> None:
        self.model, self.device = model, device
        self.template = template
        self._text_vectors: dict[str, np.ndarray] = {}
        self.digest = model.digest
        self.text = model.network("text_model")
        self.ids, (self.words,) = next(iter(self.text.spec.inputs)), self.text.spec.outputs
        self.side_px = input_side_px(model)
        self.siglip, preprocessing = model.layout == "siglip", model.preprocessing
        mean, std = SIGLIP_STATISTICS if self.siglip else CLIP_STATISTICS
        self.mean = np.array(preprocessing.get("image_mean", mean), np.float32)
        self.std = np.array(preprocessing.get("image_std", std), np.float32)
        self.rescale = np.float32(preprocessing.get("rescale_factor", 1 / 255))
        path = model.tokenizer
        with foreign(path, ModelError, fix=WHOLE_COPY):
            self.tokenizer = Tokenizer.from_file(str(path))
        if not self.tokenizer.get_vocab_size(with_added_tokens=False):
            raise ModelError(f"{path} contains no words", fix=WHOLE_COPY)
        fixed = self.text.fixed_axis(self.ids, 1)
        text_config = model.config.get("text_config", model.config.get("text_cfg", {}))
        cleaning = (text_config.get("tokenizer_kwargs") or {}).get("clean")
        self.canonicalizes = cleaning == "canonicalize"  # SigLIP in open_clip's layout
        declared = text_config.get("max_position_embeddings", SIGLIP_TOKENS if self.siglip else None)
        truncation = self.tokenizer.truncation or {}
        self.max_tokens: int | None = fixed or declared or truncation.get("max_length")
        if self.max_tokens:
            self.tokenizer.enable_truncation(self.max_tokens)
        if fixed or self.siglip:  # SigLIP was trained on padded texts and reads the padding
            self.tokenizer.enable_padding(length=self.max_tokens, pad_id=self._pad_id(text_config))
        else:
            self.tokenizer.no_padding()
        require_repeatable_once(model, self.text, "as exported", self._tokens("object, things, stuff"))

    def __reduce__(self) -> tuple[type["ClipModel"], tuple[ModelFolder, str, str]]:
        """Reopen the folder's networks in another process: sessions of onnxruntime cannot be pickled."""
        return ClipModel, (self.model, self.template, self.device)

    @cached_property
    def vision(self) -> Network:
        """Vision network, opened on first use because it is large and not needed for texts."""
        network = self.model.network("vision_model", device=self.device)
        (vector,) = network.spec.outputs
        widths = network.fixed_axis(vector, 1), self.text.fixed_axis(self.words, 1)
        require_one_space(self.model.folder, *widths)
        pixels = random_pixels(network, self.side_px)
        in_turn(
            self.device, "clip", lambda: require_repeatable_once(self.model, network, "as exported", pixels)
        )
        return network

    @property
    def pixels(self) -> str:
        """Name of the vision network's input."""
        return next(iter(self.vision.spec.inputs))

    @property
    def crops_per_call(self) -> int | None:
        """Fixed number of crops per call of the vision network, if any; it is 1 in open_clip's exports."""
        return self.vision.fixed_axis(self.pixels, 0)

    @cached_property
    def _on_card(self) -> Batches:
        return Batches(CARD_CROPS, self.device, MAX_CROPS, section="clip")

    def _pad_id(self, text_config: dict[str, Any]) -> int:
        """Return the padding token's id from the tokenizer, else its configuration, else the model's."""
        pad_id = (self.tokenizer.padding or {}).get("pad_id")
        config = self.model.tokenizer.with_name("tokenizer_config.json")
        if pad_id is None and config.is_file():
            token = read_json(config).get("pad_token")
            token = token.get("content") if isinstance(token, dict) else token
            pad_id = self.tokenizer.token_to_id(token) if token else None
        if pad_id is None:
            pad_id = text_config.get("pad_token_id", 1 if self.siglip else 0)
        return int(pad_id or 0)

    @staticmethod
    def load(folder: Path, variant: str = "", device: Literal["auto", "cpu", "cuda"] = "cpu") -> "ClipModel":
        """Open a model folder, and its vision network on the device that a setting selects.

        Errors as in `open_model_folder` and `network_device`.
        """
        opened = open_model_folder(folder, "clip", variant=variant)
        model = ClipModel(opened, device=network_device(device, "clip", card_mib(opened)))
        _ = model.vision  # open and check it now
        return model

    @property
    def width(self) -> int:
        """Length of a vector."""
        return self.text.fixed_axis(self.words, 1) or self.embed_texts(["object"]).shape[1]

    def about(self, settings: ClipSettings) -> dict[str, Any]:
        """Return the entries that identify the model in an artifact's index."""
        return {
            "dim": self.width,
            "model": settings.model,
            "model_variant": settings.variant,
            "model_sha256": self.digest,
        }

    def require_width(self, numbers: int, what: str) -> None:
        """Raise a MisalignedArtifactError unless an artifact's vectors have this model's width."""
        if self.width != numbers:
            raise MisalignedArtifactError(
                f"{what} does not match the CLIP model in {self.model.folder}",
                expected=f"vectors with {self.width} dimensions, as computed by this model",
                found=f"{numbers} dimensions",
                fix="set clip.model to the model that computed it, or rerun the clip stage and later stages",
            )

    def prepare(self, crops: UInt8[np.ndarray, "B side side 3"]) -> Float32[Array, "B 3 side side"]:
        """Normalise crops and move the channels to the first axis; on a card, return a tensor."""
        if self.device != CPU:
            import torch

            mean, std = (torch.from_numpy(values).to(self.device) for values in (self.mean, self.std))
            on_card = torch.from_numpy(crops).to(self.device).float()
            return ((on_card * float(self.rescale) - mean) / std).permute(0, 3, 1, 2)
        values = (crops.astype(np.float32) * self.rescale - self.mean) / self.std
        return np.ascontiguousarray(values.transpose(0, 3, 1, 2))

    def embed_crops(self, crops: UInt8[np.ndarray, "B side side 3"]) -> Float32[np.ndarray, "B C"]:
        """Return the unit vectors of square crops with side `side_px`."""
        step = self.crops_per_call or len(crops)
        pieces = [self.prepare(crops[start : start + step]) for start in range(0, len(crops), step)]
        return self._unit(np.concatenate([self.vision(**{self.pixels: piece})[0] for piece in pieces]))

    def embed_picture(self, picture: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, " C"]:
        """Return the unit vector of a whole image, centred in a black square like mask crops."""
        inside = np.ones(picture.shape[:2], np.bool_)
        return self.embed_crops(crop_to_square(picture, inside, "keep", self.side_px)[None])[0]

    def embed_masks(
        self,
        image: UInt8[np.ndarray, "H W 3"],
        masks: HierarchicalMasks,
        settings: ClipSettings | None = None,
        rows: Int64[np.ndarray, " m"] | None = None,
    ) -> Float16[np.ndarray, "m C"]:
        """Return a unit vector for each mask of a view, or for the given rows (see `crop`)."""
        settings = settings or ClipSettings()
        chosen = range(len(masks)) if rows is None else rows.tolist()
        if not chosen:
            return np.zeros((0, self.width), dtype=np.float16)

        def crop(row: int) -> np.ndarray:
            return self.crop(image, masks, row, settings)

        # on a card, all crops are made before it is this view's turn
        known = {} if self.device == CPU else {row: crop(row) for row in chosen}

        def embed(rows: Int64[np.ndarray, " b"], number: int) -> np.ndarray:
            named = [chosen[row] for row in rows]
            return self.embed_crops(np.stack([known[row] if known else crop(row) for row in named]))

        batches = Batches(settings.batch) if self.device == CPU else self._on_card
        return np.concatenate(list(batches(len(chosen), embed))).astype(np.float16)

    def crop(
        self, image: UInt8[np.ndarray, "H W 3"], masks: HierarchicalMasks, row: int, settings: ClipSettings
    ) -> UInt8[np.ndarray, "side side 3"]:
        """Crop a mask; only its box is unpacked, because a photograph may have 40 million pixels."""
        x0, y0, x1, y1 = box = tuple(masks.box_xyxy[row].tolist())
        as_langsplat = settings.crop == "langsplat"
        inside = masks.window(row, box)
        return crop_to_square(image[y0:y1, x0:x1], inside, settings.background, self.side_px, as_langsplat)

    def embed_texts(self, texts: Sequence[str]) -> Float32[np.ndarray, "T C"]:
        """Return the unit vectors of texts, each inserted into the template; vectors are cached.

        Texts are embedded one by one, so a vector never depends on other queries.

        Raises:
            SettingsError: there is no text, or `texts` is one text, whose letters would be embedded.
            ModelError: a text has no tokens.
        """
        if isinstance(texts, str) or not len(texts):
            raise SettingsError(f"{texts!r} is not a list of texts", expected='such as ["mug", "book"]')
        if len(self._text_vectors) > MAX_TEXTS:
            self._text_vectors = {}  # a new dictionary, because another thread may read the old one
        vectors = self._text_vectors
        for text in texts:
            if text not in vectors:
                vectors[text] = self._embed_text(text)
        return np.stack([vectors[text] for text in texts])

    def unknown_words(self, text: str) -> list[str]:
        """Return the words of a text that are not in the vocabulary; empty for word-piece tokenizers."""
        unknown = self.tokenizer.token_to_id(getattr(self.tokenizer.model, "unk_token", None) or "")
        encoding = self.tokenizer.encode(text)
        tokens = zip(encoding.ids, encoding.offsets, strict=True)
        words = [text[start:end] for token, (start, end) in tokens if token == unknown]
        return [word for word in words if any(letter.isalnum() for letter in word)]

    def _embed_text(self, text: str) -> Float32[np.ndarray, " C"]:
        if not text.strip() or not sum(self.tokenizer.encode(text).attention_mask):
            raise ModelError(f"text {text!r} contains no tokens", fix="use at least one word in each query")
        sentence = self.template.replace("{}", text)
        if self.siglip:  # trained on lower-case texts
            sentence = sentence.lower()
        if self.canonicalizes:  # as open_clip's tokenizer
            words = sentence.replace("_", " ").translate(NO_PUNCTUATION).lower().split()
            sentence = " ".join(words)
        if self.tokenizer.encode(sentence).overflowing:
            logger.warning("text truncated after %d tokens: %r", self.max_tokens, text)
        (vector,) = self.text(**self._tokens(sentence))
        return self._unit(vector)[0]

    def _unit(self, vectors: Float32[np.ndarray, "N C"]) -> Float32[np.ndarray, "N C"]:
        """Scale a network's vectors to length 1; raise ModelError if this is impossible."""
        if not (np.isfinite(vectors).all() and vectors.any(axis=1).all()):
            precision = "" if self.precision == "fp32" else "set clip.precision: fp32, or "
            raise ModelError(
                f"the CLIP model {self.model.folder} gives vectors without a direction",
                expected="finite numbers that are not all 0",
                found=f"{vectors.min()} to {vectors.max()}",
                fix=f"{precision}use another variant (clip.variant), or another export of the model",
            )
        return unit(vectors)

    def _tokens(self, sentence: str) -> dict[str, np.ndarray]:
        """Return the text network's inputs for one sentence."""
        encoding = self.tokenizer.encode(sentence)
        mask = np.array([encoding.attention_mask], dtype=np.int64)
        return {self.ids: np.array([encoding.ids], dtype=np.int64), "attention_mask": mask}


def unit(vectors: Float32[np.ndarray, "N C"]) -> Float32[np.ndarray, "N C"]:
    """Scale rows to length 1; a zero row stays zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return (vectors / np.where(length > 0, length, 1)).astype(np.float32)


def open_clip_of(clip_folder: Path, template: str = "{}") -> ClipModel:
    """Open the CLIP model that embedded the masks of a clip artifact, even if the model folder was moved.

    The model is identified by its digest. The recorded path and every folder in `models/` are searched
    relative to the working directory, the artifact's parent folders (such as the project folder) and the
    installation, and then among the user's models. The vision network is opened on first use.

    Raises:
        ModelError: no CLIP model has the digest of the model that embedded the masks.
    """
    index = read_index(clip_folder, "model", "model_sha256")
    recorded, expected = Path(index["model"]), index["model_sha256"]
    variant = index.get("model_variant", "")
    roots = list(dict.fromkeys([Path.cwd(), *clip_folder.resolve().parents, INSTALLED]))
    stores = list(filter(Path.is_dir, [*(root / MODELS for root in roots), user_models()]))
    configs = [config for store in stores for pattern in MODEL_PATTERNS for config in store.glob(pattern)]
    digests: dict[Path, str] = {}
    for folder in [*(root / recorded for root in roots), *sorted(config.parent for config in configs)]:
        if folder.resolve() in digests or not folder.is_dir():
            continue
        try:
            model = open_model_folder(folder, "clip", variant=variant)
        except ModelError:
            continue  # a SAM model, or an incomplete copy
        if model.digest == expected:
            return ClipModel(model, template)
        digests[folder.resolve()] = model.digest
    raise ModelError(
        f"the CLIP model that embedded the masks in {clip_folder} was not found",
        expected=f"a model folder with digest {expected[:12]}, originally {recorded}",
        found=", ".join(f"{folder} with digest {digest[:12]}" for folder, digest in digests.items())
        or f"no CLIP model at {recorded} or in {', '.join(map(str, stores)) or 'any models/ folder'}",
        fix=f"fetch it (hilsplat models get), copy its folder into {user_models()}, or rerun the clip stage "
        "with a CLIP model that you have",
    )
