"""Repetition of requests that failed for reasons that may pass."""

import logging
import time
from collections.abc import Callable
from typing import TypeVar

import requests
from huggingface_hub.errors import LocalEntryNotFoundError, OfflineModeIsEnabled
from urllib3.exceptions import InvalidHeader
from urllib3.util import Retry

from hilsplat.base.errors import first_line

logger = logging.getLogger(__name__)

WAITS_S = (1.0, 2.0, 4.0, 8.0)  # waiting times between attempts
MAX_WAIT_S = 120.0  # longest waiting time accepted from a `Retry-After` header
BROKEN = (requests.ConnectionError, requests.Timeout, requests.exceptions.ChunkedEncodingError)
"""Errors raised by a broken connection."""
WRONG_LENGTH = "Consistency check failed"
"""Beginning of huggingface_hub's message about a file of another length than announced."""

Result = TypeVar("Result")


def repeated(what: str, request: Callable[[], Result]) -> Result:
    """Return the result of a request; repeat it after a broken connection, and after status 429 or 5xx.

    Waiting times increase, and `Retry-After` is respected if it is short. The last error is raised.
    """
    for wait_s in WAITS_S:
        try:
            return request()
        except OSError as error:  # the base of the errors of requests and huggingface_hub
            pause_s = _pause_s(error, wait_s)
            if pause_s is None:
                raise
            logger.info("%s: %s; retrying in %g s", what, first_line(reason_of(error)), pause_s)
            time.sleep(pause_s)
    return request()


def reason_of(error: Exception) -> BaseException:
    """Return the request's error behind huggingface_hub's report that a file is not in its cache."""
    return error.__cause__ or error if isinstance(error, LocalEntryNotFoundError) else error


def _pause_s(error: Exception, wait_s: float) -> float | None:
    """Return how long to wait before the next attempt, or None if a further attempt would also fail."""
    reason = reason_of(error)
    if isinstance(reason, OfflineModeIsEnabled | requests.exceptions.SSLError):
        return None
    if isinstance(reason, requests.HTTPError) and reason.response is not None:
        status = reason.response.status_code
        if status != 429 and status < 500:
            return None
        asked_s = retry_after_s(reason.response)
        return None if asked_s > MAX_WAIT_S else max(wait_s, asked_s)
    if isinstance(reason, BROKEN) or str(reason).startswith(WRONG_LENGTH):
        return wait_s
    return None


def retry_after_s(response: requests.Response) -> float:
    """Return the seconds in a response's `Retry-After` header (a number or a date); 0 without a valid one."""
    try:
        return Retry().parse_retry_after(response.headers.get("Retry-After", ""))
    except (InvalidHeader, ValueError, OverflowError):
        return 0.0
