"""Find and check model folders in the layouts of published ONNX exports.

A folder contains `config.json`, the preprocessing configuration and the networks as `.onnx` files
(`layouts.LAYOUTS`). Everything needed to convert a photograph into a network's input is read from the folder,
so its digest identifies the model.
"""

import shlex
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

from pydantic import AliasChoices, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from hilsplat.base.artifacts import read_json
from hilsplat.base.errors import ArtifactError, ModelError, in_one_line
from hilsplat.base.lineage import sha256_of_file, sha256_of_json
from hilsplat.models import layouts
from hilsplat.models.card import CPU
from hilsplat.models.network import Network
from hilsplat.models.onnx_graph import Graph, external_files, whole_clip
from hilsplat.models.store import model_path

OTHER_FOLDER = "choose a folder in a layout listed in docs/models.md"
WHOLE_COPY = "fetch a complete copy"
SWITCHES = ("do_resize", "do_rescale", "do_normalize")  # preprocessing steps that our code always performs
SAM_SIDE_PX = 1024  # default of `size`
MAX_SIDE_PX = 4096


def _side_px(size: Any) -> Any:
    """Return the side of a square size in any published form; return other values unchanged."""
    if isinstance(size, dict) and size.keys() in ({"longest_edge"}, {"shortest_edge"}, {"height", "width"}):
        size = list(size.values())
    return size[0] if isinstance(size, list) and size and size.count(size[0]) == len(size) else size


Side = Annotated[int, BeforeValidator(_side_px), Field(ge=1, le=MAX_SIDE_PX)]
Mean = Annotated[list[Annotated[float, Field(ge=-255, le=255)]], Field(min_length=3, max_length=3)]
Deviation = Annotated[list[Annotated[float, Field(ge=1e-3, le=255)]], Field(min_length=3, max_length=3)]


class Preprocessing(BaseModel):
    """Image preprocessing in the keys of `preprocessor_config.json` or open_clip; sizes are square, in px.

    `resample` (one of Pillow's filters) applies only to SAM; `segment.crops` resizes the crops for CLIP.
    """

    model_config = ConfigDict(strict=True, allow_inf_nan=False)
    do_resize: bool | None = None
    do_rescale: bool | None = None
    do_normalize: bool | None = None
    do_pad: bool | None = None
    do_center_crop: bool | None = None
    do_convert_rgb: bool | None = None
    size: Side | None = None
    crop_size: Side | None = None
    pad_size: Side | None = None
    image_mean: Mean | None = Field(None, validation_alias=AliasChoices("image_mean", "mean"))
    image_std: Deviation | None = Field(None, validation_alias=AliasChoices("image_std", "std"))
    rescale_factor: Annotated[float, Field(gt=0, le=1)] | None = None
    resample: Annotated[int, Field(ge=0, le=5)] | None = None


@dataclass(frozen=True)
class ModelFolder:
    folder: Path
    layout: str  # key of `LAYOUTS`
    config: dict[str, Any]
    preprocessing: dict[str, Any]  # the values given in `Preprocessing`
    networks: dict[str, Path]  # file of each network by name, including optional networks that exist
    files: tuple[Path, ...]  # all files included in the digest

    @property
    def kind(self) -> str:
        """ "sam" or "clip"."""
        return layouts.LAYOUTS[self.layout].kind

    @property
    def tokenizer(self) -> Path:
        """Tokenizer file of a CLIP model."""
        return self.folder / layouts.LAYOUTS[self.layout].tokenizer

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the names and bytes of the files, independent of the folder's path; computed once."""
        files = [(path.relative_to(self.folder).as_posix(), sha256_of_file(path)) for path in self.files]
        return sha256_of_json(files)

    def network(self, name: str, changed: Graph | Path | None = None, device: str = CPU) -> Network:
        """Open one of the model's networks, in torch unless on the CPU, and check its inputs and outputs."""
        network = self.networks[name], layouts.LAYOUTS[self.layout].usable[name], changed
        if device == CPU:
            return Network(*network)
        from hilsplat.models.torch_network import TorchNetwork  # torch takes seconds to import

        return TorchNetwork(*network, device=device)


def open_model_folder(
    folder: Path, kind: str | None = None, *, variant: str = "", fix: str = ""
) -> ModelFolder:
    """Find the files of a model and check that they are complete.

    Args:
        kind: "sam" or "clip"; None accepts either.
        variant: suffix of the network names, such as `fp16` for `vision_encoder_fp16.onnx`; "" for none.
        fix: alternative fix, added to the message about missing files.

    Raises:
        ModelError: the folder or some of its files are missing, or it contains a different kind of model.
    """
    folder = model_path(folder)
    alternative = f", or {fix}" if fix else ""
    if not folder.is_dir():
        raise ModelError(f"model folder {folder} is missing", fix=OTHER_FOLDER + alternative)
    name, config = _read_config(folder, kind, OTHER_FOLDER + alternative)
    layout = layouts.LAYOUTS[name]
    ending = f"_{variant}.onnx" if variant else ".onnx"
    networks, missing = {}, []
    for network, spec in layout.usable.items():
        paths = [folder / f"{stem}{ending}" for stem in spec.places]
        existing = next(filter(Path.is_file, paths), None)
        if existing is not None:
            networks[network] = existing
        elif network in layout.networks:
            missing.append(f"{spec.places[-1]}{ending}")
    missing += [file for file in layout.described if not (folder / file).is_file()]
    if missing:
        raise _incomplete(folder, name, missing, alternative)
    preprocessing = preprocessing_of(folder / layout.preprocessing)
    weights = [path for network in networks.values() for path in external_weights(network)]
    texts = filter(Path.is_file, (folder / file for file in (*layout.described, *layout.beside)))
    files = tuple(sorted({*texts, *networks.values(), *weights}))
    return ModelFolder(folder, name, config, preprocessing, networks, files)


def _read_config(folder: Path, kind: str | None, fix: str) -> tuple[str, dict[str, Any]]:
    """Return a folder's layout and configuration; raise a ModelError for a different kind of model."""
    supported = layouts.SUPPORTED[kind] if kind else "; ".join(layouts.SUPPORTED.values())
    try:
        config = read_json(folder / "config.json")
    except ArtifactError as error:
        names = sorted(path.name for path in folder.iterdir())
        is_damaged = "config.json" in names
        raise ModelError(
            f"model folder {folder} has no readable config.json",
            expected=f"config.json of {supported}",
            found=in_one_line(error) if is_damaged else ", ".join(names[:12]) or "an empty folder",
            fix=WHOLE_COPY if is_damaged else fix,
        ) from error
    name, config = layouts.layout_of(config), config if isinstance(config, dict) else {}
    model_type = config.get("model_type", name)
    if name is None or (kind is not None and layouts.LAYOUTS[name].kind != kind):
        raise ModelError(
            f"model folder {folder} contains a different kind of model",
            expected=supported,
            found=f"model_type {model_type!r}",
            fix=layouts.OTHER_TYPES.get(str(model_type), fix),
        )
    return name, config


def _incomplete(folder: Path, name: str, missing: list[str], alternative: str) -> ModelError:
    layout = layouts.LAYOUTS[name]
    files = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())
    variants = _variants(folder, layout)
    if any(file.endswith(".onnx") for file in missing) and variants:
        listed = ", ".join(map(repr, variants))
        what = "suffixes" if any(variants) else "no suffix"
        fix = f"its networks have {what}: set {layouts.SECTIONS[layout.kind]}.variant to one of {listed}"
    elif layout.kind == "clip" and whole_clip(folder):
        command = f"hilsplat models split {shlex.quote(str(folder))}"
        fix = f"split its single network into the required two: {command}"
    elif any(file.endswith(layouts.TORCH_SUFFIXES) for file in files) and not any(folder.rglob("*.onnx")):
        fix = (
            "these are PyTorch weights, but hilsplat reads ONNX networks: fetch an ONNX export of the model "
            "(hilsplat models get), or export it (docs/models.md)"
        )
    else:
        fix = "fetch or export the complete model again"
    return ModelError(
        f"model folder {folder} lacks {', '.join(missing)}",
        expected=", ".join(
            [*layout.described, *(f"{spec.places[-1]}.onnx" for spec in layout.networks.values())]
        ),
        found=", ".join(files[:20]),
        fix=fix + alternative,
    )


def _variants(folder: Path, layout: layouts.Layout) -> list[str]:
    """Return the suffixes, such as `fp16`, for which a folder has all networks; "" for the plain names."""
    suffixes = []
    for spec in layout.networks.values():
        endings = set[str]()
        for stem in spec.places:
            endings |= {path.stem.removeprefix(Path(stem).name) for path in folder.glob(f"{stem}*.onnx")}
        suffixes.append({ending[1:] for ending in endings if ending[:1] in ("", "_")})
    return sorted(set.intersection(*suffixes))


def preprocessing_of(path: Path) -> dict[str, Any]:
    """Read and check the image preprocessing settings of a model (`Preprocessing`), without empty values.

    A ModelError is raised if the file is unreadable, disables a step, or contains an invalid value.
    """
    try:
        values = Preprocessing.model_validate(read_json(path)).model_dump(exclude_none=True)
    except ArtifactError as error:
        raise ModelError(f"{path} cannot be read: {error}", fix=WHOLE_COPY) from error
    except ValidationError as error:
        fault = error.errors()[0]
        problem = f"{path}: {fault['loc'][0] if fault['loc'] else 'its content'} is invalid"
        value = str(fault["input"])[:80]
        raise ModelError(problem, expected=fault["msg"], found=value, fix=WHOLE_COPY) from error
    switches = SWITCHES if "pad_size" not in values else (*SWITCHES, "do_pad")
    if switched_off := [key for key in switches if values.get(key) is False]:
        raise ModelError(
            f"{path} disables {', '.join(switched_off)}",
            expected="images resized, divided by 255 and normalised, as in the released models",
            fix="export the model again with its own preprocessor",
        )
    if values.get("pad_size", MAX_SIDE_PX) < values.get("size", SAM_SIDE_PX):
        raise ModelError(f"{path}: pad_size is smaller than size", fix=WHOLE_COPY)
    return values


def external_weights(network: Path) -> list[Path]:
    """Return the external weight files named in a network's graph, without reading the weights.

    A ModelError is raised if such a file is missing, or named by a path that leads out of the folder.
    """
    paths = []
    for name in external_files(network):
        path = network.parent / name
        if Path(name).is_absolute() or ".." in Path(name).parts or not path.is_file():
            raise ModelError(
                f"network {network} cannot be opened: its weights are missing",
                expected=f"the file {name} beside it",
                found=", ".join(sorted(other.name for other in network.parent.iterdir())),
                fix=WHOLE_COPY,
            )
        paths.append(path)
    return paths


def input_side_px(model: ModelFolder) -> int:
    """Return the side of the image network's square input, px."""
    key, default = ("pad_size", SAM_SIDE_PX) if model.kind == "sam" else ("crop_size", 224)
    return int(model.preprocessing.get(key, model.preprocessing.get("size", default)))
