"""The plan of a run: its scenes, the inputs and parameters of each job, and the targets.

The rules get their paths from this module. It knows nothing of Snakemake: a *job* is anything with the
attributes `dataset` and `scene`, and `variant` for the stages that variants share or change, such as the
wildcards of a rule.
"""

import difflib
import functools
import json
import re
import shlex
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Protocol, runtime_checkable

from hilsplat.base.errors import SettingsError
from hilsplat.configuration import SECTIONS, UPSTREAM, StageSettings, parse_run, require_known
from hilsplat.datasets.registry import readers_of
from hilsplat.datasets.sources import (
    DATA_PREFIX,
    absence,
    image_files,
    is_exported,
    label_files,
    label_sets,
    published,
)
from hilsplat.evaluate.tables.build import TABLES
from hilsplat.methods.registry import METHODS, OURS, require_method
from hilsplat.scene.sheet import GROUPS, PHOTOS, SceneRow, choose_scenes, read_sheet
from hilsplat.workflow.answering import doubt_about_photographs, models_of
from hilsplat.workflow.feasible import require_feasible
from hilsplat.workflow.model_digests import model_digest
from hilsplat.workflow.soundness import Wanted
from hilsplat.workflow.stages import stage_code

RESULTS = Path("results")
CACHE = RESULTS / ".cache"


@runtime_checkable  # the tests' type checker asks; the plan itself does not, since that is slow
class Job(Protocol):
    """The wildcards of every rule."""

    @property
    def dataset(self) -> str: ...
    @property
    def scene(self) -> str: ...


@runtime_checkable
class VariantJob(Job, Protocol):
    """The wildcards of a variant's rules."""

    @property
    def variant(self) -> str: ...


class Plan:
    """Scenes, settings and targets of a configuration.

    Attributes:
        run: the validated configuration.
        rows: every scene of the sheet.
        scenes: those that are run.
        absent: chosen scenes that are skipped -> the reason.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        """Validate a configuration and read the scene sheet.

        Raises:
            HilsplatError: a setting, a method or a line of the sheet cannot be used, or no scene is left.
        """
        self.run = run = parse_run(dict(config))
        for name in run.variant_names():
            require_method(run.stages(name).method.name)
        sheet = Path(run.scenes)
        self.rows = tuple(read_sheet(sheet, run.groups, run.data_root))
        datasets = {row.dataset for row in self.rows} | {PHOTOS}
        scenes = [row.name for row in self.rows]
        # a scene of the sheet may be taken out of it, and its settings stay
        named = [key for key in (*run.overrides, *run.queries) if "/" in key]
        gone = [key for key in named if key.partition("/")[0] in datasets]
        require_known("overrides", run.overrides, [*GROUPS, *scenes, *gone])
        require_known("queries", run.queries, [*sorted({*datasets, *GROUPS}), *scenes, *gone])
        known = {
            **dict.fromkeys(gone, ("overrides or queries", scenes)),
            **dict.fromkeys(run.sweep_scenes, ("sweep_scenes", [row.scene for row in self.rows])),
        }
        for key, (where, names) in sorted(known.items()):
            near = difflib.get_close_matches(key, names, n=1, cutoff=0.85)
            if key not in names and near:
                raise SettingsError(
                    f"{where} of the configuration has the scene {key!r}, which {sheet} does not have",
                    expected=f"did you mean {near[0]!r}?",
                    fix="correct the name, or take it out",
                )
        self._row_of = {(row.dataset, row.scene): row for row in self.rows}
        chosen = choose_scenes(self.rows, run.groups, run.only)
        if more := {row.group for row in chosen} - set(run.groups):  # check their sources too
            read_sheet(sheet, {*run.groups, *more}, run.data_root)
        self._absence = functools.cache(lambda row: absence(row.source, run.data_root))
        reasons = {row.name: self._absence(row) for row in chosen}
        self.absent = {name: reason for name, reason in reasons.items() if reason is not None}
        self.scenes = tuple(row for row in chosen if row.name not in self.absent)
        if not self.scenes:
            raise SettingsError(
                "there is no scene to run",
                expected=f"scenes of {sheet}: {', '.join(f'{row.name} ({row.group})' for row in self.rows)}",
                found="; ".join(
                    [
                        f"groups {list(run.groups)}, only {list(run.only)}, data_root {run.data_root!r}",
                        *(f"{name} is skipped: {reason}" for name, reason in self.absent.items()),
                    ]
                ),
                fix="name other groups or scenes, or set data_root",
            )
        # A thousand scenes have tens of thousands of jobs: settings are resolved and folders are read once.
        self.stages_of = functools.cache(lambda *which: run.stages(*which).with_models())
        self._seeded = functools.cache(run.seeded)
        self._section = functools.cache(self._section_of)
        self._folder_files = functools.cache(self._files_of)
        self._labels = functools.cache(lambda row: label_sets(row.source, run.data_root, row.name))
        for row in self.scenes:
            self._require_no_braces(row)

    def require_feasible(self) -> None:
        """Refuse devices that this machine does not have, and model folders that cannot be used.

        A stage would find out too, but hours later.

        Raises:
            HilsplatError: the message names the setting, and a scene and variant that have it.
        """
        seen: set[Any] = set()
        for row in self.scenes:
            for variant in self.run.variant_names():
                stages = self.stages_of(variant, self._scopes(row))
                if stages not in seen:
                    seen.add(stages)
                    require_feasible(stages, f"{row.name}, variant {variant}")

    # ---- wildcards and threads ----------------------------------------------------------------------

    def threads(self, cores: int) -> int:
        """Threads of a job: with at least as many scenes as cores, one each keeps all cores busy."""
        return max(1, cores // min(len(self.scenes), cores))

    def variant_threads(self, cores: int) -> int:
        """Threads of a job of one variant: the fields of a single scene too are solved side by side."""
        fields = sum(str(each.output).endswith("field.safetensors") for each in self.wanted())
        return max(1, cores // min(max(fields, 1), cores))

    def datasets(self) -> str:
        """Regular expression of the wildcard `dataset`."""
        return any_of(row.dataset for row in self.rows)

    def scene_names(self) -> str:
        """Regular expression of the wildcard `scene`."""
        return any_of(row.scene for row in self.rows)

    def variants(self, by_baseline: bool | None = None) -> str:
        """Regular expression of the wildcard `variant`.

        Args:
            by_baseline: variants whose field a baseline writes, or those whose field is ours; None: all.
        """
        return any_of(
            name
            for name in self.run.variant_names()
            if by_baseline is None or (self.stages_of(name).method.name != OURS) == by_baseline
        )

    # ---- parameters ---------------------------------------------------------------------------------

    def row(self, job: Job) -> SceneRow:
        """Row of the scene sheet."""
        return self._row_of[job.dataset, job.scene]

    def stages(self, job: Job) -> StageSettings:
        """All settings of a scene and, if the job has one, a variant."""
        return self.stages_of(*self.which(job))

    def which(self, job: Job) -> tuple[str, tuple[str, ...]]:
        """What all settings of a job follow from: its variant and the overrides of its scene."""
        return getattr(job, "variant", "default"), self._scopes(self.row(job))

    def _section_of(self, section: str, variant: str, scopes: tuple[str, ...]) -> tuple[str, dict[str, Any]]:
        """A section's settings as JSON, and as the values in it."""
        settings = getattr(self.stages_of(variant, scopes), section)
        return inert(settings.model_dump_json()), settings.model_dump(mode="json")

    def settings(self, section: str) -> Callable[[Job], str]:
        """Parameter: a section's settings, as JSON."""
        return lambda job: self._section(section, *self.which(job))[0]

    def seed(self, job: VariantJob) -> int:
        """Parameter: the seed of a variant's networks."""
        return self.run.seed_of(job.variant)

    def code(
        self,
        stage: str | Callable[[Any], str],
        plugins: Callable[[Any], tuple[str, ...]] = lambda job: (),
    ) -> Callable[[Any], str]:
        """Parameter: digest of the code of a stage, with the readers or the baseline that a job uses."""
        return lambda job: stage_code(stage(job) if callable(stage) else stage, plugins(job))

    def model(self, section: str) -> Callable[[Job], str]:
        """Parameter: digest of the model folder that a stage reads, or "none"."""

        def digest(job: Job) -> str:
            stages = self.stages(job)
            if section == "masks" and stages.masks.segmenter != "sam":
                return "none"
            return model_digest(Path(getattr(stages, section).model), CACHE)

        return digest

    def answering(self) -> list[str]:
        """Which models make the masks and the words of which scenes, one line each, doubts included."""
        scenes: dict[tuple[str, str], list[str]] = {}
        for row in self.scenes:
            stages = self.stages_of("default", self._scopes(row))
            key = (models_of(stages), "" if row.world else doubt_about_photographs(stages))
            scenes.setdefault(key, []).append(row.name)
        lines = []
        for (models, doubt), names in scenes.items():
            lines.append(f"{some(names)}: {models}")
            lines += [doubt] if doubt else []
        return lines

    def shared(self, stage: str, path: str) -> Callable[[VariantJob], str]:
        """Input: a stage's output, from the first variant with the same settings up to that stage.

        Thus a sweep over Omega solves fields anew and shares masks, trees and embeddings with `default`.
        """
        return lambda job: self.output(job, self.shared_variant(stage, job), path)

    def compared(self, stage: str, path: str) -> Callable[[Job], list[str]]:
        """Input: a stage's output for every variant of the main tables, wherever it is shared."""
        return lambda job: list(dict.fromkeys(map(self.shared(stage, path), self._main_jobs(job))))

    def compared_scores(self, job: Job) -> list[str]:
        """Input: the scores of every variant of the main tables."""
        return [self.output(each, each.variant, "scores.csv") for each in self._main_jobs(job)]

    def _main_jobs(self, job: Job) -> list[SimpleNamespace]:
        scene = {"dataset": job.dataset, "scene": job.scene}
        return [SimpleNamespace(**scene, variant=name) for name in self.run.main_variants]

    def output(self, job: Job, *parts: str) -> str:
        """A path in a scene's folder."""
        return "/".join(["results", job.dataset, job.scene, *parts])

    def shared_variant(self, stage: str, job: VariantJob) -> str:
        """First variant whose settings up to a stage equal those of the job's variant."""
        return self._first_alike(stage, job.variant, self._scopes(self.row(job)))

    @functools.cache  # noqa: B019  a process has one plan
    def _first_alike(self, stage: str, variant: str, scopes: tuple[str, ...]) -> str:
        wanted = self.stages_of(variant, scopes)
        seed = self.run.seed_of(variant) if wanted.depends_on_seed(stage) else None
        for name in self.run.variant_names():
            other = self.stages_of(name, scopes)
            same = all(getattr(other, part) == getattr(wanted, part) for part in UPSTREAM[stage])
            if same and seed in (None, self.run.seed_of(name)):
                return name
        return variant

    def _scopes(self, row: SceneRow) -> tuple[str, ...]:
        """Keys of `overrides` that apply to a scene and exist: scenes without any share their settings."""
        return tuple(scope for scope in scopes_of(row) if scope in self.run.overrides)

    def wanted(self) -> list[Wanted]:
        """Every artifact that the run may write, and how it is to be made."""
        found = [each for row in self.scenes for each in self._wanted_of(row)]
        return [*found, *(Wanted(Path(table), table, "table") for table in self.tables())]

    def _wanted_of(self, row: SceneRow) -> Iterator[Wanted]:
        """The artifacts of one scene; what variants share is listed once."""
        scene = SimpleNamespace(dataset=row.dataset, scene=row.scene)
        if row.world:
            world = self._want(scene, "world", "world")
            yield replace(world, output=self.output(scene, "world/images"))
        if is_exported(row.source):
            yield self._want(scene, "source", "source", plugins=self.source_reader(scene))
        yield self._want(scene, "poses", "scene", seed=self.run.seed)
        yield self._want(scene, "gaussians", "gaussians.ply", seed=self.run.seed)
        for variant in self.run.variant_names():
            job = SimpleNamespace(**vars(scene), variant=variant)
            stages, seed = self.stages(job), self.run.seed_of(variant)
            for stage in ("coverage_tree", "clip", "contributions", "semantic_tree"):
                if self.shared_variant(stage, job) == variant:
                    yield self._want(job, stage, stage)
            if self.shared_variant("masks", job) == variant:
                stage = self.masks_stage(job)
                yield self._want(job, stage, "masks", stages.perturb.seed if stage == "truth_masks" else None)
            if self.shared_variant("autoencoder", job) == variant:
                yield self._want(job, "autoencoder", "autoencoder", seed)
            if self.shared_variant("field", job) == variant:
                if stages.method.name == OURS:
                    yield self._want(job, "field", "field.safetensors")
                else:
                    yield self._want(job, "method", "field.safetensors", seed, self.baseline(job))
            yield self._want(job, "evaluate", "scores.csv", plugins=self.label_readers(job))
        figures = {name: self._section(name, *self.which(scene))[1] for name in ("figures", "evaluate")}
        for stage, picture in (("figures", "panel"), ("comparison", "comparison")):
            path = f"results/figures/{row.name}/{picture}.png"
            yield Wanted(Path(path), path, stage, figures, None, self.label_readers(scene))
        path = f"results/figures/{row.name}/masks.png"
        yield Wanted(Path(path), path, "mask_truth")

    def _want(
        self, job: Job, stage: str, name: str, seed: int | None = None, plugins: tuple[str, ...] = ()
    ) -> Wanted:
        variant = getattr(job, "variant", None)
        path = self.output(job, *([variant] if variant is not None else []), name)
        section = "perturb" if stage == "truth_masks" else stage
        settings = self._section(section, *self.which(job))[1] if section in SECTIONS else {}
        return Wanted(Path(path), path, stage, settings, seed, plugins)

    # ---- photographs and poses ----------------------------------------------------------------------

    def images(self, job: Job) -> str:
        """Folder of the images that the poses of a scene are found from."""
        row = self.row(job)
        if row.world:
            return self.output(job, "world/images")
        return self.output(job, "source") if is_exported(row.source) else str(row.folder)

    def image_files(self, job: Job) -> str | list[str]:
        """Input of poses: a folder that a rule writes, or each file of a folder of photographs."""
        row = self.row(job)
        if row.world or is_exported(row.source):
            return self.images(job)
        return self._folder_files(row)

    def _files_of(self, row: SceneRow) -> list[str]:
        """Files of a folder of photographs, without labels."""
        assert row.folder is not None, row.name  # scenes without data were skipped
        labels = set(self._label_files(row))
        return sorted(
            str(path)
            for path in row.folder.rglob("*")
            if path.is_file() and not path.name.startswith(".") and str(path) not in labels
        )

    def lens(self, job: Job) -> str:
        """Option of poses: whether the images are renders."""
        return "--render" if self.row(job).world else "--no-render"

    def _require_no_braces(self, row: SceneRow) -> None:
        """Refuse files in whose names Snakemake would see wildcards; it knows no way to quote them."""
        job = SimpleNamespace(dataset=row.dataset, scene=row.scene)
        files = self.image_files(job) if row.folder is not None else []
        for path in [*([files] if isinstance(files, str) else files), *self.brought(job)]:
            if "{" in path or "}" in path:
                raise SettingsError(
                    f"{path} of {row.name} cannot be read by the workflow: its name has braces",
                    fix="rename it, or its folder",
                )

    def source_files(self, job: Job) -> list[str]:
        """Input of source: files of a data set with the images and poses."""
        return [str(path) for path in image_files(self.row(job).source, self.run.data_root)]

    def source_name(self, job: Job) -> str:
        """Parameter of source: data set and scene."""
        return self.row(job).source.removeprefix(DATA_PREFIX)

    def source_reader(self, job: Job) -> tuple[str, ...]:
        """The reader of the data set that a scene's images are exported from."""
        return readers_of([self.source_name(job)])

    def brought(self, job: Job) -> list[str]:
        """Input: a PLY that replaces the fit, with the JSON beside it if there is one; usually nothing."""
        ply = self.row(job).gaussians
        if ply is None:
            return []
        beside = ply.with_suffix(".json")
        return [str(ply), *([str(beside)] if beside.is_file() else [])]

    def brought_option(self, job: Job) -> str:
        """Option that names such a PLY, if there is one."""
        ply = self.row(job).gaussians
        return f"--brought {shlex.quote(str(ply))}" if ply is not None else ""

    # ---- masks and methods --------------------------------------------------------------------------

    def masks_stage(self, job: VariantJob) -> str:
        """Stage that makes the masks: the diagnostic segmenter is a separate one."""
        diagnostic = self.stages(job).masks.segmenter == "truth-perturbed"
        return "truth_masks" if diagnostic else "masks"

    def masks_truth(self, job: VariantJob) -> list[str]:
        """Input of masks: the true labels, for the diagnostic segmenter only.

        Raises:
            SettingsError: it is chosen for a scene without true labels.
        """
        if self.masks_stage(job) == "masks":
            return []
        row = self.row(job)
        if not row.world:
            raise SettingsError(
                f"{row.name}, variant {job.variant}: masks.segmenter truth-perturbed needs the true labels "
                "of a synthetic scene, and this scene has none",
                fix="choose another segmenter, or run the variant on synthetic scenes only",
            )
        return self.truth(job)

    def masks_truth_option(self, job: VariantJob) -> str:
        """Options of the diagnostic segmenter, if it is chosen."""
        truth = self.masks_truth(job)
        if not truth:
            return ""
        faults = self.stages(job).perturb.model_dump_json()
        return f"--truth {shlex.quote(truth[0])} --perturb {shlex.quote(faults)}"

    def baseline(self, job: VariantJob) -> tuple[str, ...]:
        """The baseline that computes a variant's field."""
        return (METHODS.places[self.stages(job).method.name],)

    # ---- annotations: for evaluation and figures alone ------------------------------------------------

    def labels(self, row: SceneRow) -> tuple[str, ...]:
        """Labels of a scene, as `data set/scene`: published ones and your own annotations."""
        return () if row.world else self._labels(row)

    def label_readers(self, job: Job) -> tuple[str, ...]:
        """The readers of a scene's labels."""
        return readers_of(self.labels(self.row(job)))

    def _label_files(self, row: SceneRow) -> list[str]:
        """Files that only evaluation reads: editing one reruns nothing before it."""
        return [
            str(path.resolve())
            for labels in self.labels(row)
            for path in label_files(labels, self.run.data_root)
        ]

    def truth(self, job: Job) -> list[str]:
        """Input: the annotations of a synthetic scene; nothing for others."""
        return [self.output(job, "world/truth")] if self.row(job).world else []

    def truth_or_labels(self, job: Job) -> list[str]:
        """Input of evaluate: the annotations of a synthetic scene, or the label files of a published one."""
        return self.truth(job) or self._label_files(self.row(job))

    def truth_option(self, job: Job) -> str:
        """Options of evaluate: the truth that a scene is scored against."""
        row = self.row(job)
        if row.world:
            return f"--truth {shlex.quote(self.truth(job)[0])} --kind {row.world[0]}"
        options = [f"--labels {shlex.quote(labels)}" for labels in self.labels(row)]
        return " ".join([*options, self._data_root_option()])

    def figure_truth_option(self, job: Job) -> str:
        """Options of figures: the truth or labels that give queries and outlines, if there are any."""
        row = self.row(job)
        if row.world:
            return f"--truth {shlex.quote(self.truth(job)[0])}"
        on_images = [labels for labels in self.labels(row) if not is_exported(f"{DATA_PREFIX}{labels}")]
        if not on_images:
            return ""
        return f"--labels {shlex.quote(on_images[-1])} {self._data_root_option()}"

    def _data_root_option(self) -> str:
        return f"--data-root {shlex.quote(str(Path(self.run.data_root)))}"

    def main_variants(self) -> str:
        """Parameter: the variants of the main tables, as JSON."""
        return json.dumps(self.run.main_variants)

    def names(self) -> str:
        """Parameter: variant -> its name in tables and figures, as JSON."""
        return inert(json.dumps(dict(self.run.labels)))

    def queries(self, job: Job) -> str:
        """Parameter: texts for the panel of a scene without labels on images, as JSON."""
        of_dataset = self.run.queries.get(job.dataset, ())
        return inert(json.dumps(self.run.queries.get(f"{job.dataset}/{job.scene}", of_dataset)))

    # ---- tables ---------------------------------------------------------------------------------------

    def scores(self, table: str) -> list[str]:
        """Score files that a table is built from; sweeps take the scenes configured for them."""
        kind = TABLES[table]
        rows = [row for row in self._labelled() if self._data_of(row) in kind.data]
        if kind.is_sweep and self.run.sweep_scenes:
            rows = [row for row in rows if row.scene in self.run.sweep_scenes]
        return [
            f"results/{row.dataset}/{row.scene}/{name}/scores.csv"
            for row in rows
            for variant in getattr(self.run, kind.variants)
            for name in self._seeded(variant, self._scopes(row))
        ]

    def absent_options(self, table: str) -> str:
        """Options that say which scenes of a table's data sets were not measured."""
        by_dataset: dict[str, list[tuple[str, str]]] = {}
        for row in self.rows:
            reason = self._absence(row)
            place = published(row.source)
            if place and place[0] in TABLES[table].data and reason is not None:
                by_dataset.setdefault(row.dataset, []).append((row.scene, reason))
        sentences = []
        for dataset, scenes in by_dataset.items():
            reasons = {reason for _, reason in scenes}
            others = "" if len(reasons) == 1 else " The others cannot be read either."
            listed = some([scene for scene, _ in scenes])
            sentences.append(f"{dataset} ({listed}): {scenes[0][1]}.{others}")
        return " ".join(f"--absent {shlex.quote(sentence)}" for sentence in sentences)

    def _labelled(self) -> list[SceneRow]:
        """Scenes with annotations or labels to be scored against."""
        return [row for row in self.scenes if row.world or self.labels(row)]

    @staticmethod
    def _data_of(row: SceneRow) -> str:
        """A scene's data as tables name it: its kind of synthetic scene, or its published data set."""
        if row.world:
            return row.world[0]
        place = published(row.source)
        return place[0] if place else ""

    # ---- targets --------------------------------------------------------------------------------------

    def tables(self) -> list[str]:
        """Every table that has variants to compare, measured on the scenes that there are; all have the
        paper's rows."""
        return [
            f"results/tables/{name}.csv" for name, kind in TABLES.items() if getattr(self.run, kind.variants)
        ]

    def targets(self) -> list[str]:
        """Pictures of every scene, scores of those that you annotated, and tables and plots if the run has a
        scene of theirs.

        A run of photographs would otherwise replace a benchmark's tables by ones of reported rows alone.
        """
        plots = [
            f"results/figures/sweep-{name}.png"
            for name in ("theta", "omega")
            if getattr(self.run, TABLES[name].variants)
        ]
        own = [row for row in self._labelled() if not self._data_of(row)]
        scores = [f"results/{row.dataset}/{row.scene}/default/scores.csv" for row in own]
        has_tables = len(self._labelled()) > len(own)
        return [*self.figures(), *scores, *(self.tables() + plots if has_tables else [])]

    def figures(self) -> list[str]:
        """The panel of every scene, masks against the truth if it is known, and a comparison of methods for
        the scenes of the sweeps."""
        found = []
        for row in self.scenes:
            compared = not self.run.sweep_scenes or row.scene in self.run.sweep_scenes
            pictures = ["panel", *(["masks"] if row.world else []), *(["comparison"] if compared else [])]
            found += [f"results/figures/{row.dataset}/{row.scene}/{picture}.png" for picture in pictures]
        return found


def inert(text: str) -> str:
    """The same JSON without `<`: Snakemake writes the parameters of jobs raw into a script of its report."""
    return text.replace("<", "\\u003c")


def scopes_of(row: SceneRow) -> tuple[str, str]:
    """Keys of `overrides` that apply to a scene, the general one first."""
    return (row.group, f"{row.dataset}/{row.scene}")


def any_of(names: Collection[str] | Any) -> str:
    """Regular expression that matches exactly these names; none matches nothing."""
    return "|".join(sorted({re.escape(name) for name in names})) or "(?!)"


def some(names: list[str]) -> str:
    """The first three of some names, and how many more there are."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more
