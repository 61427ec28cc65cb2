"""Model names, the files in hub repositories with their pins, and the choice of the files of a model."""

import csv
import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import huggingface_hub
import requests
from huggingface_hub import ModelInfo, constants
from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError, OfflineModeIsEnabled
from huggingface_hub.utils import validate_repo_id
from huggingface_hub.utils.sha import git_hash

from hilsplat.base.artifacts import parse_json
from hilsplat.base.errors import DownloadError, first_line
from hilsplat.base.lineage import sha256_of_file
from hilsplat.hub.retries import repeated
from hilsplat.models.layouts import LAYOUTS, SUPPORTED, layout_of
from hilsplat.models.store import RELEASES, Release

# also if huggingface_hub was imported before this package
constants.HF_HUB_DISABLE_XET = os.environ["HF_HUB_DISABLE_XET"].upper() in constants.ENV_VARS_TRUE_VALUES

WEIGHTS = ("model.safetensors", "pytorch_model.bin")
"""PyTorch weights that can be exported, in order of preference. The second is a pickle, but transformers
doesn't run code in it (`weights_only`)."""
SMALL_BYTES = 50_000_000  # text files above this size are not part of a PyTorch model's tokenizer
TIMEOUT_S = 10.0  # longest wait for the hub's next bytes; huggingface_hub uses the same value for files
OUT_OF_REACH = (requests.ConnectionError, requests.Timeout, OfflineModeIsEnabled, LocalEntryNotFoundError)
"""Errors raised if the hub cannot be reached."""
WHOLES = ("onnx/model", "model")
"""Possible paths, without `.onnx`, of a network that contains both halves of a CLIP model."""


PINS = Path(__file__).with_name("pins.tsv")
"""Commits and digests of the released models, from public sources (docs/models.md)."""


@dataclass(frozen=True)
class Pin:
    """The commit of a repository that is downloaded by default."""

    commit: str
    sha256: dict[str, str]  # digests of files whose digest is known, by path


@cache
def pins() -> dict[str, Pin]:
    """Return the pinned commit of each repository of a released model."""
    by_repository: dict[str, Pin] = {}
    with PINS.open(encoding="utf-8", newline="") as stream:
        for row in csv.DictReader(stream, delimiter="\t"):
            pin = by_repository.setdefault(row["repository"], Pin(row["commit"], {}))
            if row["path"]:
                pin.sha256[row["path"]] = row["sha256"]
    return by_repository


@dataclass(frozen=True)
class ModelRequest:
    name: str  # name of the model folder
    repository: str  # owner/name on the hub
    release: Release | None
    variant: str  # suffix of the networks; empty for full precision

    @staticmethod
    def named(name: str, variant: str) -> "ModelRequest":
        """Find a model by release name or owner/name; raise a DownloadError for any other name."""
        ending = f"-{variant}" if variant else ""
        for release in RELEASES:
            if name in (release.name, release.repository):
                return ModelRequest(f"{release.name}{ending}", release.repository, release, variant)
        try:
            validate_repo_id(name)
        except HFValidationError as error:
            problem = f"{name!r} is not a repository name: {error}"
            raise DownloadError(problem, fix="write owner/name") from error
        if name.count("/") != 1:
            names = ", ".join(release.name for release in RELEASES)
            raise DownloadError(
                f"unknown model {name!r}",
                expected=f"{names}, or owner/name on the hub",
                fix="choose one from `hilsplat models list`, or write owner/name",
            )
        return ModelRequest(f"{name.split('/')[1]}{ending}", name, None, variant)


def networks_of(kind: str) -> list[tuple[str, ...]]:
    """Return the possible paths of each network, without `.onnx`; the usual path is first."""
    return [spec.places[::-1] for spec in LAYOUTS[kind].networks.values()]


@dataclass(frozen=True)
class HubFile:
    path: str
    size: int
    digest: str  # pinned or listed: SHA-256 (64 digits), or git's SHA-1 of a small file (40 digits)
    cached: Path | None = None  # the file in the hub's local cache, if the listing was read from the cache

    def digest_of(self, path: Path) -> str:
        """Return the digest of a local file, computed in the same way as the listed digest."""
        return sha256_of_file(path) if len(self.digest) == 64 else git_hash(path.read_bytes())


@dataclass(frozen=True)
class Listing:
    """A repository at one commit."""

    repository: str
    revision: str
    licence: str  # empty if the hub reports none
    files: Mapping[str, HubFile]  # by path

    def require(self, *paths: str) -> list[HubFile]:
        """Return files by path; raise a DownloadError if the repository lacks one of them."""
        if missing := [path for path in paths if path not in self.files]:
            raise DownloadError(
                f"{self.repository} lacks {', '.join(missing)}",
                expected="a model in the layout of the Hugging Face ONNX exports, or PyTorch weights",
                found=", ".join(sorted(self.files)[:20]),
                fix="choose another repository (hilsplat models list)",
            )
        return [self.files[path] for path in paths]


@dataclass(frozen=True)
class Choice:
    """The files to download."""

    files: Mapping[str, str]  # path in the repository -> path in the model folder
    exported: bool = False  # the files are PyTorch weights, from which networks are exported


def read_listing(repository: str, revision: str | None) -> Listing:
    """Request the listing of a repository from the hub.

    Raises:
        requests.RequestException: the hub is unreachable, busy or denies access.
        OfflineModeIsEnabled: HF_HUB_OFFLINE is set.
        DownloadError: the response is not a listing, or it lacks the size or digest of a file.
    """

    def request() -> ModelInfo:
        api = huggingface_hub.HfApi()
        return api.model_info(repository, revision=revision, timeout=TIMEOUT_S, files_metadata=True)

    try:
        info = repeated(f"listing of {repository}", request)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        if isinstance(error, OSError) and not isinstance(error, requests.exceptions.JSONDecodeError):
            raise  # a refusal of the hub
        raise DownloadError(
            f"{constants.ENDPOINT} sent an invalid listing of {repository}",
            found=f"{type(error).__name__}: {first_line(error)}",
            fix="unset HF_ENDPOINT, or set it to a complete mirror; a proxy may also have answered",
        ) from error
    pinned, files = _pinned_digests(repository, str(info.sha)), {}
    for file in info.siblings or ():
        path = file.rfilename
        if not _is_inside(path):
            continue  # valid repositories have no such path; the file would be written outside the folder
        digest = pinned.get(path) or (file.lfs.sha256 if file.lfs else file.blob_id)
        if digest is None or file.size is None:
            problem = f"{constants.ENDPOINT} reports no size or digest for {path} (?blobs=true)"
            raise DownloadError(problem, fix="unset HF_ENDPOINT, or set it to a complete mirror")
        files[path] = HubFile(path, file.size, digest)
    licence = getattr(info.card_data, "license", None)
    return Listing(repository, str(info.sha), first_line(licence) if licence else "", files)


def read_cached_listing(repository: str, revision: str | None) -> Listing | None:
    """Return a repository's listing from the hub's local cache (HF_HOME; files named by digest), or None."""
    try:
        folder = huggingface_hub.snapshot_download(repository, revision=revision, local_files_only=True)
    except LocalEntryNotFoundError:
        return None
    snapshot = Path(folder)
    pinned, files = _pinned_digests(repository, snapshot.name), {}
    for file in filter(Path.is_file, snapshot.rglob("*")):
        path = file.relative_to(snapshot).as_posix()
        files[path] = HubFile(path, file.stat().st_size, pinned.get(path) or file.resolve().name, file)
    return Listing(repository, snapshot.name, "", files)


def _pinned_digests(repository: str, commit: str) -> Mapping[str, str]:
    """Return the known SHA-256 digests of a repository's files at a commit; empty for other commits."""
    pin = pins().get(repository)
    return pin.sha256 if pin is not None and pin.commit == commit else {}


def _is_inside(path: str) -> bool:
    """Return whether a listed path stays inside the folder to which it is appended, on any system."""
    parts = path.replace("\\", "/").split("/")
    return path.isprintable() and ":" not in path and not {"", ".", ".."}.intersection(parts)


def choose_files(listing: Listing, config: bytes, variant: str = "") -> Choice:
    """Choose the files of a model: separate networks, else one CLIP network, else PyTorch weights.

    Args:
        config: the repository's config.json.
        variant: suffix of the networks, such as "quantized" or "fp16", which is removed from their names;
            empty for the plain networks.

    Raises:
        DownloadError: the model is not supported, or it has neither networks nor weights.
    """
    try:
        described = parse_json(config)
    except ValueError:
        described = None
    kind = layout_of(described)
    if kind is None:
        found = f"model_type {described.get('model_type')!r}" if isinstance(described, dict) else "no object"
        raise DownloadError(
            f"{listing.repository} contains no supported model",
            expected="; ".join(SUPPORTED.values()),
            found=found,
            fix="choose a SAM or CLIP model (hilsplat models list)",
        )
    layout, ending = LAYOUTS[kind], f"_{variant}" if variant else ""
    for networks in (networks_of(kind), [WHOLES if kind in ("clip", "siglip") else ()]):
        present = [
            [stem for stem in places if f"{stem}{ending}.onnx" in listing.files] for places in networks
        ]
        if all(present):
            chosen = [places[0] for places in present]
            listing.require(*layout.described)
            plain = [*layout.described, *(path for path in layout.beside if path in listing.files)]
            files = {f"{stem}{ending}.onnx": f"{stem}.onnx" for stem in chosen}
            # external weights keep their names, because the networks refer to them by name
            prefixes = tuple(f"{network}{mark}data" for network in files for mark in "_.")
            weights = [path for path in listing.files if path.startswith(prefixes)]
            return Choice({**{path: path for path in (*plain, *weights)}, **files})
    weights = [name for name in WEIGHTS if name in listing.files][:1]
    if variant or not weights:
        listing.require(*(f"{places[0]}{ending}.onnx" for places in networks_of(kind)))
    at_root = [file for path, file in listing.files.items() if "/" not in path and file.size < SMALL_BYTES]
    texts = [file.path for file in at_root if file.path.endswith((".json", ".txt"))]
    listing.require(*(name for name in layout.described if name != "tokenizer.json"))
    return Choice({path: path for path in [*texts, *weights]}, exported=True)
