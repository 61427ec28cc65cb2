"""Output of `hilsplat datasets`: the known data sets, the scenes present, and whether they can be read."""

from collections.abc import Sequence
from pathlib import Path

from hilsplat.base.errors import HilsplatError, SceneError
from hilsplat.datasets.dataset import Dataset
from hilsplat.datasets.registry import DATASETS


def overview(data_root: Path | None) -> str:
    """Describe all data sets, with the scenes present below a folder if one is given."""
    return "\n\n".join(describe(dataset, data_root) for dataset in DATASETS.values())


def describe(dataset: Dataset, data_root: Path | None) -> str:
    """Return several lines that describe one data set."""
    lines = [
        f"{dataset.name}: {dataset.title}, labels on {dataset.labels}",
        f"  citation  {dataset.citation}",
        f"  licence   {dataset.licence}",
        f"  terms     {dataset.terms}",
        f"  scenes    {', '.join(dataset.scenes) or 'all that are present'}",
    ]
    if data_root is not None:
        lines.extend(f"  {line}" for line in _presence(dataset, data_root))
    lines.append("  layout")
    lines.extend(f"    {line}" for line in dataset.layout.rstrip().splitlines())
    return "\n".join(lines)


def _presence(dataset: Dataset, data_root: Path) -> list[str]:
    """Return lines that list a data set's complete scenes, and what is missing from the others."""
    try:
        root = dataset.locate(data_root)
    except SceneError as error:
        return ["found     no scene", *(f"          {line}" for line in str(error).splitlines())]
    lines = [f"found     {', '.join(dataset.found(root)) or 'no complete scene'} (in {root})"]
    for scene in dataset.scenes:
        missing = dataset.missing(root, scene)
        if missing:
            lines.append(f"missing   {scene}: {', '.join(missing)}")
    return lines


def check(dataset: Dataset, data_root: Path, scenes: Sequence[str] = ()) -> tuple[str, int]:
    """Read whole scenes of a data set, by default those at least partly present, and report what was found.

    Returns:
        The report, and the number of scenes that cannot be read.

    Raises:
        SceneError: the data set's folder is missing.
    """
    root = dataset.locate(data_root)
    known = dict.fromkeys((*dataset.scenes, *dataset.found(root)))
    absent = []
    for scene in [] if scenes else known:
        inside = {place for place in dataset.required(scene) if not place.startswith("..")}
        if inside <= set(dataset.missing(root, scene)):
            absent.append(scene)
    lines, num_failed = [], 0
    for scene in scenes or [scene for scene in known if scene not in absent]:
        try:
            report = dataset.check(root, scene)
        except HilsplatError as error:
            num_failed += 1
            lines.append(f"{dataset.name}/{scene}: cannot be read")
            lines.extend(f"  {line}" for line in str(error).splitlines())
            continue
        facts = ", ".join(f"{what}: {value}" for what, value in report.facts.items())
        lines.append(f"{dataset.name}/{scene}: {facts}")
        lines.extend(f"  warning   {sentence}" for sentence in report.warnings)
    if absent:
        lines.append(f"{dataset.name}: missing: {', '.join(absent)}")
    return "\n".join(lines), num_failed
