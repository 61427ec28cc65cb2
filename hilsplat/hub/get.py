"""`hilsplat models get`: download of models from the hub; only complete, checked models are installed.

PyTorch weights are exported to ONNX networks by optimum, in a separate process (install the extra `export`).
"""

import logging
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import huggingface_hub
import requests
from huggingface_hub import constants
from huggingface_hub.errors import GatedRepoError, RepositoryNotFoundError
from huggingface_hub.utils import disable_progress_bars

from hilsplat.base.artifacts import read_json, read_memo, write_json
from hilsplat.base.atomic import FULL_DISK, atomic_folder, explain_full_disk, output_lock, require_free_space
from hilsplat.base.errors import DownloadError, ModelError, first_line
from hilsplat.base.lineage import sha256_of_file
from hilsplat.base.progress import track
from hilsplat.base.removal import delete, is_tagged, tag
from hilsplat.embed.model_check import check_model
from hilsplat.hub.catalogue import (
    OUT_OF_REACH,
    Choice,
    HubFile,
    Listing,
    ModelRequest,
    choose_files,
    networks_of,
    pins,
    read_cached_listing,
    read_listing,
)
from hilsplat.hub.retries import WRONG_LENGTH, reason_of, repeated
from hilsplat.models.folder import ModelFolder, preprocessing_of
from hilsplat.models.int8 import LARGE_BYTES
from hilsplat.models.layouts import LAYOUTS, layout_of
from hilsplat.models.memory import needs_of
from hilsplat.models.onnx_graph import external_files, split_clip, whole_clip
from hilsplat.models.store import RECOMMENDED, real_model, user_models

logger = logging.getLogger(__name__)

ORIGIN = "origin.json"  # file in a model folder that records its origin
STAGING = ".{name}.part"  # name of a download's folder, beside the model's
KEPT = "transferred data is kept, and the transfer resumes"
SPARE_BYTES = 200_000_000  # disk space that must remain free after a transfer
EXPORT_FACTOR = 4
"""Disk space for an export, as a multiple of the weights' size: weights, complete network, and its halves."""
INT8_SHARE = 0.27  # size of int8 networks, relative to float32
BATCHES = {"sam": 16, "clip": 64}  # prompts or crops per call for which the memory is reported
NEEDED = ("optimum-onnx", "transformers", "torch")  # packages that an export requires
INSTALL = "pip install --constraint constraints.txt --editable '.[export]'"
LAST_LINES = 15  # number of lines of the exporter's output shown in an error
BETWEEN = (
    (
        requests.exceptions.SSLError,
        "no trusted certificate from",
        "if a proxy replaces certificates, set REQUESTS_CA_BUNDLE to the file of its certificate",
    ),
    (
        requests.exceptions.ProxyError,
        "the proxy does not connect to",
        "correct HTTPS_PROXY and HTTP_PROXY, or unset them to connect without a proxy",
    ),
)
"""Errors raised by a proxy between this machine and the hub: type, problem and fix."""


@dataclass(frozen=True)
class Download:
    """A model to download, with the required files."""

    requested: ModelRequest
    listing: Listing
    choice: Choice
    staging: Path  # folder of the download; kept after a failure, for resuming
    target: Path

    def num_bytes(self, *, missing: bool = False) -> int:
        """Return the total size of the required files, or only of those not transferred yet."""
        paths = [path for path in self.choice.files if not (missing and (self.staging / path).is_file())]
        return sum(self.listing.files[path].size for path in paths)


def get_models(
    names: Sequence[str], models: Path | None = None, revision: str | None = None, variant: str = ""
) -> str:
    """Download, check and install models; return a report that also lists the models used for photographs.

    Args:
        names: released models, or owner/name; empty for the recommended pair.
        models: parent folder of the models; None for the user's models.
        revision: branch, tag or commit of a single model; None for the pinned commit of a released model
            (`pins`), or the default branch of another repository.
        variant: precision of the networks, such as "quantized" or "fp16"; empty for full precision.

    Raises:
        DownloadError: the hub is unreachable, denies access, lacks files, or sends files with wrong digests.
        DiskSpaceError: the disk is full or fills up; transferred data is kept.
        ModelError: a downloaded model does not work, or cannot be exported.
    """
    models = models or user_models()
    if not names:
        logger.info("downloading the recommended pair: %s", " and ".join(RECOMMENDED))
    if revision is not None and len(names) != 1:
        raise DownloadError(f"--revision requires one model, found {len(names)} names", fix="pass one model")
    downloads, reports = [], []
    for requested in dict.fromkeys(ModelRequest.named(name, variant) for name in names or RECOMMENDED):
        target = models / requested.name
        with explain_refusals(requested, models):
            listing = _listing(requested, revision)
            if _is_present(requested, target, listing):
                reports.append(f"{target} already exists, from {listing.repository} at {listing.revision}")
            else:
                downloads.append(_prepare(requested, listing, target))
    if downloads:
        missing = sum(download.num_bytes(missing=True) for download in downloads)
        exports = sum(download.num_bytes() for download in downloads if download.choice.exported)
        free = shutil.disk_usage(models).free
        logger.info("%.1f MB to download; %.1f GB free on the disk of %s", missing / 1e6, free / 1e9, models)
        require_free_space(models, (missing + exports * (EXPORT_FACTOR - 1) + SPARE_BYTES) / 2**20)
    for download in downloads:
        with explain_refusals(download.requested, models), output_lock(download.target):
            reports.append(_install(download))
    used = [model.name for family in ("sam", "clip") if (model := real_model(family)) is not None]
    return "\n\n".join([*reports, f"photographs use {' and '.join(used)}"])


def _is_present(requested: ModelRequest, target: Path, listing: Listing) -> bool:
    """Return whether the target was downloaded at this commit and all its files have their original digest.

    A folder that was not downloaded from this repository is refused.
    """
    origin = read_memo(target / ORIGIN, dict[str, Any])
    if not isinstance(origin.get("holds"), dict):
        origin = {}
    if target.exists() and origin.get("repository") != requested.repository:
        raise DownloadError(
            f"{target} already exists and was not downloaded from {requested.repository}",
            found=f"{ORIGIN} of {origin['repository']}" if origin else f"no {ORIGIN}",
            fix="rename or remove that folder, then run the command again",
        )
    if origin and origin.get("revision") != listing.revision:
        logger.info("%s is replaced: it has commit %s", target, origin.get("revision"))
    return origin.get("revision") == listing.revision and all(
        (target / path).is_file() and sha256_of_file(target / path) == sha256
        for path, sha256 in origin["holds"].items()
    )


def _listing(requested: ModelRequest, revision: str | None) -> Listing:
    """Return the listing from the hub or, if the hub is unreachable, from its cache on this machine."""
    repository, pin = requested.repository, pins().get(requested.repository)
    if revision is None and pin is not None:
        revision = pin.commit
    try:
        listing = read_listing(repository, revision)
        if pin is not None and revision == pin.commit != listing.revision:
            raise DownloadError(
                f"{constants.ENDPOINT} does not serve the pinned commit of {repository}",
                expected=revision,
                found=first_line(listing.revision),
                fix="use another mirror (HF_ENDPOINT), or accept its commit: --revision main",
            )
        return listing
    except OUT_OF_REACH as error:
        cached = read_cached_listing(repository, revision)
        other = read_cached_listing(repository, None) if cached is None and pin is not None else None
        if other is not None:
            raise DownloadError(
                f"the hub is unreachable, and its cache has another commit of {repository}",
                expected=revision,
                found=other.revision,
                fix=f"accept it: hilsplat models get {requested.name} --revision main",
            ) from error
        if cached is None:
            raise
        logger.info("the hub is unreachable; %s is read from the local cache", requested.repository)
        return cached


def _prepare(requested: ModelRequest, listing: Listing, target: Path) -> Download:
    """Choose the files to download according to the repository's config.json."""
    staging = target.with_name(STAGING.format(name=target.name))
    tag(staging)
    if not is_tagged(staging):  # it has files
        raise DownloadError(f"{staging} exists, but is not a download of this version", fix="remove it first")
    (config,) = listing.require("config.json")
    choice = choose_files(listing, _fetch(listing, config, staging).read_bytes(), requested.variant)
    download = Download(requested, listing, choice, staging, target)
    licence = requested.release.licence if requested.release else "not stated by the hub"
    source = f"{requested.name}: {requested.repository} at {listing.revision[:12]}"
    size = f"{download.num_bytes() / 1e6:.1f} MB in {len(choice.files)} files"
    left = f"{download.num_bytes(missing=True) / 1e6:.1f} MB still to download"
    logger.info("%s, %s, %s; licence: %s", source, size, left, listing.licence or licence)
    logger.info("%s: %s", requested.name, _needs(download))
    if choice.exported:
        require_exporter(requested.repository)
    return download


def _needs(download: Download) -> str:
    """Describe the disk space and memory that a model needs."""
    config = read_json(download.staging / "config.json")
    layout = layout_of(config)
    assert layout is not None  # `choose_files` refuses other models
    (file,) = download.listing.require(LAYOUTS[layout].preprocessing)
    preprocessing = preprocessing_of(_fetch(download.listing, file, download.staging))
    model = ModelFolder(download.staging, layout, config, preprocessing, {}, ())
    num_bytes, is_reduced = download.num_bytes(), bool(download.requested.variant)
    memory = needs_of(model, BATCHES[model.kind], as_exported=is_reduced, num_bytes=num_bytes)
    memory_mib, has_int8 = memory.total_mib(1), not is_reduced and num_bytes <= LARGE_BYTES
    disk = f"needs {num_bytes * (1 + INT8_SHARE * has_int8) / 1e6:.0f} MB of disk space"
    disk += " with its int8 networks" * has_int8
    export = f"; its export needs about {3 * num_bytes / 1e9:.1f} GB" if download.choice.exported else ""
    return f"{disk}, and about {memory_mib * 2**20 / 1e9:.1f} GB of memory on a CPU{export}"


def _install(download: Download) -> str:
    """Download all files, complete and check the model in a new folder, and replace the target by it."""
    listing, staging, files = download.listing, download.staging, dict(download.choice.files)
    for path in track(list(files), f"files of {download.requested.name}"):
        _fetch(listing, listing.files[path], staging)
    for network in [path for path in files if path.endswith(".onnx")]:
        for name in external_files(staging / network):  # weights in files of any name
            path = (Path(network).parent / name).as_posix()
            if path in listing.files and path not in files:
                _fetch(listing, listing.files[path], staging)
                files[path] = path
    with atomic_folder(download.target) as folder:
        versions = {}
        if download.choice.exported:
            versions = {"exported": export_networks(staging, folder)}
        else:
            for path, target in files.items():
                (folder / target).parent.mkdir(parents=True, exist_ok=True)
                try:
                    (folder / target).hardlink_to(staging / path)
                except OSError:  # the file system has no hard links
                    shutil.copyfile(staging / path, folder / target)
        report = _complete(folder, download.target, listing.require(*sorted(files)), listing, **versions)
        _keep_others(download.target, folder)
    delete(staging, STAGING.format(name=re.escape(download.target.name)))
    return report


def _keep_others(former: Path, folder: Path) -> None:
    """Copy the files that a former version did not download, such as a vocabulary, into the new version."""
    downloaded = {ORIGIN, *(read_json(former / ORIGIN)["holds"] if former.exists() else ())}
    for path in former.rglob("*"):
        name = path.relative_to(former)
        if path.is_dir() or name.as_posix() in downloaded:
            continue
        if (folder / name).exists():
            raise DownloadError(
                f"{path} was not downloaded, and the new version has a file of this name",
                fix="rename or move it, then run the command again",
            )
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, folder / name, follow_symlinks=False)


def _fetch(listing: Listing, file: HubFile, staging: Path) -> Path:
    """Fetch a file or its missing part; delete the file and raise an error if its digest is wrong."""
    target = staging / file.path
    if target.is_file() and file.digest_of(target) == file.digest:
        return target
    if file.cached is None:
        _download(listing, file, staging)
    else:
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file.cached, target)
    digest, size = file.digest_of(target), target.stat().st_size
    if digest != file.digest:
        delete(target, re.escape(target.name))
        raise DownloadError(
            f"{file.path} of {listing.repository} does not have the expected digest",
            expected=f"digest {file.digest}, {file.size} bytes",
            found=f"digest {digest}, {size} bytes; the file was deleted",
            fix="run the command again; if the error persists, a proxy or mirror probably modifies the file",
        )
    return target


def _download(listing: Listing, file: HubFile, staging: Path) -> None:
    """Download a file with `huggingface_hub`, which resumes; see `repeated` for further attempts."""
    if not sys.stderr.isatty():
        disable_progress_bars()
    try:
        repeated(
            file.path,
            lambda: huggingface_hub.hf_hub_download(
                listing.repository, file.path, revision=listing.revision, local_dir=staging
            ),
        )
    except (RuntimeError, ValueError) as error:  # raised by hf_xet, which has no errors of its own
        if (
            constants.HF_HUB_DISABLE_XET
            or isinstance(error, OSError)
            or any(words in str(error) for words in FULL_DISK)
        ):
            raise
        raise DownloadError(
            f"{file.path} of {listing.repository} cannot be downloaded by Xet",
            found=first_line(error),
            fix="transfer it by HTTP: unset HF_HUB_DISABLE_XET, then run the command again",
        ) from error


def _complete(folder: Path, target: Path, files: list[HubFile], listing: Listing, **more: Any) -> str:
    """Check a model folder, write `origin.json` into it, and return the report."""
    if whole := whole_clip(folder):
        split_clip(folder)
        delete(whole)
    report = check_model(folder).replace(str(folder), str(target))
    contents = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.name != ORIGIN]
    origin = {
        "repository": listing.repository,
        "revision": listing.revision,
        "files": [
            {
                "path": file.path,
                "bytes": file.size,
                "sha256" if len(file.digest) == 64 else "git_sha1": file.digest,
            }
            for file in files
        ],
        **more,
        "holds": {path.relative_to(folder).as_posix(): sha256_of_file(path) for path in contents},
    }
    write_json(folder / ORIGIN, origin)
    return report


@contextmanager
def explain_refusals(requested: ModelRequest, models: Path) -> Iterator[None]:
    """Convert errors from the network, the hub and a full disk into errors with a fix."""
    url = f"{constants.ENDPOINT}/{requested.repository}"
    try:
        with explain_full_disk(models / requested.name):
            yield
    except (requests.RequestException, *OUT_OF_REACH) as error:
        answered = reason_of(error)
        for kind, problem, fix in BETWEEN:
            if isinstance(answered, kind):
                problem = f"{requested.repository} cannot be downloaded: {problem} {url}"
                raise DownloadError(problem, found=_innermost(error), fix=fix) from error
        if isinstance(answered, requests.HTTPError) and answered.response is not None:
            raise _refused(answered, answered.response, requested.repository, url) from error
        families = [requested.release.family] if requested.release else ["sam", "clip"]
        ending = f"_{requested.variant}.onnx" if requested.variant else ".onnx"
        networks = [f"{places[0]}{ending}" for family in families for places in networks_of(family)]
        files = [*(file for family in families for file in LAYOUTS[family].described), *networks]
        raise DownloadError(
            f"{requested.repository} cannot be downloaded: {type(error).__name__}, {url} is unreachable",
            found="HF_HUB_OFFLINE is set" if constants.HF_HUB_OFFLINE else _innermost(error),
            fix=f"run the command again when the hub is reachable ({KEPT}; HF_ENDPOINT sets a mirror, "
            f"HTTPS_PROXY a proxy), or download these files from {url} into {models / requested.name}: "
            f"{', '.join(dict.fromkeys(files))}",
        ) from error
    except OSError as error:
        if not str(error).startswith(WRONG_LENGTH):
            raise
        raise DownloadError(
            f"{requested.repository} cannot be downloaded: a file does not have the announced length",
            found=first_line(error),
            fix="run the command again; if the error persists, a proxy or mirror truncates files",
        ) from error


def _refused(
    error: requests.HTTPError, response: requests.Response, repository: str, url: str
) -> DownloadError:
    """Return the error for a response with a status other than 2xx; `place` is the repository's page."""
    status, found = f"({response.status_code} {first_line(response.reason)})", str(response.url)
    if isinstance(error, GatedRepoError):
        problem = f"{repository} requires you to accept its terms before downloading {status}"
        fix = f"accept them at {url}, run `hf auth login` or set HF_TOKEN, and run the command again"
    elif isinstance(error, RepositoryNotFoundError):
        problem = f"the hub has no repository {repository}, or it is private {status}"
        fix = f"correct the name (hilsplat models list), or log in (`hf auth login`, HF_TOKEN) to use {url}"
    elif response.status_code == requests.codes.too_many_requests:
        problem = f"the hub refused {repository}: too many requests {status}"
        found = f"Retry-After: {first_line(response.headers.get('Retry-After', 'not stated'))}"
        fix = f"run the command again later ({KEPT}); `hf auth login` or HF_TOKEN raises the limit"
    elif response.status_code in (requests.codes.unauthorized, requests.codes.forbidden):
        problem = f"the hub denies access to {repository} {status}"
        fix = f"see {url}; run `hf auth login`, or set HF_TOKEN to a token with access"
    elif response.status_code == requests.codes.not_found:
        problem = f"the hub does not have this revision or file of {repository} {status}"
        fix = f"correct the name or --revision ({url} lists what exists); --revision main is the newest"
    else:
        problem = f"the hub failed to serve {repository} {status}"
        fix = f"run the command again later: {KEPT}"
    return DownloadError(problem, found=found, fix=fix)


def _innermost(error: BaseException) -> str:
    """Return the message of an error's root cause."""
    while (cause := error.__cause__ or error.__context__) is not None:
        error = cause
    return first_line(error)


def require_exporter(what: str) -> None:
    """Raise a ModelError before anything is downloaded if the exporter's packages are not installed."""
    if missing := [name for name in NEEDED if not any(metadata.distributions(name=name))]:
        raise ModelError(
            f"{what} has no ONNX networks, and the packages that export them are not installed",
            expected=f"the extra export: {', '.join(NEEDED)}",
            found=f"no {', '.join(missing)}",
            fix=f"{INSTALL}, then run the command again",
        )


def export_networks(weights: Path, out: Path) -> dict[str, str]:
    """Export the networks of a SAM or CLIP model saved by transformers; return the packages' versions."""
    logger.info("exporting to ONNX; this takes minutes, and about three times as much memory as the weights")
    words = ("export", "onnx", "--model", str(weights), "--task", "feature-extraction", str(out))
    done = subprocess.run(
        [sys.executable, "-m", "optimum.commands.optimum_cli", *words],
        env={**os.environ, "HF_HUB_OFFLINE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        lines = (done.stdout + done.stderr).strip().splitlines()[-LAST_LINES:]
        raise ModelError(
            f"the weights in {weights} cannot be exported: the exporter exited with {done.returncode}",
            found="\n            ".join(lines) or "no output",
            fix=f"install the tested versions ({INSTALL}), then run the command again",
        )
    return {name: metadata.version(name) for name in NEEDED}
