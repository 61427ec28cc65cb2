"""Requested models: names of released models, or any repository of the hub."""

from dataclasses import dataclass

import huggingface_hub
from huggingface_hub.errors import HFValidationError

from hilsplat.base.errors import DownloadError
from hilsplat.models.store import RELEASES, Release


@dataclass(frozen=True)
class Wanted:
    """A model to download.

    Attributes:
        name: name of the folder.
        repository: owner/name on the hub.
        release: the released model, or None for any other repository.
    """

    name: str
    repository: str
    release: Release | None

    @staticmethod
    def named(name: str, variant: str) -> "Wanted":
        """Find a model by its release name or as owner/name.

        Raises:
            DownloadError: the name is neither.
        """
        ending = f"-{variant}" if variant else ""
        for release in RELEASES:
            if name in (release.name, release.repository):
                return Wanted(f"{release.name}{ending}", release.repository, release)
        try:
            huggingface_hub.utils.validate_repo_id(name)
        except HFValidationError as error:
            raise DownloadError(
                f"{name!r} cannot be a repository: {error}", fix="write owner/name"
            ) from error
        if name.count("/") != 1:
            raise DownloadError(
                f"no model is known by the name {name!r}",
                expected=f"{', '.join(release.name for release in RELEASES)}, or owner/name on the hub",
                fix="hilsplat models list shows what there is",
            )
        return Wanted(f"{name.split('/')[1]}{ending}", name, None)
