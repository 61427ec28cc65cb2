"""External files that the jobs of a scene read: photographs, Gaussians and labels.

A *job* is any object with the attributes `dataset` and `scene` and, in a variant's stages, `variant`: the
wildcards of a rule, or a row of the sheet. Only evaluation and figures read labels.
"""

import functools
import os
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol, runtime_checkable

from hilsplat.base.errors import SettingsError
from hilsplat.base.lineage import digests_of, sha256_of_json
from hilsplat.datasets.registry import readers_of
from hilsplat.datasets.sources import absence, image_files, is_exported, label_files, label_sets, photo_files
from hilsplat.scene.layouts import dataparser_of, transforms_of
from hilsplat.scene.sheet import DATA_PREFIX, SceneRow


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


def options_of(named: Mapping[str, Any]) -> str:
    """Return quoted command-line options; omit options with an empty value.

    Paths are taken from a job's input, because a Snakemake module may have prefixed them.
    """
    return " ".join(f"--{name} {shlex.quote(str(value))}" for name, value in named.items() if value)


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
        self._digest = functools.cache(lambda memo, *files: sha256_of_json(digests_of(files, memo)))
        self._labels = functools.cache(lambda row: label_sets(row.source, data_root, row.name))

    def row(self, job: Job) -> SceneRow:
        return self._row_of[job.dataset, job.scene]

    def images(self, job: Job, input: Sequence[str]) -> str:
        """Return the parameter of `poses`: the image folder."""
        row = self.row(job)
        return input[0] if row.world or is_exported(row.source) else portable(row.folder)

    def image_files(self, job: Job) -> str | list[str]:
        """Return the input of `poses`: a folder that a rule writes, or the files used in a source folder."""
        row = self.row(job)
        if row.world:
            return self.path(job, "world/images")
        return self.path(job, "source") if is_exported(row.source) else self._folder_files(row)

    def content(self, files: Callable[[Any], str | list[str]]) -> Callable[[Job], str]:
        """Return the parameter function for the digest of a user's files; Snakemake compares only times."""

        def digest(job: Job) -> str:
            found = files(job)
            memo = Path(self.path(job)).parents[1] / ".cache/inputs" / job.dataset / f"{job.scene}.json"
            return self._digest(memo, *(() if isinstance(found, str) else found))  # a rule writes a folder

        return digest

    def poses_option(self, job: Job) -> str:
        row = self.row(job)
        return "--render" if row.world else options_of({"poses": portable(row.poses)})

    def require_no_braces(self, row: SceneRow) -> None:
        """Raise SettingsError for file names with braces, which Snakemake interprets as wildcards."""
        files = self.image_files(row) if row.folder is not None else []
        files = [files] if isinstance(files, str) else files
        for path in [*files, *self.existing_gaussians(row), *self.features(row)]:
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

    def source_reader(self, job: Job) -> tuple[str, ...]:
        """Return the reader of the data set from which a scene's images are exported."""
        return readers_of([self.source_name(job)])

    def existing_gaussians(self, job: Job) -> list[str]:
        """Return the input of `gaussians`: a PLY that replaces the fit, and its coordinate files, if any."""
        ply = self.row(job).gaussians
        if ply is None:
            return []
        beside = ply.with_suffix(".json")
        described = [beside] if beside.is_file() else self._nerfstudio(job).values()
        return [portable(path) for path in (ply, *described)]

    def existing_gaussians_option(self, job: Job) -> str:
        named = {"existing": self.row(job).gaussians, **self._nerfstudio(job)}
        return options_of({name: portable(path) for name, path in named.items()})

    def _nerfstudio(self, job: Job) -> dict[str, Path]:
        """Return files that relate the coordinates of nerfstudio's PLY to those of the poses, by option."""
        row = self.row(job)
        if row.gaussians is None or row.folder is None:
            return {}
        if (dataparser := dataparser_of(row.gaussians, row.folder)) is None:
            return {}
        transforms = transforms_of(row.folder, row.poses)
        return {"dataparser": dataparser, **({"transforms": transforms} if transforms else {})}

    def features(self, job: Job) -> list[str]:
        """Return the input of `masks` and `clip`: LangSplat's files, which replace SAM and CLIP, if any."""
        folder = self.row(job).features
        return sorted(portable(path) for path in folder.glob("*_[sf].npy")) if folder is not None else []

    def labels(self, row: SceneRow) -> tuple[str, ...]:
        """Return the labels of a scene, as `data set/scene`: published labels and your own annotations."""
        return () if row.world else self._labels(row)

    def label_readers(self, job: Job) -> tuple[str, ...]:
        return readers_of(self.labels(self.row(job)))

    def label_files(self, job: Job) -> list[str]:
        """Return the label files, which only evaluation reads, so that editing one reruns no other stage."""
        found = (
            path for labels in self.labels(self.row(job)) for path in label_files(labels, self.data_root)
        )
        return [portable(path.resolve()) for path in found]

    def truth(self, job: Job) -> list[str]:
        """Return the input that contains a synthetic scene's annotations; empty for other scenes."""
        return [self.path(job, "world/truth")] if self.row(job).world else []

    def truth_or_labels(self, job: Job) -> list[str]:
        """Return the input of `evaluate`: a synthetic scene's annotations, or another scene's label files."""
        return self.truth(job) or self.label_files(job)

    def truth_option(self, job: Job, input: Any) -> str:
        """Return the options of `evaluate`: the ground truth or labels that a scene is scored against."""
        row = self.row(job)
        if row.world:
            return options_of({"truth": input.truth, "kind": row.world[0]})
        options = [options_of({"labels": labels}) for labels in self.labels(row)]
        return " ".join([*options, options_of({"data-root": Path(self.data_root)})])

    def figure_truth_option(self, job: Job, input: Any) -> str:
        """Return the options of `figures`: the ground truth or labels for queries and outlines, if any."""
        row = self.row(job)
        if row.world:
            return options_of({"truth": input.truth})
        on_images = [labels for labels in self.labels(row) if not is_exported(f"{DATA_PREFIX}{labels}")]
        if not on_images:
            return ""
        return options_of({"labels": on_images[-1], "data-root": Path(self.data_root)})
