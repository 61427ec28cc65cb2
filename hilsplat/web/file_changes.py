"""Errors about files that changed after they were opened or read, and versions of saved files."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hilsplat.base.atomic import changing
from hilsplat.base.errors import ArtifactError
from hilsplat.base.lineage import sha256_of_bytes


class StaleSceneError(ArtifactError):
    """A part of the scene was rewritten after it was opened."""


class StaleFileError(ArtifactError):
    """A file changed after the version to be replaced was read."""


NO_FILE = "none"  # version of a file that does not exist


def version_of(path: Path) -> str:
    """Return the digest of a file; a page must send this digest to replace the file."""
    return sha256_of_bytes(path.read_bytes())[:16] if path.is_file() else NO_FILE


@contextmanager
def replacing(path: Path, version: str, what: str) -> Iterator[Path]:
    """Lock and yield a file, or the one it links to, while its content is replaced.

    Args:
        what: the content in errors (plural).

    Raises:
        StaleFileError: the file changed since `version` was read.
    """
    with changing(path) as path:
        if version_of(path) != version:
            raise StaleFileError(
                f"{what} have changed since they were read", fix="repeat the change on the new ones"
            )
        yield path
