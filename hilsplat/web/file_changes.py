"""Errors about files that changed since they were opened or read; versions of saved files."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hilsplat.base.artifacts import output_lock, sha256_of_bytes
from hilsplat.base.errors import ArtifactError


class StaleSceneError(ArtifactError):
    """A part of the scene was rewritten since it was opened."""


class StaleFileError(ArtifactError):
    """A file changed since the version that is to be replaced was read."""


NO_FILE = "none"
"""Version of a file that does not exist."""


def version_of(path: Path) -> str:
    """Return the digest of a file, which a page must send to replace it."""
    return sha256_of_bytes(path.read_bytes())[:16] if path.is_file() else NO_FILE


@contextmanager
def replacing(path: Path, version: str, what: str) -> Iterator[None]:
    """Lock a file while its content is replaced; `what` describes the content in errors (plural).

    Raises:
        StaleFileError: the file changed since `version` was read.
    """
    with output_lock(path):
        if version_of(path) != version:
            raise StaleFileError(
                f"{what} have changed since they were read", fix="reload the page, then change them"
            )
        yield
