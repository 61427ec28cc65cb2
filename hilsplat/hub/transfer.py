"""Downloads from the hub: resumed after an interruption, retried if the hub is busy, checked by digest."""

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
"""Bytes read at once; an interruption loses at most this many."""

TRIES = 5
"""Consecutive failures without a new byte after which a transfer is aborted."""

MAX_WAIT_S = 330.0
"""Longest wait that is accepted from the hub: its rate limits apply to windows of five minutes."""

BUSY = (429, 500, 502, 503, 504)
"""Status codes after which a later request may succeed."""


def fetch(listing: Listing, file: HubFile, target: Path, tell: Callable[[int], None]) -> None:
    """Fetch one file, from the hub's cache on this machine or from the hub, and check it.

    Args:
        listing: the repository.
        file: the file to fetch.
        target: path to write; an earlier partial download beside it is resumed.
        tell: callback for the number of bytes transferred.

    Raises:
        DownloadError: the digest differs from the hub's; the bytes are deleted.
        DiskSpaceError: the disk is full.
        requests.RequestException: the hub is unreachable, or refuses.
    """
    if not (target.is_file() and _digest(file, target) == file.digest):  # else an earlier run completed it
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
    """Return the path of a partial download, with the digest so that another revision is not resumed."""
    return target.with_name(f"{target.name}.{file.digest[:12]}.part")


def patiently(
    attempt: Callable[[], Answer], reached: Callable[[], int] = lambda: 0, tries: int = TRIES
) -> Answer:
    """Retry until success, and wait between attempts as long as the hub requests or with exponential backoff.

    Args:
        attempt: function to call.
        reached: returns the progress; a failure after progress restarts the count.
        tries: consecutive failures after which to give up.

    Raises:
        requests.RequestException: the error of the last attempt, or one that retrying cannot fix.
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
    """Return the seconds to wait after an error (the hub's value, else 1, 2, 4, ...); None: do not retry."""
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
    """Return the seconds to wait from a response: Retry-After (seconds or a date) or the hub's RateLimit."""
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
    if error.response is not None:
        return f"the hub answers {error.response.status_code} {error.response.reason}"
    return f"the connection to the hub was lost ({type(error).__name__})"


def _continue(listing: Listing, file: HubFile, part: Path, tell: Callable[[int], None]) -> None:
    """Request the missing bytes and append them."""
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
    """Return the digest of a file, of the kind that the hub lists for it."""
    with path.open("rb") as stream:
        if len(file.digest) == 64:
            return hashlib.file_digest(stream, "sha256").hexdigest()
        content = stream.read()
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


def _require_digest(listing: Listing, file: HubFile, arrived: Path) -> None:
    """Check a file's digest; delete a wrong file, because it cannot be resumed."""
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
