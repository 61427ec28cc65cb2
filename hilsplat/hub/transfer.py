"""Bytes from the hub: resumed where a cut left them, patient with a busy hub, checked against its digest."""

import hashlib
import logging
import re
import shutil
import time
from collections.abc import Callable
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import TypeVar

import huggingface_hub
import requests
from huggingface_hub.utils import build_hf_headers, get_session, hf_raise_for_status

from hilsplat.base.artifacts import explain_full_disk
from hilsplat.base.errors import DownloadError
from hilsplat.hub.listing import HubFile, Listing

logger = logging.getLogger(__name__)
Answer = TypeVar("Answer")

CHUNK_BYTES = 2**16
"""Bytes read at once; a cut loses no more than these."""

TRIES = 5
"""Failures in a row, without a new byte, after which a transfer gives up."""

MAX_WAIT_S = 330.0
"""Longest wait that the hub may ask for: its limits count over five minutes."""

BUSY = (429, 500, 502, 503, 504)
"""Answers of a hub that may answer otherwise later."""


def fetch(listing: Listing, file: HubFile, target: Path, tell: Callable[[int], None]) -> None:
    """Bring one file, from the hub's cache on this machine or from the hub, and check it.

    Args:
        listing: the repository.
        file: what to fetch.
        target: where to; a part kept from before is beside it, and is continued.
        tell: called with the number of bytes reached.

    Raises:
        DownloadError: the bytes are not those that the hub states; they are deleted.
        DiskSpaceError: the disk is full.
        requests.RequestException: the hub cannot be reached any more, or refuses.
    """
    if not (target.is_file() and _digest(file, target) == file.digest):  # else it is whole from before
        target.parent.mkdir(parents=True, exist_ok=True)
        part = partial(file, target)
        cached = file.cached or huggingface_hub.try_to_load_from_cache(
            listing.repository, file.path, revision=listing.revision
        )
        with explain_full_disk(target):
            if isinstance(cached, str | Path):
                shutil.copyfile(cached, part)
            else:
                patiently(lambda: _continue(listing, file, part, tell), lambda: _size(part))
        _require_digest(listing, file, part)
        part.replace(target)
    tell(file.size)


def partial(file: HubFile, target: Path) -> Path:
    """Where a file grows: named by digest too, so that another revision does not continue it."""
    return target.with_name(f"{target.name}.{file.digest[:12]}.part")


def patiently(
    attempt: Callable[[], Answer], reached: Callable[[], int] = lambda: 0, tries: int = TRIES
) -> Answer:
    """Call until it succeeds; wait after a cut or a busy answer, as long as the hub asks or ever longer.

    Args:
        attempt: what to do.
        reached: how far it has come; failures that bring it further do not count.
        tries: failures in a row after which to give up.

    Raises:
        requests.RequestException: that of the last attempt, or one that waiting cannot mend.
    """
    failures, before = 0, reached()
    while True:
        try:
            return attempt()
        except requests.RequestException as error:
            now = reached()
            failures, before = (1 if now > before else failures + 1), max(now, before)
            wait_s = _wait_s(error, failures)
            if wait_s is None or failures >= tries:
                raise
            logger.info("%s; trying again in %.0f s", _cause(error), wait_s)
            time.sleep(wait_s)


def _wait_s(error: requests.RequestException, failures: int) -> float | None:
    """Seconds to wait after an error: what the hub asks for, else 1, 2, 4, ...; None if it is useless."""
    backoff = float(2 ** (failures - 1))
    if error.response is None:
        return backoff
    if error.response.status_code not in BUSY:
        return None
    asked = _asked_wait_s(error.response)
    if asked is None:
        return backoff
    return asked if asked <= MAX_WAIT_S else None


def _asked_wait_s(response: requests.Response) -> float | None:
    """Seconds that an answer asks to wait: Retry-After (seconds or a date), or the hub's own RateLimit."""
    text = response.headers.get("Retry-After", "").strip()
    if re.fullmatch(r"\d+(\.\d+)?", text):
        return float(text)
    if text:
        try:
            return max(0.0, parsedate_to_datetime(text).timestamp() - time.time())
        except ValueError:
            return None
    limit = re.search(r";\s*t=(\d+)", response.headers.get("RateLimit", ""))
    return float(limit[1]) if limit else None


def _cause(error: requests.RequestException) -> str:
    """An error in a few words."""
    if error.response is not None:
        return f"the hub answers {error.response.status_code} {error.response.reason}"
    return f"the connection to the hub was lost ({type(error).__name__})"


def _continue(listing: Listing, file: HubFile, part: Path, tell: Callable[[int], None]) -> None:
    """Ask for the bytes that are missing and append them."""
    done = _size(part)
    if done > file.size:
        part.unlink()
        done = 0
    if done == file.size and part.exists():
        return
    url = huggingface_hub.hf_hub_url(
        listing.repository,
        file.path,
        revision=listing.revision,
        endpoint=huggingface_hub.constants.ENDPOINT,
    )
    headers = {**build_hf_headers(), "Accept-Encoding": "identity"}
    if done:
        logger.info("%s: resuming at byte %d of %d", file.path, done, file.size)
        headers["Range"] = f"bytes={done}-"
    timeout_s = huggingface_hub.constants.HF_HUB_DOWNLOAD_TIMEOUT
    with get_session().get(url, headers=headers, stream=True, timeout=timeout_s) as response:
        hf_raise_for_status(response)
        with part.open("ab" if response.status_code == requests.codes.partial else "wb") as stream:
            for chunk in response.iter_content(CHUNK_BYTES):
                stream.write(chunk)
                tell(stream.tell())
    if _size(part) < file.size:
        raise requests.exceptions.ChunkedEncodingError(f"{file.path} ended early")


def _size(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0


def _digest(file: HubFile, path: Path) -> str:
    """Digest of a file's bytes, of the kind that the hub states for it."""
    with path.open("rb") as stream:
        if len(file.digest) == 64:
            return hashlib.file_digest(stream, "sha256").hexdigest()
        content = stream.read()
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


def _require_digest(listing: Listing, file: HubFile, arrived: Path) -> None:
    """Compare a file with what the hub states; a wrong one is deleted, for it cannot be continued."""
    found = _digest(file, arrived)
    if found != file.digest:
        size = _size(arrived)
        arrived.unlink()
        raise DownloadError(
            f"{file.path} of {listing.repository} arrived with other bytes than the hub states",
            expected=f"digest {file.digest}, {file.size} bytes",
            found=f"digest {found}, {size} bytes; they were deleted",
            fix="run the command again; if it happens again, a proxy or mirror changes the file",
        )
