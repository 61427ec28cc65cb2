"""What a command may replace: outputs of the same stage, and nothing else."""

import json
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from PIL import Image

from hilsplat.base.artifacts import lock_path, provenance_path
from hilsplat.base.errors import ArtifactError

SOFTWARE = {"Software": "hilsplat"}
"""Text in the PNGs that commands draw for people; they have no provenance."""


def require_replaceable(outputs: Sequence[Path], stage: str, inputs: Iterable[Path]) -> None:
    """Check that nothing is lost if a stage writes its outputs.

    An existing file or folder may be replaced if it is empty, if the provenance of the first output says that
    the same stage wrote it, or if a writer of it was killed.

    Args:
        outputs: the artifact, whose provenance lists all of them, and further outputs.
        stage: key of `STAGES`.
        inputs: files and folders that the stage reads.

    Raises:
        ArtifactError: an output is an input, holds one, holds the working, home or root folder, or is
            something else than an earlier output of the stage.
    """
    own = _recorded_outputs(outputs[0], stage)
    read = [Path(each).resolve() for each in inputs]
    for out in outputs:
        place = out.resolve()
        for each in read:
            if place == each or place in each.parents:
                what = "is an input" if place == each else f"holds the input {each}"
                raise ArtifactError(f"output {out} {what} of {stage}", fix="name another output")
        for name, folder in (("working", Path.cwd()), ("home", Path.home())):
            if place == folder.resolve() or place in folder.resolve().parents:
                raise ArtifactError(
                    f"output {out} is the {name} folder, or holds it", fix="name a new file or folder"
                )
        if not _is_something(out) or place in own or _was_interrupted(out):
            continue
        raise ArtifactError(
            f"output {out} exists, and {stage} did not write it",
            expected=f"nothing there, or an earlier output of {stage} with its provenance",
            found=_described(out),
            fix="name another output, or remove this one first",
        )


def require_own_picture(path: Path, beside: Path | None = None) -> None:
    """Check that a picture for people replaces nothing but an earlier one.

    Args:
        path: of the picture.
        beside: a file that is always written with it.

    Raises:
        ArtifactError: the name is not that of a PNG, or another file has it or the other one's.
    """
    if path.suffix.lower() != ".png":
        raise ArtifactError(f"output {path} is not named as a PNG", expected="a name that ends in .png")
    if _is_something(path) and not _is_own_picture(path):
        raise _foreign(path)
    if beside is not None and _is_something(beside) and not _is_something(path):
        raise _foreign(beside)


def _is_own_picture(path: Path) -> bool:
    try:
        with Image.open(path) as image:
            return bool(image.info.get("Software") == SOFTWARE["Software"])
    except (OSError, ValueError, SyntaxError):
        return False


def require_beginning(path: Path, line: str) -> None:
    """Check that a table replaces nothing but an earlier one, which begins with the same line.

    Raises:
        ArtifactError: another file has its name.
    """
    if not _is_something(path):
        return
    try:
        with path.open(encoding="utf-8") as stream:
            is_own = stream.readline().strip() == line.strip()
    except (OSError, ValueError):
        is_own = False
    if not is_own:
        raise _foreign(path)


def _foreign(path: Path) -> ArtifactError:
    return ArtifactError(
        f"output {path} exists, and hilsplat did not write it",
        found=_described(path),
        fix="name another output, or remove this one first",
    )


def _recorded_outputs(artifact: Path, stage: str) -> set[Path]:
    try:
        record = json.loads(provenance_path(artifact).read_text(encoding="utf-8"))
        if record["stage"] != stage:
            return set()
        return {(artifact.parent / name).resolve() for name in record["outputs"]}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return set()


def _is_something(path: Path) -> bool:
    """Whether a path exists and holds anything; hidden files, such as Snakemake's marks, do not count."""
    if not os.path.lexists(path):
        return False
    if path.is_dir():
        return bool(_visible(path))
    return not path.is_file() or path.stat().st_size > 0


def _visible(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if not path.name.startswith(".")]


def _was_interrupted(out: Path) -> bool:
    try:
        return lock_path(out).stat().st_size > 0
    except OSError:
        return False


def _described(path: Path) -> str:
    if path.is_dir():
        names = sorted(_visible(path))
        return f"a folder of {len(names)}: {', '.join(names[:3])}{', ...' if len(names) > 3 else ''}"
    return f"a file of {path.stat().st_size} bytes" if path.is_file() else "neither a file nor a folder"
