"""Report on a folder of photographs: what can be read, and what is likely to fail."""

import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from hilsplat.base.errors import ImageError, first_line, shorten_list
from hilsplat.base.files import list_files, list_images
from hilsplat.base.images import opened_image, orientation, read_image, require_usable_size
from hilsplat.base.lineage import sha256_of_file
from hilsplat.base.progress import track
from hilsplat.photos.check import CheckedPhoto, checked_photo, matched_rows, photo_doubts
from hilsplat.scene.features import exif_focal_px
from hilsplat.scene.layouts import photo_folder
from hilsplat.scene.view_names import view_names

OTHER_PHOTO_SUFFIXES = frozenset(
    {".dng", ".nef", ".nrw", ".cr2", ".cr3", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw", ".gpr"}
    | {".insp", ".jp2", ".exr", ".hdr", ".psd", ".gif", ".jxl"}
)
"""Suffixes of unsupported photograph formats. Such files are counted and reported as skipped."""


@dataclass(frozen=True)
class PhotoReport:
    """Report on a folder of photographs.

    Attributes:
        sizes: number of readable photographs per upright size (height, width), px.
        unreadable: (file name, reason) of each image that cannot be read.
        num_rotated: number of photographs that are rotated according to their EXIF orientation.
        duplicates: groups of file names with identical bytes.
        passed_over: number of skipped files in unsupported photograph formats, by suffix.
        doubts: likely problems and what to do about them (`check`).
        notes: how the folder was made (`intake`), and what else in it is used or left out (`findings`).
        columns: paths of these other parts for the scene sheet, by column.
    """

    folder: Path
    sizes: dict[tuple[int, int], int]
    unreadable: tuple[tuple[str, str], ...]
    num_rotated: int
    duplicates: tuple[tuple[str, ...], ...]
    passed_over: dict[str, int]
    doubts: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    columns: dict[str, Path] = field(default_factory=dict)

    @property
    def num_readable(self) -> int:
        """Number of readable photographs, including identical copies."""
        return sum(self.sizes.values())

    def __str__(self) -> str:
        lines = [*self.notes, f"{self.num_readable} photographs in {self.folder}"]
        for (height, width), count in sorted(self.sizes.items(), key=lambda item: (-item[1], item[0])):
            lines.append(f"  {count:>5}  of {width} x {height} px (width x height)")
        if self.num_rotated:
            lines.append(f"  {self.num_rotated:>5}  rotated upright according to their EXIF orientation")
        if copies := sum(len(names) - 1 for names in self.duplicates):
            equal = shorten_list([" = ".join(names) for names in self.duplicates], 5)
            lines.append(f"  {copies:>5}  are copies of others: {equal}")
        for suffix, count in sorted(self.passed_over.items()):
            lines.append(f"  {count:>5}  {suffix} files skipped: convert them to JPEG or PNG to use them")
        if self.unreadable:
            lines.append(f"  {len(self.unreadable):>5}  cannot be read and are left out:")
            lines += [f"           {name}: {reason}" for name, reason in self.unreadable]
        lines += [f"  warning: {doubt}" for doubt in self.doubts]
        return "\n".join(lines)


def inspect_photos(folder: Path, posed: Sequence[Path] = ()) -> PhotoReport:
    """Decode the `posed` images or, if no poses are known, all photographs in a folder (`photo_folder`).

    Report their contents and likely problems.

    Raises:
        SceneError: a photograph has an unusable name, or two photographs differ only in their suffix.
    """
    photos = [*posed] or list_images(photo_folder(folder))
    folder = Path(os.path.commonpath([path.parent for path in photos])) if photos else photo_folder(folder)
    view_names(photos)
    sizes: Counter[tuple[int, int]] = Counter()
    unreadable: list[tuple[str, str]] = []
    by_digest: dict[str, list[str]] = defaultdict(list)
    num_rotated = 0
    checked: list[CheckedPhoto] = []
    matched, have_poses = matched_rows(len(photos)), bool(posed)
    for row, path in enumerate(track(photos, "photographs checked")):
        name = path.relative_to(folder).as_posix()
        try:
            pixels = read_image(path)
            require_usable_size(path, pixels.shape[:2])
        except ImageError as error:
            reason = first_line(error.__cause__ or error).replace(str(path), name)
            size = f" ({path.stat().st_size} bytes)" if path.exists() else ""
            unreadable.append((name, reason + size))
            continue
        size_hw = (pixels.shape[0], pixels.shape[1])
        sizes[size_hw] += 1
        with opened_image(path) as image:
            num_rotated += orientation(image) > 1
        is_matched = row in matched and not have_poses
        checked.append(checked_photo(name, pixels, exif_focal_px(path, size_hw), is_matched=is_matched))
        by_digest[sha256_of_file(path)].append(name)
    copies = {name for names in by_digest.values() for name in names[1:]}
    distinct = [photo for photo in checked if photo.name not in copies]
    return PhotoReport(
        folder=folder,
        sizes=dict(sizes),
        unreadable=tuple(unreadable),
        num_rotated=num_rotated,
        duplicates=tuple(tuple(names) for names in by_digest.values() if len(names) > 1),
        passed_over=Counter(path.suffix.lower() for path in list_files(folder, OTHER_PHOTO_SUFFIXES)),
        doubts=tuple(photo_doubts(distinct, have_poses=have_poses)),
    )
