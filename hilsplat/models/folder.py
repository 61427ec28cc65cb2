"""Model folders in the layouts of published ONNX exports: finding, checking, running.

A folder holds `config.json`, what prepares its inputs, and its networks as `.onnx` files
(`layouts.LAYOUTS`). Everything needed to turn a photograph into a network's input is read from the
folder, so its digest identifies the model.
"""

import logging
import mmap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from hilsplat.base.artifacts import read_json, sha256_of_file, sha256_of_json
from hilsplat.base.errors import ArtifactError, ModelError
from hilsplat.models.clip_split import whole_clip
from hilsplat.models.layouts import (
    LAYOUTS,
    OTHER_TYPES,
    SECTIONS,
    SUPPORTED,
    TORCH_SUFFIXES,
    Axes,
    NetworkSpec,
    layout_of,
)

logger = logging.getLogger(__name__)


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
        layout: key of `LAYOUTS`.
        config: content of `config.json`.
        preprocessing: how a picture becomes an input, in the words of `preprocessor_config.json`.
        networks: file of each network by name.
        files: all files that count for the digest.
    """

    folder: Path
    layout: str
    config: dict[str, Any]
    preprocessing: dict[str, Any]
    networks: dict[str, Path]
    files: tuple[Path, ...]

    @property
    def kind(self) -> str:
        """ "sam" or "clip"."""
        return LAYOUTS[self.layout].kind

    @property
    def tokenizer(self) -> Path:
        """File of a CLIP's tokenizer."""
        return self.folder / LAYOUTS[self.layout].tokenizer

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
        return Network(self.networks[name], LAYOUTS[self.layout].networks[name], threads)


def open_model_folder(
    folder: Path, kind: str | None = None, *, variant: str = "", fix: str = ""
) -> ModelFolder:
    """Find a model's files.

    Args:
        folder: the model folder.
        kind: "sam" or "clip"; None accepts either.
        variant: ending of the networks' names, such as `fp16` for `vision_encoder_fp16.onnx`; "": none.
        fix: another way out, added to the message about a missing folder.

    Raises:
        ModelError: the folder or some of its files are missing, or it holds another kind of model.
    """
    folder = Path(folder)
    way_out = "name a folder in a layout that docs/models.md lists" + (f", or {fix}" if fix else "")
    if not folder.is_dir():
        raise ModelError(f"model folder {folder} is missing", fix=way_out)
    name, config = _layout_of(folder, kind, way_out)
    layout = LAYOUTS[name]
    networks = {
        network: found
        for network, spec in layout.networks.items()
        if (found := _network_file(folder, spec, variant)) is not None
    }
    missing = [
        f"{spec.places[-1]}{_ending(variant)}.onnx"
        for network, spec in layout.networks.items()
        if network not in networks
    ]
    missing += [file for file in layout.described if not (folder / file).is_file()]
    if missing:
        raise _incomplete(folder, name, missing, variant, fix)
    preprocessing = _preprocessing_of(folder / layout.preprocessing)
    weights = {path for network in networks.values() for path in external_weights(network, folder)}
    beside = [folder / file for file in layout.beside if (folder / file).is_file()]
    described = [folder / file for file in layout.described]
    return ModelFolder(
        folder,
        name,
        config,
        preprocessing,
        networks,
        tuple(sorted({*described, *beside, *networks.values(), *weights})),
    )


def _layout_of(folder: Path, kind: str | None, way_out: str) -> tuple[str, dict[str, Any]]:
    """Layout and configuration of a folder.

    Raises:
        ModelError: it holds no model that can be read, or one of another kind.
    """
    supported = "; ".join(SUPPORTED[each] for each in ([kind] if kind else SUPPORTED))
    try:
        config = read_json(folder / "config.json")
    except ArtifactError as error:
        raise ModelError(
            f"model folder {folder} has no readable config.json",
            expected=f"config.json of {supported}",
            found=", ".join(sorted(path.name for path in folder.iterdir())[:12]) or "an empty folder",
            fix=way_out,
        ) from error
    name, config = layout_of(config), config if isinstance(config, dict) else {}
    model_type = config.get("model_type", name)
    if name is None or (kind is not None and LAYOUTS[name].kind != kind):
        raise ModelError(
            f"model folder {folder} holds another kind of model",
            expected=supported,
            found=f"model_type {model_type!r}",
            fix=OTHER_TYPES.get(str(model_type), way_out),
        )
    return name, config


def _ending(variant: str) -> str:
    """Ending of a network's name."""
    return f"_{variant}" if variant else ""


def _network_file(folder: Path, spec: NetworkSpec, variant: str) -> Path | None:
    """The file of a network, if it is there."""
    places = (folder / f"{place}{_ending(variant)}.onnx" for place in spec.places)
    return next((place for place in places if place.is_file()), None)


def _incomplete(folder: Path, name: str, missing: list[str], variant: str, fix: str) -> ModelError:
    """The message about a folder that lacks files: what it holds instead, and what to do."""
    layout = LAYOUTS[name]
    found = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    variants = variants_of(folder, name)
    if any(file.endswith(".onnx") for file in missing) and variants:
        listed = ", ".join(repr(each) for each in variants)
        way_out = f"its networks come as variants: set {SECTIONS[layout.kind]}.variant to one of {listed}"
    elif layout.kind == "clip" and whole_clip(folder):
        way_out = f"split its single network into the two that are needed: hilsplat models split {folder}"
    elif not any(file.endswith(".onnx") for file in found) and any(
        file.endswith(TORCH_SUFFIXES) for file in found
    ):
        way_out = (
            "these are PyTorch's weights, and hilsplat runs ONNX networks: get an ONNX export of the model "
            "(hilsplat models get), or export it (docs/models.md)"
        )
    else:
        way_out = "complete the folder from where it came"
    return ModelError(
        f"model folder {folder} lacks {', '.join(missing)}",
        expected=", ".join(
            [*layout.described, *(f"{spec.places[-1]}.onnx" for spec in layout.networks.values())]
        ),
        found=", ".join(found[:20]),
        fix=way_out + (f", or {fix}" if fix else ""),
    )


def variants_of(folder: Path, layout: str) -> list[str]:
    """Endings that all networks of a folder have, such as `fp16`; "" for the plain names."""
    endings: set[str] | None = None
    for spec in LAYOUTS[layout].networks.values():
        have = set()
        for place in spec.places:
            stem = Path(place).name
            for path in (folder / place).parent.glob(f"{stem}*.onnx"):
                rest = path.stem[len(stem) :]
                if not rest or rest.startswith("_"):
                    have.add(rest[1:])
        endings = have if endings is None else endings & have
    return sorted(endings or ())


def _preprocessing_of(path: Path) -> dict[str, Any]:
    """How a picture becomes an input; open_clip's words are translated.

    Raises:
        ModelError: the file cannot be read, or switches off a step.
    """
    try:
        found = read_json(path)
    except ArtifactError as error:
        raise ModelError(f"{path} cannot be read: {error}", fix="fetch a whole copy") from error
    found = {key: value for key, value in found.items() if value is not None}
    switched_off = [key for key in SWITCHES if found.get(key) is False]
    if switched_off:
        raise ModelError(
            f"{path} switches off {', '.join(switched_off)}",
            expected="images resized, divided by 255 and normalised, as in the released models",
            fix="export the model again with its own preprocessor",
        )
    if path.name == "preprocess_cfg.json":
        size = found.get("size", 224)
        found["size"] = size[0] if isinstance(size, list) else size
        for ours, theirs in (("image_mean", "mean"), ("image_std", "std")):
            if theirs in found:
                found[ours] = found[theirs]
    return found


def external_weights(network: Path, folder: Path) -> list[Path]:
    """Files beside a network that hold its weights, as its graph names them; the weights are not read.

    Raises:
        ModelError: the graph cannot be read, or such a file is missing or outside the model folder.
    """
    if not network.stat().st_size:
        return []  # opening it says what is wrong
    with network.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        if content.find(b"location") < 0:  # the key that every tensor outside the graph has
            return []
    import onnx
    from google.protobuf.message import DecodeError
    from onnx.external_data_helper import ExternalDataInfo, uses_external_data

    try:
        graph = onnx.load(str(network), load_external_data=False).graph
    except DecodeError:
        return []  # a damaged copy: opening it says so
    named = {ExternalDataInfo(tensor).location for tensor in _tensors(graph) if uses_external_data(tensor)}
    found = []
    for name in sorted(named):
        path = network.parent / name
        if not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
            raise ModelError(
                f"network {network} cannot be opened: its weights are missing",
                expected=f"the file {name} beside it",
                found=", ".join(sorted(other.name for other in network.parent.iterdir())),
                fix="fetch a whole copy",
            )
        found.append(path)
    return found


def _tensors(graph: Any) -> Iterator[Any]:
    """All weights and constants of a graph and of the graphs inside it."""
    yield from graph.initializer
    for node in graph.node:
        for attribute in node.attribute:
            yield from (attribute.t, *attribute.tensors)
            for inner in (attribute.g, *attribute.graphs):
                yield from _tensors(inner)


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
                fix="export it again, or fetch a whole copy (with its file of weights, if it has one)",
            ) from error
        self.inputs = {item.name: item for item in self.session.get_inputs()}
        self.outputs = {item.name: item for item in self.session.get_outputs()}
        names = {
            name: other
            for name, other in spec.synonyms.items()
            if name not in self.outputs and other in self.outputs
        }
        self.spec = spec = replace(
            spec, outputs={names.get(name, name): axes for name, axes in spec.outputs.items()}
        )
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
        return [output.astype(np.float32, copy=False) for output in outputs]


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
    keys = ("pad_size", "size") if model.layout == "sam" else ("crop_size", "size")
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
