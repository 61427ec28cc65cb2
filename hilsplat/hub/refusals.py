"""Conversion of errors from the network and the hub into errors with a fix."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import requests
from huggingface_hub import constants
from huggingface_hub.errors import GatedRepoError, LocalEntryNotFoundError, RepositoryNotFoundError

from hilsplat.base.errors import DownloadError, HilsplatError
from hilsplat.hub.catalogue import OUT_OF_REACH, ModelRequest, usual_files

KEPT = "what was transferred is kept, and continued"


@contextmanager
def explain_refusals(requested: ModelRequest, models: Path) -> Iterator[None]:
    """Convert errors from the network and the hub into a `DownloadError` with a fix."""
    place = f"{constants.ENDPOINT}/{requested.repository}"
    try:
        yield
    except HilsplatError:
        raise
    except GatedRepoError as error:
        raise DownloadError(
            f"{requested.repository} requires you to accept its terms before downloading ({_status(error)})",
            fix=f"accept its terms at {place}, `hf auth login` or set HF_TOKEN, and run the command again",
        ) from error
    except RepositoryNotFoundError as error:
        raise DownloadError(
            f"the hub has no repository {requested.repository}, or hides it from you ({_status(error)})",
            expected=place,
            fix="correct the name (hilsplat models list); for a private one, `hf auth login` or set HF_TOKEN",
        ) from error
    except (requests.RequestException, *OUT_OF_REACH) as error:
        answered = error.__cause__ if isinstance(error, LocalEntryNotFoundError) else error
        if isinstance(answered, requests.HTTPError) and answered.response is not None:
            raise _refused(answered, requested, place) from error
        families = [requested.release.family] if requested.release else ["sam", "clip"]
        raise DownloadError(
            f"{requested.repository} cannot be fetched: {type(error).__name__}, no way to {place}",
            found="HF_HUB_OFFLINE is set" if constants.HF_HUB_OFFLINE else _innermost(error),
            fix=f"run the command again where the hub can be reached ({KEPT}; HF_ENDPOINT names a mirror, "
            f"HTTPS_PROXY a proxy), or put these files into {models / requested.name} by hand, from {place}: "
            f"{', '.join(file for family in families for file in usual_files(family))}",
        ) from error
    except OSError as error:
        if error.filename is None:
            raise
        raise DownloadError(
            f"{error.filename} cannot be written: {error.strerror}", fix=f"make {models} writable"
        ) from error


def _refused(error: requests.HTTPError, requested: ModelRequest, place: str) -> DownloadError:
    """Return the error for a response with a status other than 2xx."""
    response = error.response
    assert response is not None  # an HTTPError is made from an answer
    status = response.status_code
    if status == requests.codes.too_many_requests:
        return DownloadError(
            f"the hub has had too many requests to serve {requested.repository} now ({_status(error)})",
            found=f"Retry-After: {response.headers.get('Retry-After', 'not stated')}",
            fix=f"run the command again later ({KEPT}); `hf auth login` or HF_TOKEN raises the limit",
        )
    if status in (requests.codes.unauthorized, requests.codes.forbidden):
        return DownloadError(
            f"the hub refuses {requested.repository} ({_status(error)})",
            fix=f"look at {place}; `hf auth login` or set HF_TOKEN to one that may read it",
        )
    if status == requests.codes.not_found:
        return DownloadError(
            f"the hub does not have this revision or file of {requested.repository} ({_status(error)})",
            found=str(response.url),
            fix=f"correct the name or --revision; {place} shows what there is",
        )
    return DownloadError(
        f"the hub does not serve {requested.repository} ({_status(error)})",
        found=str(response.url),
        fix=f"run the command again later: {KEPT}",
    )


def _status(error: requests.HTTPError) -> str:
    return f"{error.response.status_code} {error.response.reason}" if error.response is not None else ""


def _innermost(error: BaseException) -> str:
    """Return the message of an error's root cause."""
    while (cause := error.__cause__ or error.__context__) is not None:
        error = cause
    return str(error) or type(error).__name__
