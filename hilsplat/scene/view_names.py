"""View names, derived from the file names of the photographs."""

import os
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from hilsplat.base.errors import SceneError


def view_name(stem: str) -> str:
    """Return the name of the view made from an image file with this stem ("DSC_1" -> "DSC_1.png")."""
    return f"{stem}.png"


LONGEST_NAME = 200
"""Maximum length of a photograph's file name, bytes; later stages extend it, and file systems allow 255."""


def view_names(sources: Sequence[Path]) -> list[str]:
    """Return the view names of image files: the file names with the suffix .png ("DSC_1.jpg" -> "DSC_1.png").

    Files with the same name in different folders ("train/r_0.png", "test/r_0.png") get their folder as a
    prefix: "train_r_0.png".

    Raises:
        SceneError: two files would get the same view name, or later stages cannot use a file's name.
    """
    for source in sources:
        name, num_bytes = source.name, len(os.fsencode(source.name))
        if "{" in name or "}" in name or not name.isprintable():  # braces are wildcards in Snakemake
            problem = f"the name of photograph {str(source)!r} contains a brace or an unprintable character"
            raise SceneError(problem, fix="rename it")
        if num_bytes > LONGEST_NAME:
            limit, problem = f"at most {LONGEST_NAME} bytes", f"the name of photograph {source} is too long"
            raise SceneError(problem, expected=limit, found=num_bytes, fix="rename it")
    stems = Counter(source.stem for source in sources)
    same_folder = Counter((source.parent, source.stem) for source in sources)
    names = []
    for source in sources:
        apart = stems[source.stem] > 1 and same_folder[source.parent, source.stem] == 1
        names.append(view_name(f"{source.parent.name}_{source.stem}" if apart else source.stem))
    for name, count in Counter(names).items():
        if count > 1:
            files = [str(source) for source, other in zip(sources, names, strict=True) if other == name]
            raise SceneError(
                f"{count} images have the same view name {name}",
                found=", ".join(files),
                fix="rename or remove all but one: views are named after the file without its suffix",
            )
    return names
