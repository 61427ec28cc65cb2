"""What a repository of the hub holds, and which of its files a model needs here."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import huggingface_hub
import requests
from huggingface_hub.errors import CacheNotFound, OfflineModeIsEnabled

from hilsplat.base.clip_split import WHOLE
from hilsplat.base.errors import DownloadError
from hilsplat.base.onnx_models import DESCRIPTIONS, KINDS

PLACES = ("onnx/", "")
"""Folders of a repository that may hold its networks, the usual one first."""

BESIDE = ("tokenizer_config.json", "special_tokens_map.json")
"""Files of a CLIP that are taken if they are there."""

WEIGHTS = ("model.safetensors", "pytorch_model.bin")
"""PyTorch weights that can be exported, the preferred one first."""

SMALL_BYTES = 50_000_000
"""Larger text files of a PyTorch model are not part of its tokenizer."""


@dataclass(frozen=True)
class HubFile:
    """A file as the hub states it.

    Attributes:
        path: inside the repository.
        size: bytes.
        digest: SHA-256 of the bytes (64 digits), or git's SHA-1 of a small file (40 digits).
        cached: the file in the hub's cache on this machine, if the listing was made from that.
    """

    path: str
    size: int
    digest: str
    cached: Path | None = None


@dataclass(frozen=True)
class Listing:
    """A repository at one commit.

    Attributes:
        repository: owner/name.
        revision: the commit.
        licence: as the hub states it; empty if it does not.
        files: by path.
    """

    repository: str
    revision: str
    licence: str
    files: Mapping[str, HubFile]

    def require(self, *paths: str) -> list[HubFile]:
        """Files by path.

        Raises:
            DownloadError: the repository lacks some of them.
        """
        if missing := [path for path in paths if path not in self.files]:
            raise DownloadError(
                f"{self.repository} lacks {', '.join(missing)}",
                expected="a model in the layout of the Hugging Face ONNX exports, or one to export",
                found=", ".join(sorted(self.files)[:20]),
                fix="name another repository (hilsplat models list)",
            )
        return [self.files[path] for path in paths]


@dataclass(frozen=True)
class Choice:
    """The files that are fetched.

    Attributes:
        files: file of the repository -> its place in the model's folder.
        exported: they are PyTorch weights, from which the networks are still to be made.
        split: they are a whole CLIP, to be split into its two networks.
    """

    files: Mapping[str, str]
    exported: bool = False
    split: bool = False


def read_listing(repository: str, revision: str | None) -> Listing:
    """Ask the hub what a repository holds.

    Raises:
        requests.RequestException: the hub is out of reach, or refuses.
        OfflineModeIsEnabled: HF_HUB_OFFLINE is set.
        DownloadError: the hub states no digest of a file.
    """
    info = huggingface_hub.HfApi().model_info(repository, revision=revision, files_metadata=True)
    files = {}
    for each in info.siblings or ():
        digest = each.lfs.sha256 if each.lfs else each.blob_id
        if digest is None or each.size is None:
            raise DownloadError(
                f"{huggingface_hub.constants.ENDPOINT} states no size and digest of {each.rfilename}",
                expected="what the hub's API states about each file (?blobs=true)",
                fix="unset HF_ENDPOINT, or name a complete mirror",
            )
        files[each.rfilename] = HubFile(each.rfilename, each.size, digest)
    licence = getattr(info.card_data, "license", None) or ""
    return Listing(repository, str(info.sha), str(licence), files)


def read_cached_listing(repository: str, revision: str | None) -> Listing | None:
    """What the hub's cache on this machine (HF_HOME) holds of a repository; its files are named by digest."""
    try:
        repositories = huggingface_hub.scan_cache_dir(huggingface_hub.constants.HF_HUB_CACHE).repos
    except CacheNotFound:
        return None
    wanted = revision or huggingface_hub.constants.DEFAULT_REVISION
    for repo in repositories:
        if (repo.repo_type, repo.repo_id) != ("model", repository):
            continue
        for snapshot in repo.revisions:
            if wanted in snapshot.refs or wanted == snapshot.commit_hash:
                files = {}
                for each in snapshot.files:
                    path = each.file_path.relative_to(snapshot.snapshot_path).as_posix()
                    files[path] = HubFile(path, each.size_on_disk, each.blob_path.name, each.file_path)
                return Listing(repository, snapshot.commit_hash, "", files)
    return None


def choose_files(listing: Listing, config: bytes, variant: str = "") -> Choice:
    """Which files of a repository make a model: ready networks, else a whole CLIP, else PyTorch weights.

    Args:
        listing: the repository.
        config: its config.json.
        variant: "quantized", "fp16", ...: networks of that ending, which get the plain names; empty: the
            plain ones.

    Raises:
        DownloadError: the model is of no kind that is read here, or it has neither networks nor weights.
    """
    try:
        kind = json.loads(config).get("model_type")
    except (ValueError, AttributeError):
        kind = None
    if kind not in KINDS:
        raise DownloadError(
            f"{listing.repository} is no model that can be used here",
            expected=f"model_type {' or '.join(KINDS)} in config.json",
            found=f"model_type {kind!r}",
            fix="name a SAM or a CLIP (hilsplat models list)",
        )
    ending = f"_{variant}" if variant else ""
    described = [*DESCRIPTIONS[kind], *(name for name in BESIDE if name in listing.files)]
    for names in (tuple(KINDS[kind]), (WHOLE.removesuffix(".onnx"),)):
        for place in PLACES:
            networks = {f"{place}{name}{ending}.onnx": f"onnx/{name}.onnx" for name in names}
            if all(path in listing.files for path in networks):
                # a network looks for its weights under the names that it was saved with
                weights = [
                    path
                    for path in listing.files
                    if any(path.startswith((f"{network}_data", f"{network}.data")) for network in networks)
                ]
                beside = {path: f"onnx/{Path(path).name}" for path in weights}
                listing.require(*described)
                plain = {path: path for path in described}
                return Choice({**plain, **networks, **beside}, split=names != tuple(KINDS[kind]))
    if variant:
        listing.require(*(f"onnx/{name}{ending}.onnx" for name in KINDS[kind]))
    weights = [name for name in WEIGHTS if name in listing.files][:1]
    if not weights:
        listing.require(*(f"onnx/{name}.onnx" for name in KINDS[kind]))
    texts = [
        path
        for path, file in listing.files.items()
        if path.endswith((".json", ".txt")) and "/" not in path and file.size < SMALL_BYTES
    ]
    listing.require(*(name for name in DESCRIPTIONS[kind] if name != "tokenizer.json"))
    return Choice({path: path for path in [*texts, *weights]}, exported=True)


OUT_OF_REACH = (requests.ConnectionError, requests.Timeout, OfflineModeIsEnabled)
"""Errors that say nothing about the repository: there is no way to the hub."""
