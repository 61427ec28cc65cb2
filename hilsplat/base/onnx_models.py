"""Model folders in the layout of the Hugging Face ONNX exports: finding, checking, running.

A folder holds `config.json`, `preprocessor_config.json`, for CLIP `tokenizer.json`, and the networks as
`<name>.onnx`, either beside them or under `onnx/`. Everything needed to turn a photograph into a network's
input is read from the folder, so its digest identifies the model.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from hilsplat.base.artifacts import read_json, sha256_of_file, sha256_of_json
from hilsplat.base.clip_split import whole_clip
from hilsplat.base.errors import ArtifactError, ModelError

logger = logging.getLogger(__name__)


Axes = tuple[int | None, ...]
"""Axes of an array: their lengths if the layout fixes them, None if any will do."""


@dataclass(frozen=True)
class NetworkSpec:
    """Inputs and outputs of one network of a model.

    Attributes:
        inputs: names and axes of required inputs.
        outputs: names and axes of required outputs; others are ignored.
        optional: names of inputs that are passed if the network has them.
    """

    inputs: Mapping[str, Axes]
    outputs: Mapping[str, Axes]
    optional: tuple[str, ...] = ()


_ANY2, _ANY3, _ANY4 = (None,) * 2, (None,) * 3, (None,) * 4
_IMAGE: Axes = (None, 3, None, None)

KINDS: dict[str, dict[str, NetworkSpec]] = {
    "sam": {
        "vision_encoder": NetworkSpec(
            {"pixel_values": _IMAGE}, {"image_embeddings": _ANY4, "image_positional_embeddings": _ANY4}
        ),
        "prompt_encoder_mask_decoder": NetworkSpec(
            {
                "input_points": (None, None, None, 2),
                "input_labels": _ANY3,
                "image_embeddings": _ANY4,
                "image_positional_embeddings": _ANY4,
            },
            {"iou_scores": (None, None, 3), "pred_masks": (None, None, 3, None, None)},
        ),
    },
    "clip": {
        "vision_model": NetworkSpec({"pixel_values": _IMAGE}, {"image_embeds": _ANY2}),
        "text_model": NetworkSpec({"input_ids": _ANY2}, {"text_embeds": _ANY2}, optional=("attention_mask",)),
    },
}
"""Networks of each kind of model, by the `model_type` in its config.json."""

DESCRIPTIONS = {
    "sam": ("config.json", "preprocessor_config.json"),
    "clip": ("config.json", "preprocessor_config.json", "tokenizer.json"),
}
"""Files beside the networks, by kind."""

SWITCHES = ("do_resize", "do_rescale", "do_normalize")
"""Preprocessing steps that our code always performs."""

POINTER_BYTES = 1024
"""Files smaller than this may be the pointers that a clone without Git LFS leaves."""

DTYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
}


@dataclass(frozen=True)
class ModelFolder:
    """A model folder that is complete.

    Attributes:
        folder: as the settings name it.
        kind: "sam" or "clip".
        config: content of `config.json`.
        preprocessing: content of `preprocessor_config.json`.
        networks: file of each network by name.
        files: all files that count for the digest.
    """

    folder: Path
    kind: str
    config: dict[str, Any]
    preprocessing: dict[str, Any]
    networks: dict[str, Path]
    files: tuple[Path, ...]

    @cached_property
    def digest(self) -> str:
        """SHA-256 over names and bytes of the files, independent of the folder's path. Computed once."""
        return sha256_of_json(
            [(path.relative_to(self.folder).as_posix(), sha256_of_file(path)) for path in self.files]
        )

    def network(self, name: str, threads: int = 1) -> "Network":
        """Open one of the model's networks and check its inputs and outputs.

        Raises:
            ModelError: it cannot be read, or its inputs or outputs have other names or axes than expected.
        """
        return Network(self.networks[name], KINDS[self.kind][name], threads)


def open_model_folder(folder: Path, kind: str | None = None, *, fix: str = "") -> ModelFolder:
    """Find a model's files.

    Args:
        folder: the model folder.
        kind: "sam" or "clip"; None accepts either.
        fix: another way out, added to the message about a missing folder.

    Raises:
        ModelError: the folder or some of its files are missing, or it holds another kind of model.
    """
    folder = Path(folder)
    way_out = "name a folder in the layout of the Hugging Face ONNX exports" + (f", or {fix}" if fix else "")
    if not folder.is_dir():
        raise ModelError(f"model folder {folder} is missing", fix=way_out)
    try:
        config = read_json(folder / "config.json")
    except ArtifactError as error:
        raise ModelError(
            f"model folder {folder} has no readable config.json",
            expected="config.json with model_type sam or clip",
            found=", ".join(sorted(path.name for path in folder.iterdir())[:12]) or "an empty folder",
            fix=way_out,
        ) from error
    found_kind = config.get("model_type") if isinstance(config, dict) else None
    if found_kind not in KINDS or (kind is not None and found_kind != kind):
        raise ModelError(
            f"model folder {folder} holds another kind of model",
            expected=f"model_type {kind or ' or '.join(KINDS)} in config.json",
            found=f"model_type {found_kind!r}",
            fix=way_out,
        )
    networks = {}
    missing = []
    for name in KINDS[found_kind]:
        places = [folder / f"{name}.onnx", folder / "onnx" / f"{name}.onnx"]
        present = [place for place in places if place.is_file()]
        if present:
            networks[name] = present[0]
        else:
            missing.append(f"onnx/{name}.onnx")
    described = [folder / name for name in DESCRIPTIONS[found_kind]]
    missing += [path.name for path in described if not path.is_file()]
    if missing:
        if found_kind == "clip" and whole_clip(folder):
            fix = f"split its single network into the two that are needed: hilsplat models split {folder}"
        found = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
        raise ModelError(
            f"model folder {folder} lacks {', '.join(missing)}",
            expected=", ".join(
                [*DESCRIPTIONS[found_kind], *(f"onnx/{name}.onnx" for name in KINDS[found_kind])]
            ),
            found=", ".join(found[:20]),
            fix=f"complete the folder (files such as {next(iter(KINDS[found_kind]))}_quantized.onnx must be "
            "copied to the plain name)" + (f", or {fix}" if fix else ""),
        )
    optional = [folder / name for name in ("tokenizer_config.json", "special_tokens_map.json")]
    beside = [path for path in optional if found_kind == "clip" and path.is_file()]
    # Large exports keep their weights in files named after the network.
    weights = [
        path
        for network in networks.values()
        for path in sorted(network.parent.glob(f"{network.name}?data*"))
        if path.is_file()
    ]
    try:
        preprocessing = read_json(folder / "preprocessor_config.json")
    except ArtifactError as error:
        raise ModelError(
            f"{folder / 'preprocessor_config.json'} cannot be read: {error}", fix="fetch a whole copy"
        ) from error
    switched_off = [key for key in SWITCHES if preprocessing.get(key) is False]
    if switched_off:
        raise ModelError(
            f"{folder / 'preprocessor_config.json'} switches off {', '.join(switched_off)}",
            expected="images resized, divided by 255 and normalised, as in the released models",
            fix="export the model again with its own preprocessor",
        )
    return ModelFolder(
        folder,
        found_kind,
        config,
        preprocessing,
        networks,
        tuple(sorted({*described, *beside, *networks.values(), *weights})),
    )


def execution_providers() -> list[str]:
    """onnxruntime's execution providers in our order of preference: CUDA if there is one, then CPU."""
    available = onnxruntime.get_available_providers()
    return [name for name in ("CUDAExecutionProvider", "CPUExecutionProvider") if name in available]


class Network:
    """One ONNX network: checked names, inputs cast to its types, outputs as float32.

    A call runs in one thread by default: stages are faster when they process several views at once, and the
    sums inside a call then do not depend on the number of threads. Several threads may call it.
    """

    def __init__(self, path: Path, spec: NetworkSpec, threads: int = 1) -> None:
        self.path = path
        self.spec = spec
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
        options.log_severity_level = 3
        if path.stat().st_size < POINTER_BYTES and path.read_bytes().startswith(b"version https://git-lfs"):
            raise ModelError(
                f"network {path} is a Git LFS pointer, not the network",
                found=f"a text file of {path.stat().st_size} bytes",
                fix="fetch the file itself: git lfs pull, or download it from the model's page",
            )
        try:
            self.session = onnxruntime.InferenceSession(str(path), options, providers=execution_providers())
        except Exception as error:  # onnxruntime's errors share no public base class
            raise ModelError(
                f"network {path} cannot be opened: {error}",
                found=f"a file of {path.stat().st_size} bytes",
                fix="export it again, or fetch a whole copy (with its .onnx_data file, if it has one)",
            ) from error
        self.inputs = {item.name: item for item in self.session.get_inputs()}
        self.outputs = {item.name: item for item in self.session.get_outputs()}
        self._check("inputs", spec.inputs, self.inputs, spec.optional)
        self._check("outputs", spec.outputs, self.outputs, tuple(self.outputs))
        self.providers = self.session.get_providers()
        logger.info("network %s runs on %s", path.name, self.providers[0])

    def _check(
        self, what: str, expected: Mapping[str, Axes], found: dict[str, Any], optional: tuple[str, ...]
    ) -> None:
        """Compare names, axes and types with the expected ones."""
        wrong = [name for name in expected if name not in found]
        wrong += [name for name in found if name not in expected and name not in optional]
        wrong += [
            name
            for name, axes in expected.items()
            if name in found and not (_fits(found[name].shape, axes) and found[name].type in DTYPES)
        ]
        if wrong:
            raise ModelError(
                f"network {self.path} has other {what} than expected: {', '.join(dict.fromkeys(wrong))}",
                expected=", ".join(
                    f"{name} ({', '.join('any' if axis is None else str(axis) for axis in axes)})"
                    for name, axes in expected.items()
                ),
                found=", ".join(f"{name} {list(item.shape)} {item.type}" for name, item in found.items()),
                fix="export the model in the layout of the Hugging Face ONNX exports",
            )

    def declared_axis(self, name: str, axis: int) -> int | None:
        """Length of an output's axis, if the network states it."""
        shape = self.outputs[name].shape
        return shape[axis] if shape and isinstance(shape[axis], int) else None

    def fixed_axis(self, name: str, axis: int) -> int | None:
        """Length of an input's axis, if the network fixes it."""
        shape = self.inputs[name].shape
        return shape[axis] if shape and isinstance(shape[axis], int) else None

    def __call__(self, **feeds: np.ndarray) -> list[np.ndarray]:
        """Run once; outputs come in the order of the spec.

        Raises:
            ModelError: the network refuses the inputs.
        """
        wanted = {name: value for name, value in feeds.items() if name in self.inputs}
        cast = {name: np.asarray(value, DTYPES[self.inputs[name].type]) for name, value in wanted.items()}
        try:
            outputs = self.session.run(list(self.spec.outputs), cast)
        except Exception as error:  # as above
            shapes = ", ".join(f"{name} {value.shape}" for name, value in cast.items())
            raise ModelError(
                f"network {self.path} failed: {error}",
                found=shapes,
                fix="check that preprocessor_config.json belongs to this network",
            ) from error
        for (name, axes), output in zip(self.spec.outputs.items(), outputs, strict=True):
            if output.ndim != len(axes):
                raise ModelError(
                    f"network {self.path} returned {name} with {output.ndim} axes",
                    expected=f"{len(axes)} axes",
                    found=f"shape {output.shape}",
                    fix="export the model in the layout of the Hugging Face ONNX exports",
                )
        return [output.astype(np.float32) for output in outputs]


def _fits(shape: Sequence[Any], axes: Axes) -> bool:
    """Whether a declared shape, which may be empty or hold names, can be an array of these axes."""
    if not shape:
        return True
    return len(shape) == len(axes) and all(
        wanted is None or not isinstance(length, int) or length == wanted
        for length, wanted in zip(shape, axes, strict=True)
    )


def side_px(size: Any, default: int) -> int:
    """Side of a square input, from a preprocessor's size: a number, or a dict in any of its forms."""
    if isinstance(size, dict):
        for key in ("longest_edge", "shortest_edge", "height"):
            if key in size:
                return int(size[key])
        return default
    return int(size) if size else default


def input_side_px(model: ModelFolder) -> int:
    """Side of the square that the image network takes, px."""
    keys = ("pad_size", "size") if model.kind == "sam" else ("crop_size", "size")
    default = 1024 if model.kind == "sam" else 224
    for key in keys:
        if model.preprocessing.get(key):
            return side_px(model.preprocessing[key], default)
    return default


def require_three_heads(path: Path, iou_scores: np.ndarray, pred_masks: np.ndarray) -> None:
    """Refuse a decoder that does not return three masks per prompt.

    Raises:
        ModelError: the third axis is not 3 long.
    """
    if iou_scores.shape[2] != 3 or pred_masks.shape[2] != 3:
        raise ModelError(
            f"decoder {path} does not return three masks per prompt",
            expected="iou_scores (images, prompts, 3) and pred_masks (images, prompts, 3, h, w)",
            found=f"{iou_scores.shape} and {pred_masks.shape}",
            fix="export it with multimask output",
        )


def require_one_space(folder: Path, image_numbers: int | None, text_numbers: int | None) -> None:
    """Refuse a CLIP whose two networks return vectors of different widths; None means not known yet.

    Raises:
        ModelError: the widths differ.
    """
    if None not in (image_numbers, text_numbers) and image_numbers != text_numbers:
        raise ModelError(
            f"the two networks of {folder} do not belong together",
            expected=f"text vectors of {image_numbers} numbers, as the image vectors",
            found=f"{text_numbers} numbers",
            fix="export both networks, with their projections, from one model",
        )
