"""Errors a user can fix: where, expected, found, and the way out."""


class HilsplatError(Exception):
    """Base of every error that a file, a setting or a user brings.

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


class SettingsError(HilsplatError):
    """A key is unknown, or a value is of the wrong type or out of its range."""


class SceneError(HilsplatError):
    """A row of the scene sheet, or a scene folder, cannot be used."""


class ImageError(HilsplatError):
    """An image is missing, empty, truncated, unreadable or of the wrong size."""


class RegistrationError(HilsplatError):
    """Structure from motion registered too few views."""


class ModelError(HilsplatError):
    """A model folder is missing, incomplete or not of the kind that was asked for."""


class ArtifactError(HilsplatError):
    """A stage's output is missing, incomplete, damaged or belongs to other inputs."""


class MisalignedArtifactError(ArtifactError):
    """Two artifacts do not belong together: other rows, sizes or digests."""


class EmptyMaskError(HilsplatError):
    """A mask without a pixel was given to something that needs one."""


class DiskSpaceError(HilsplatError):
    """The disk is full, or too full for what a stage is about to write."""


class DeviceError(HilsplatError):
    """A device was asked for that this machine does not have."""
