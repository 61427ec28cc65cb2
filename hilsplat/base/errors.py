"""Errors that a user can fix: where, expected, found, and the way out."""

import errno


class HilsplatError(Exception):
    """Base of every error that a file, a setting or a user causes.

    The command prints `str(error)` without a traceback and exits with 1.

    Args:
        message: one sentence that names the file, scene, view or key.
        expected: what was expected there.
        found: what was found instead.
        fix: what to do about it.
    """

    def __init__(
        self,
        message: str,
        *,
        expected: object | None = None,
        found: object | None = None,
        fix: str | None = None,
    ) -> None:
        lines = [message]
        for name, value in (("expected", expected), ("found", found), ("fix", fix)):
            if value is not None:
                lines.append(f"  {name:<9} {value}")
        super().__init__("\n".join(lines))

    def add_line(self, name: str, value: object) -> None:
        """Add a line such as `found`, known only to a caller, at the end of the message."""
        self.args = (f"{self}\n  {name:<9} {value}",)


def place_error(error: OSError) -> HilsplatError | None:
    """An error of the system that a user can fix, in words; None for another one.

    Missing files are not among them: every reader says which stage writes its file.
    """
    problem = PLACES.get(error.errno or 0)
    if problem is None or error.filename is None:
        return None
    return HilsplatError(
        f"{error.filename} {problem}",
        found=error.strerror,
        fix="choose another place, or free this one",
    )


PLACES = {
    errno.EACCES: "may not be read or written",
    errno.EPERM: "may not be read or written",
    errno.EROFS: "is on a disk that can only be read",
    errno.ENOTDIR: "cannot be: a part of the path is a file",
    errno.EISDIR: "is a folder, where a file is needed",
    errno.EEXIST: "is in the way",
    errno.ENAMETOOLONG: "is longer than this disk takes",
    errno.ENOSPC: "does not fit on the disk, which is full",
    errno.EDQUOT: "does not fit into your share of the disk",
}
"""What is wrong with a place, by the system's number."""


class SettingsError(HilsplatError):
    """A key is unknown, or a value has the wrong type or is out of range."""


class SceneError(HilsplatError):
    """A row of the scene sheet, or a scene folder, cannot be used."""


class ImageError(HilsplatError):
    """An image is missing, empty, truncated, unreadable or of the wrong size."""


class RegistrationError(HilsplatError):
    """Structure from motion registered too few views."""


class ModelError(HilsplatError):
    """A model folder is missing, incomplete or of the wrong kind."""


class DownloadError(HilsplatError):
    """A model cannot be fetched: the hub is out of reach, refuses, or sent other bytes than it stated."""


class ArtifactError(HilsplatError):
    """A stage's output is missing, incomplete, damaged or belongs to other inputs."""


class MisalignedArtifactError(ArtifactError):
    """Two artifacts do not belong together: other rows, sizes or digests."""


class EmptyMaskError(HilsplatError):
    """A mask has no pixel where at least one is needed."""


class DiskSpaceError(HilsplatError):
    """The disk is full, or too full for what a stage is about to write."""


class DeviceError(HilsplatError):
    """This machine does not have the device that the settings name."""
