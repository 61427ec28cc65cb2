"""External files that the jobs of a scene read: photographs, Gaussians and labels.

A *job* is any object with the attributes `dataset` and `scene` and, in a variant's stages, `variant`: the
wildcards of a rule, or a row of the sheet. Only evaluation and figures read labels.
"""

import functools
import os
import shlex
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol, runtime_checkable

from hilsplat.base.errors import ArtifactError, SettingsError, nearest
from hilsplat.base.files import IMAGE_SUFFIXES, stats_of
from hilsplat.base.lineage import digests_of, sha256_of_json
from hilsplat.datasets.registry import DATASETS, readers_of
from hilsplat.datasets.sources import absence, image_files, is_exported, label_files, label_sets, published
from hilsplat.scene.layouts import dataparser_of, largest_copies, photo_files, photo_folder, transforms_of
from hilsplat.scene.sheet import DATA_PREFIX, SceneRow

CATEGORY = b'"category"'  # key of the text of an object in a file of labels

MAX_SKEW_S = 60.0
"""How far ahead of this machine's clock the time of a user's file may be; file servers have other clocks."""


@runtime_checkable  # for the type checker of the tests
class Job(Protocol):
    """Wildcards of a scene's rules."""

    @property
    def dataset(self) -> str: ...
    @property
    def scene(self) -> str: ...


@runtime_checkable
class VariantJob(Job, Protocol):
    """Wildcards of a variant's rules."""

    @property
    def variant(self) -> str: ...


def of_variant(job: Job, variant: str) -> VariantJob:
    """Return the job for a variant of a job's scene."""
    return SimpleNamespace(dataset=job.dataset, scene=job.scene, variant=variant)


def portable(path: Path | None) -> str:
    """Return a path, relative if it is in the working folder, so that moving a project reruns nothing."""
    return os.path.relpath(path) if path and path.is_relative_to(Path.cwd()) else str(path or "")


class SceneData:
    """Inputs and options of the jobs that read a scene's photographs, Gaussians and labels."""

    def __init__(self, rows: Iterable[SceneRow], data_root: str, path: Callable[..., str]) -> None:
        self.data_root, self.path = data_root, path
        self._row_of = {(row.dataset, row.scene): row for row in rows}
        # A thousand scenes have tens of thousands of jobs, so folders are read once.
        self.absence = functools.cache(lambda row: absence(row.source, data_root))
        self._folder_files = functools.cache(lambda row: [*map(portable, photo_files(row.folder, row.poses))])
        self._photographs = functools.cache(lambda row: _images_of(row, self._folder_files(row)))
        self._digest = functools.cache(
            lambda memo, *files: sha256_of_json(digests_of(files, memo) if files else {})
        )
        self._labels = functools.cache(lambda row: label_sets(row.source, data_root, row.name))

    def row(self, job: Job) -> SceneRow:
        """Return the row of a job's scene; raise SettingsError if it is not in the sheet."""
        row = self._row_of.get((job.dataset, job.scene))
        if row is None:
            name = f"{job.dataset}/{job.scene}"
            raise SettingsError(
                f"no scene is named {name!r}",
                expected=nearest(name, [row.name for row in self._row_of.values()]),
                fix="correct the path, or add the scene to the sheet",
            )
        return row

    def images(self, job: Job, input: Sequence[str]) -> str:
        """Return the parameter of `poses`: the image folder."""
        row = self.row(job)
        return input[0] if row.generated or is_exported(row.source) else portable(row.folder)

    def image_files(self, job: Job) -> str | list[str]:
        """Return the input of `poses`: a folder that a rule writes, or the files used in a source folder."""
        row = self.row(job)
        if row.generated:
            return self.path(job, row.generated.generator, "images")
        return self.path(job, "source") if is_exported(row.source) else self._folder_files(row)

    def photographs(self, job: Job) -> list[Path]:
        """Return the photographs of a source folder, without copies; else the files of the source."""
        row = self.row(job)
        return [*map(Path, self.source_files(job))] if is_exported(row.source) else self._photographs(row)

    def num_images(self, job: Job) -> int:
        """Return the number of photographs, estimated if they are inside other files."""
        source, files = self.row(job).source, self.photographs(job)
        names = published(source) if is_exported(source) else None
        return DATASETS[names[0]].num_images(files) if names else len(files)

    def content(self, files: Callable[[Any], str | list[str]]) -> Callable[[Job], str]:
        """Return the parameter function for the digest of a user's files; Snakemake compares only times."""

        def digest(job: Job) -> str:
            paths = files(job)
            if isinstance(paths, str):
                paths = []  # a folder that a rule writes
            _require_past(paths)
            return self._digest(self.memo(job) if paths else None, *paths)

        return digest

    def memo(self, job: Job) -> Path:
        """Return the memo of the digests of a scene's files outside the results (`digests_of`)."""
        return Path(self.path(job)).parents[1] / ".cache/inputs" / job.dataset / f"{job.scene}.json"

    def require_usable_files(self, row: SceneRow) -> None:
        """Raise HilsplatError for files of a user that would stop a run: by their names or times."""
        self.require_no_braces(row)
        photographs = self.image_files(row) if row.folder is not None else []
        photographs = [] if isinstance(photographs, str) else photographs
        _require_past([*photographs, *self.gaussians_files(row), *self.features(row), *self.label_files(row)])

    def require_no_braces(self, row: SceneRow) -> None:
        """Raise SettingsError for file names with braces, which Snakemake interprets as wildcards."""
        files = self.image_files(row) if row.folder is not None else []
        files = [files] if isinstance(files, str) else files
        for path in [*files, *self.gaussians_files(row), *self.features(row)]:
            if "{" in path or "}" in path:
                raise SettingsError(
                    f"the workflow cannot read {path} of {row.name}: its name contains braces",
                    fix="rename the file or its folder",
                )

    def source_files(self, job: Job) -> list[str]:
        """Return the input of `source`: a data set's files that contain the images and poses."""
        return [portable(path) for path in image_files(self.row(job).source, self.data_root)]

    def source_name(self, job: Job) -> str:
        return self.row(job).source.removeprefix(DATA_PREFIX)

    def gaussians(self, name: str) -> Callable[[Job], list[str]]:
        """Return the input function of `gaussians` for a file that replaces the fit (`_gaussians`)."""
        return lambda job: [self._gaussians(job)[name]] if name in self._gaussians(job) else []

    def gaussians_files(self, job: Job) -> list[str]:
        """Return the files that replace the fit, and those that describe their coordinates."""
        return [*self._gaussians(job).values()]

    def _gaussians(self, job: Job) -> dict[str, str]:
        """Return the PLY that replaces the fit, and files that relate its coordinates to those of the poses.

        These are a JSON file of ours beside it, or nerfstudio's.
        """
        row = self.row(job)
        if row.gaussians is None:
            return {}
        files, beside = {"existing": row.gaussians}, row.gaussians.with_suffix(".json")
        if beside.is_file():
            files["beside"] = beside
        elif row.folder is not None and (dataparser := dataparser_of(row.gaussians, row.folder)) is not None:
            files["dataparser"] = dataparser
            if transforms := transforms_of(row.folder, row.poses):
                files["transforms"] = transforms
        return {name: portable(path) for name, path in files.items()}

    def features(self, job: Job) -> list[str]:
        """Return LangSplat's files, which replace SAM and CLIP, if any."""
        folder = self.row(job).features
        return sorted(portable(path) for path in folder.glob("*_[sf].npy")) if folder is not None else []

    def labels(self, row: SceneRow) -> tuple[str, ...]:
        """Return the labels of a scene, as `data set/scene`: published labels and your own annotations."""
        return () if row.generated else self._labels(row)

    def root(self, job: Job) -> str:
        """Return the folder of data sets, or an empty string for a scene that it does not concern."""
        row = self.row(job)
        return str(Path(self.data_root)) if row.source.startswith(DATA_PREFIX) or self.labels(row) else ""

    def label_readers(self, job: Job) -> tuple[str, ...]:
        return readers_of(self.labels(self.row(job)))

    def scorers(self, job: Job) -> tuple[str, ...]:
        """Return the readers of a scene's labels, or the generator that has its ground truth."""
        return readers_of([*self.labels(self.row(job)), self.generated_source(job)])

    def label_files(self, job: Job) -> list[str]:
        """Return the label files, which only evaluation reads, so that editing one reruns no other stage."""
        label_paths = (
            path for labels in self.labels(self.row(job)) for path in label_files(labels, self.data_root)
        )
        return [portable(path.resolve()) for path in label_paths]

    def num_labelled(self, row: SceneRow) -> int:
        """Return the number of labelled regions in a scene's images: objects in JSON files, or mask files.

        Several objects of one category in a view count separately, although they are one query.
        """
        files = [Path(path) for path in self.label_files(row)]
        masks = sum(path.suffix.lower() in IMAGE_SUFFIXES for path in files)
        return masks + sum(path.read_bytes().count(CATEGORY) for path in files if path.suffix == ".json")

    def truth(self, job: Job) -> list[str]:
        """Return the input that contains a generated scene's annotations; empty for other scenes."""
        generated = self.row(job).generated
        return [self.path(job, generated.generator, "truth")] if generated else []

    def required_truth(self, job: Job) -> list[str]:
        """Return a generated scene's annotations; raise SettingsError for other scenes."""
        if not self.truth(job):
            raise SettingsError(
                f"{job.dataset}/{job.scene}: masks.segmenter truth-perturbed needs ground-truth labels, "
                "which only generated scenes have",
                fix="choose another segmenter, or run the variant on generated scenes only",
            )
        return self.truth(job)

    def name(self, job: Job) -> str:
        return self.row(job).name

    def generated_source(self, job: Job) -> str:
        row = self.row(job)
        return row.source if row.generated else ""

    def figure_labels(self, job: Job) -> str:
        """Return the labels for queries and outlines in figures, which must be on images, if any."""
        labels = [name for name in self.labels(self.row(job)) if not is_exported(f"{DATA_PREFIX}{name}")]
        return labels[-1] if labels else ""


def _images_of(row: SceneRow, files: Iterable[str]) -> list[Path]:
    """Return the photographs among the files of a source, without copies in other folders."""
    images = largest_copies([path for path in map(Path, files) if path.suffix.lower() in IMAGE_SUFFIXES])
    if not images or row.folder is None:
        return images
    folder = Path(portable(photo_folder(row.folder)))
    return [path for path in images if folder in path.parents] or images


def _require_past(files: Sequence[str]) -> None:
    """Raise ArtifactError for a time in the future, such as that of a camera in another time zone.

    Snakemake would fail after the job, because its output is older than an input.
    """
    latest = time.time() + MAX_SKEW_S
    if late := [path for path, stat in stats_of(map(Path, files)).items() if stat.st_mtime > latest]:
        touching = f"find {shlex.quote(str(late[0].parent))} -newermt now -exec touch {{}} +"
        raise ArtifactError(
            f"{late[0]} has a modification time in the future",
            fix=f"correct this machine's clock, or run: {touching}",
        )
