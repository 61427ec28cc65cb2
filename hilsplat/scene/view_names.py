"""View names, derived from the file names of the photographs."""

import os
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import takewhile
from pathlib import Path
from urllib.parse import unquote

from hilsplat.base.errors import SceneError
from hilsplat.base.files import IMAGE_SUFFIXES
from hilsplat.scene.layouts import PHOTO_FOLDERS


def view_name(stem: str) -> str:
    """Return the name of the view made from an image file with this stem ("DSC_1" -> "DSC_1.png")."""
    return f"{stem}.png"


MAX_NAME_BYTES = 200
"""Maximum length of a photograph's file name, bytes; later stages extend it, and file systems allow 255."""


def name_parts(name: str) -> tuple[str, ...]:
    """Return the parts of a name in another program's file, comparable: separators, case, Unicode, suffix.

    "Images\\IMG 1.JPG" and "images/img 1.png" have the same parts.
    """
    plain = unicodedata.normalize("NFC", name).replace("\\", "/").casefold()
    parts = [part for part in plain.split("/") if part not in ("", ".", "..") and not part.endswith(":")]
    if parts:
        stem, dot, suffix = parts[-1].rpartition(".")
        parts[-1] = stem if dot and f".{suffix}" in IMAGE_SUFFIXES else parts[-1]
    return tuple(parts)


ADDED = re.compile(r"^[0-9a-f]{8}-|(_(jpe?g|png|tiff?|bmp|webp|heic))+\.rf\.[0-9a-z]{20,}$")
"""What Label Studio puts before, and Roboflow behind, the name of an uploaded picture."""

PLAIN = {(folder,) for folder in PHOTO_FOLDERS}
"""Folders that don't distinguish photographs, so that they may be missing or have another name."""


def match_names(names: Iterable[str], candidates: Iterable[str]) -> dict[str, str | None]:
    """Return for each name in another program's file the candidate that it means, or None if it isn't clear.

    Candidates are view names, or paths in a folder. Separators, case, suffix and Unicode form are ignored;
    the rest of the last part must be equal. Folders, from the last one up, must be equal until either the
    name or the candidate has no more, or only a `PLAIN` one: "cam1/a.jpg" may be "images/a.png" or
    "rig/cam1/a.png", but not "cam2/a.png". Of several candidates, the one with the most equal folders is
    meant, then the one in the fewest folders, then the one with the same suffix and case. View names have
    their folders as a prefix: "cam1/a.jpg" may be "cam1_a.png". If nothing fits, what upload pages `ADDED` is
    ignored, and the name is read as an address: "/data/local-files/?d=cam1/a%20b.jpg" is "cam1/a b.jpg".
    """
    by_last: dict[str, list[tuple[tuple[str, ...], str]]] = {}
    for candidate in candidates:
        if parts := name_parts(candidate):
            by_last.setdefault(parts[-1], []).append((parts, candidate))

    def match(name: str) -> str | None:
        last, suffix = re.split(r"[/\\]", name)[-1], name.casefold().rpartition(".")[2]
        forms = name_parts(name), name_parts(unquote(name.replace("?d=", "/").partition("?")[0]))
        for wanted in (forms[0], *((*parts[:-1], ADDED.sub("", parts[-1])) for parts in forms if parts)):
            ranked = []
            for length in range(1, len(wanted) + 1):
                for other, candidate in by_last.get("_".join(wanted[-length:]), ()):
                    folders, places = wanted[:-length], other[:-1]
                    pairs = zip(reversed(folders), reversed(places), strict=False)
                    same = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], pairs))
                    rests = folders[: len(folders) - same], places[: len(places) - same]
                    if all(rests) and PLAIN.isdisjoint(rests):
                        continue
                    alike = (candidate.casefold().rpartition(".")[2] == suffix, candidate.endswith(last))
                    ranked.append(((length + same, -len(other), *alike), candidate))
            best = [candidate for rank, candidate in ranked if rank == max(ranked)[0]]
            if best:
                return best[0] if len(best) == 1 else None
        return None

    return {name: match(name) for name in names}


def view_names(sources: Sequence[Path]) -> list[str]:
    """Return the view names of image files: the file names with the suffix .png ("DSC_1.jpg" -> "DSC_1.png").

    Files with the same name in different folders ("train/r_0.png", "test/r_0.png") get their folders as a
    prefix, as many as make them unique: "train_r_0.png".

    Raises:
        SceneError: two files would get the same view name, or later stages cannot use a file's name.
    """
    for source in sources:
        problem, num_bytes = "", len(os.fsencode(source.name))
        if "{" in source.name or "}" in source.name or not source.name.isprintable():
            problem = "contains a brace or an unprintable character"  # braces are wildcards in Snakemake
        elif num_bytes > MAX_NAME_BYTES:
            problem = f"is too long: {num_bytes} bytes instead of at most {MAX_NAME_BYTES} bytes"
        if problem:
            raise SceneError(f"the name of photograph {str(source)!r} {problem}", fix="rename it")
    same_folder = Counter((source.parent, source.stem) for source in sources)
    prefixes = [[folder.name for folder in source.parents] for source in sources]
    names = [view_name(source.stem) for source in sources]
    for depth in range(1, 1 + max((len(prefix) for prefix in prefixes), default=0)):
        same_name = Counter(names)
        if max(same_name.values()) == 1:
            break
        names = [
            view_name("_".join([*reversed(prefix[:depth]), source.stem]))
            if same_name[name] > 1 and same_folder[source.parent, source.stem] == 1
            else name
            for name, prefix, source in zip(names, prefixes, sources, strict=True)
        ]
    if shared := {name: count for name, count in Counter(names).items() if count > 1}:
        name, count = next(iter(shared.items()))
        same = [source for source, other in zip(sources, names, strict=True) if other == name]
        folder = os.path.commonpath([source.parent for source in same])
        others = f", and so on for {len(shared)} names" if len(shared) > 1 else ""
        raise SceneError(
            f"{count} images in {folder} have the same view name {name}{others}",
            found=", ".join(os.path.relpath(source, folder) for source in same),
            fix="rename or remove all but one of each: views are named after the file without its suffix",
        )
    return names
