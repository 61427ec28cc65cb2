"""The plan of a run: its scenes, and the settings, shared inputs and parameters of each job."""

import difflib
import functools
import json
import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from hilsplat.base.errors import SettingsError
from hilsplat.base.files import INSTALLED, project_path
from hilsplat.baselines import OURS, method_of
from hilsplat.configuration import SECTIONS, RunSettings, StageSettings, parse_run, require_known
from hilsplat.datasets.sources import unlisted
from hilsplat.models.store import AUTO, model_digest, model_path, read_model
from hilsplat.scene.finished import KEY_VIEWS
from hilsplat.scene.sheet import (
    DEFAULT_SHEET,
    GROUPS,
    PHOTOS,
    SceneRow,
    choose_scenes,
    read_sheet,
    row_of_data,
)
from hilsplat.workflow.models import check_device, check_models, describe_models, doubt_about_photographs
from hilsplat.workflow.scene_data import Job, SceneData, VariantJob, of_variant, options_of
from hilsplat.workflow.stages import stage_code

LEAST_PHOTOGRAPHS = 16
"""Minimum number of photographs for key views; with fewer, the key views (half) would link too few masks."""


def any_of(names: Iterable[str]) -> str:
    """Return a regular expression that matches exactly the given names."""
    return "|".join(sorted({re.escape(name) for name in names})) or "(?!)"


def inert(text: str) -> str:
    """Return the same JSON with `<` escaped: Snakemake's report copies parameters unescaped into a script."""
    return text.replace("<", "\\u003c")


class Plan:
    """Scenes, settings and targets of a configuration.

    Attributes:
        rows: scenes in the sheet, and scenes found on disk for data sets whose scenes differ between users.
        absent: skipped scene -> reason.
        ignored: lines about names in the configuration that match no scene.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        """Read the sheet; raise HilsplatError if it or the configuration is invalid, or no scene is left."""
        self.run = run = parse_run(dict(config))
        self.results = Path(run.results)
        sheet = project_path(run.scenes)
        rows = read_sheet(sheet, run.groups, run.data_root)
        found = unlisted({row.source for row in rows}, run.groups, run.data_root)
        self.rows = (*rows, *(row_of_data(name, run.data_root) for name in found))
        self.ignored = without_scene(run, [*self.rows, *read_sheet(INSTALLED / DEFAULT_SHEET, ())])
        self.data = SceneData(self.rows, run.data_root, self.path)
        chosen = choose_scenes(self.rows, run.groups, run.only)
        if more := {row.group for row in chosen} - set(run.groups):  # check their sources too
            read_sheet(sheet, {*run.groups, *more}, run.data_root)
        reasons = {row.name: self.data.absence(row) for row in chosen}
        self.absent = {name: reason for name, reason in reasons.items() if reason is not None}
        self.scenes = tuple(row for row in chosen if row.name not in self.absent)
        if not self.scenes:
            raise SettingsError(
                "there are no scenes to run",
                expected=f"scenes of {sheet}: {', '.join(f'{row.name} ({row.group})' for row in self.rows)}",
                found="; ".join(
                    [
                        f"groups {list(run.groups)}, only {list(run.only)}, data_root {run.data_root!r}",
                        *(f"{name} is skipped: {reason}" for name, reason in self.absent.items()),
                    ]
                ),
                fix="select a scene (hilsplat run photos/desk) or other groups, or set data_root",
            )
        # A thousand scenes have tens of thousands of jobs, so settings are resolved and folders read once.
        self.stages_of = functools.cache(lambda *which: run.stages(*which).with_models())
        self._seeded = functools.cache(run.seeded)
        self._section = functools.cache(self._section_of)
        self._first_alike = functools.cache(self._first_with_equal_settings)
        for row in self.scenes:
            self.data.require_no_braces(row)

    def require_usable(self, *, devices: bool) -> None:
        """Check that the models exist and, with `devices`, that this machine has the configured devices."""
        if self.results.exists() and not self.results.is_dir():
            raise SettingsError(
                f"results: {self.results} is not a folder", fix="move that file, or choose another folder"
            )
        where: dict[StageSettings, str] = {}
        for row in self.scenes:
            for variant in self.run.variant_names():
                where.setdefault(self.stages_of(variant, self.scopes(row)), f"{row.name}, variant {variant}")
        for stages, place in where.items():
            check_models(stages, place)
            if devices:
                check_device(stages, place)

    def path(self, job: Job, *parts: str) -> str:
        return "/".join([self.run.results, job.dataset, job.scene, *parts])

    def variants(self, by_baseline: bool | None = None) -> str:
        """Return a regular expression of all variants, or of those with or without a baseline's field."""
        return any_of(
            name
            for name in self.run.every_variant()
            if by_baseline is None or (self.stages_of(name).method.name != OURS) == by_baseline
        )

    def row(self, job: Job) -> SceneRow:
        return self.data.row(job)

    def stages(self, job: Job) -> StageSettings:
        """Return all settings of a scene and, if the job has one, a variant."""
        return self.stages_of(*self.which(job))

    def which(self, job: Job) -> tuple[str, tuple[str, ...]]:
        """Return the variant and the overrides that determine a job's settings."""
        return getattr(job, "variant", "default"), self.scopes(self.row(job))

    def _section_of(self, section: str, variant: str, scopes: tuple[str, ...]) -> tuple[str, dict[str, Any]]:
        settings = getattr(self.stages_of(variant, scopes), section)
        return inert(settings.model_dump_json()), settings.model_dump(mode="json")

    def settings(self, section: str) -> Callable[[Job], str]:
        """Return the parameter function for a section's settings as JSON."""
        return lambda job: self._section(section, *self.which(job))[0]

    def values(self, section: str, job: Job) -> dict[str, Any]:
        """Return a section's settings for a job; empty for stages without a section."""
        return self._section(section, *self.which(job))[1] if section in SECTIONS else {}

    def seeded(self, variant: str, row: SceneRow) -> list[str]:
        """Return a variant and, if it is random, its repetitions with other seeds."""
        return self._seeded(variant, self.scopes(row))

    def seed(self, job: VariantJob) -> int:
        """Return the seed of a variant's networks."""
        return self.run.seed_of(job.variant)

    def code(
        self, stage: str | Callable[[Any], str], plugins: Callable[[Any], tuple[str, ...]] = lambda job: ()
    ) -> Callable[[Any], str]:
        """Return the parameter function for the digest of a stage's code and of its readers or baseline."""
        return lambda job: stage_code(stage(job) if callable(stage) else stage, plugins(job))

    def vocabulary(self, job: Job) -> list[str]:
        """Return the input of `names`: the user's own vocabulary, if any."""
        named = self.stages(job).query.vocabulary
        return [] if named == AUTO else [named]

    def model(self, section: str) -> Callable[[Job], str]:
        """Return the parameter function for the digest of a section's model folder, or "none"."""

        def digest(job: Job) -> str:
            stages = self.stages(job)
            if section == "masks" and stages.masks.segmenter != "sam":
                return "none"
            return model_digest(model_path(getattr(stages, section).model), self.results / ".cache")

        return digest

    def model_lines(self) -> list[str]:
        """Return lines about the models of each scene, with warnings about models unfit for photographs."""
        scenes: dict[tuple[str, str], list[str]] = {}
        for row in self.scenes:
            stages = self.stages_of("default", self.scopes(row))
            described = describe_models(stages, row.features)
            key = (described, "" if row.world else doubt_about_photographs(stages))
            scenes.setdefault(key, []).append(row.name)
        return [
            line
            for (models, doubt), names in scenes.items()
            for line in (f"{some(names)}: {models}", doubt)
            if line
        ]

    def shared(self, stage: str, path: str) -> Callable[[VariantJob], str]:
        """Return the input function for a stage's output, from the first variant with the same settings.

        Variants that are in no table are included, so that shared files do not move when tables change.
        """
        return lambda job: self.path(job, self.shared_variant(stage, job), path)

    def compared(self, stage: str, path: str) -> Callable[[Job], list[str]]:
        """Return the input function for a stage's outputs under all variants in the main tables."""
        return lambda job: list(dict.fromkeys(map(self.shared(stage, path), self._main_jobs(job))))

    def compared_scores(self, job: Job) -> list[str]:
        """Return the input of `comparison`: the scores of each variant in the main tables."""
        return [self.path(each, each.variant, "scores.csv") for each in self._main_jobs(job)]

    def _main_jobs(self, job: Job) -> list[VariantJob]:
        return [of_variant(job, name) for name in self.run.main_variants]

    def shared_variant(self, stage: str, job: VariantJob) -> str:
        """Return the first variant whose settings up to a stage equal those of the job's variant."""
        return self._first_alike(stage, job.variant, self.scopes(self.row(job)))

    def _first_with_equal_settings(self, stage: str, variant: str, scopes: tuple[str, ...]) -> str:
        own = self.stages_of(variant, scopes)
        seed = self.run.seed_of(variant) if own.depends_on_seed(stage) else None
        for name in self.run.every_variant():
            other = self.stages_of(name, scopes)
            same = all(getattr(other, part) == getattr(own, part) for part in own.upstream(stage))
            if same and seed in (None, self.run.seed_of(name)):
                return name
        return variant

    def scopes(self, row: SceneRow) -> tuple[str, ...]:
        """Return the existing keys of `overrides` that apply to a scene, the more general key first."""
        return tuple(scope for scope in (row.group, row.name) if scope in self.run.overrides)

    def masks_stage(self, job: VariantJob) -> str:
        """Return the masks stage; imported masks, key views and the diagnostic have their own stages."""
        masks = self.stages(job).masks
        if masks.segmenter == "truth-perturbed":
            return "truth_masks"
        if self.row(job).features:
            return "langsplat"
        if masks.key_views < 1:
            return "key_masks"
        return "guided_masks" if masks.prompts == "guided" and self.first_answer(job) else "masks"

    def key_gaussians(self, job: VariantJob) -> list[str]:
        """Return the input of `masks`: the Gaussians that key views or projected prompts need, if any."""
        needed = self.masks_stage(job) in ("key_masks", "guided_masks")
        return [self.path(job, "gaussians.ply")] if needed else []

    def key_parts(self, job: VariantJob, stage: str) -> list[str]:
        """Return the input of `masks`: masks or semantic tree of the key views, if they guide the prompts."""
        is_guided = self.masks_stage(job) == "guided_masks"
        return [self.shared(stage, stage)(of_variant(job, KEY_VIEWS))] if is_guided else []

    def first_answer(self, job: VariantJob) -> bool:
        """Return whether key views answer queries before all photographs have masks."""
        row, masks = self.row(job), self.stages(job).masks
        of_photographs = job.variant == "default" and row.group == PHOTOS and not row.features
        if not of_photographs or KEY_VIEWS not in self.run.variants:
            return False
        model = read_model(Path(masks.model)) if masks.segmenter == "sam" else None
        is_slow = model is not None and not model.embedded
        return is_slow and len(self.data.image_files(job)) >= LEAST_PHOTOGRAPHS

    def masks_priority(self, job: VariantJob) -> int:
        """Return the priority of `masks`: lower if key views come first, or if cached masks get other levels.

        Ordering by an `ancient` input would be stricter, but then Snakemake 9.27 overlooks that later stages
        have changed.
        """
        return 20 if self.first_answer(job) or self.stages(job).masks.levels == "tree" else 30

    def masks_truth(self, job: VariantJob) -> list[str]:
        """Return the input of `masks`: the diagnostic's ground-truth labels; SettingsError if none exist."""
        if self.masks_stage(job) != "truth_masks":
            return []
        row = self.row(job)
        if not row.world:
            raise SettingsError(
                f"{row.name}, variant {job.variant}: masks.segmenter truth-perturbed needs "
                "ground-truth labels, which only synthetic scenes have",
                fix="choose another segmenter, or run the variant on synthetic scenes only",
            )
        return self.data.truth(job)

    def masks_option(self, job: VariantJob, input: Any) -> str:
        """Return the options of `masks` for imported masks, key views or the diagnostic segmenter."""
        if self.masks_stage(job) == "langsplat":
            return options_of({"features": self.row(job).features})
        faults = self.stages(job).perturb.model_dump_json() if input.truth else ""
        key = {"gaussians": input.gaussians, "key-masks": input.key_masks, "semantic-tree": input.key_tree}
        return options_of({**key, "truth": input.truth, "perturb": faults})

    def crops_tree(self, job: VariantJob) -> list[str]:
        """Return the input of `clip`: the semantic tree that selects crops; empty to embed all masks."""
        by_node = self.stages(job).clip.crops == "nodes" and not self.row(job).features
        return [self.shared("semantic_tree", "semantic_tree")(job)] if by_node else []

    def crops_tree_option(self, job: VariantJob, input: Any) -> str:
        """Return the option of `clip` for `crops_tree`, or for imported vectors."""
        return options_of({"semantic-tree": input.semantic_tree, "features": self.row(job).features})

    def tree_stage(self, job: VariantJob) -> str:
        """Return the stage of the semantic tree: linked masks, or clustered features."""
        return "feature_tree" if self.stages(job).semantic_tree.evidence == "features" else "semantic_tree"

    def tree_parents(self, job: VariantJob) -> list[str]:
        """Return the input of `semantic_tree`: the coverage trees, if features are clustered."""
        by_features = self.tree_stage(job) == "feature_tree"
        return [self.shared("coverage_tree", "coverage_tree")(job)] if by_features else []

    def tree_option(self, job: VariantJob, input: Any) -> str:
        """Return the options of `semantic-tree` for `tree_parents`."""
        if not input.coverage_tree:
            return ""
        field = self.settings("field")(job)
        seed = str(self.seed(job))
        return options_of({"coverage-tree": input.coverage_tree, "field-settings": field, "seed": seed})

    def rendered(self, job: VariantJob) -> list[str]:
        """Return the input of `field`: scene, Gaussians and masks, if the literal trainer renders them."""
        if self.stages(job).field.trainer != "literal":
            return []
        return [self.path(job, "scene"), self.path(job, "gaussians.ply"), self.shared("masks", "masks")(job)]

    def first_field(self, job: VariantJob) -> list[str]:
        """Return the input of `field`: LangSplat's initial field; SettingsError if no variant computes it."""
        stages, scopes = self.stages(job), self.scopes(self.row(job))
        if stages.field.start != "langsplat":
            return []
        seed = self.run.seed_of(job.variant)
        for name in self.run.every_variant():
            other = self.stages_of(name, scopes)
            if other.method.name != "langsplat" or self.run.seed_of(name) != seed:
                continue
            if all(getattr(other, part) == getattr(stages, part) for part in stages.upstream("autoencoder")):
                return [self.path(job, name, "field.safetensors")]
        raise SettingsError(
            f"{job.dataset}/{job.scene}, variant {job.variant}: field.start is langsplat, but no variant has "
            "method.name langsplat with the same masks and autoencoder",
            fix="add such a variant, or change field.start",
        )

    def field_option(self, job: VariantJob, input: Any) -> str:
        """Return the options of `field` for `rendered` and `first_field`."""
        rendered = dict(zip(("scene", "gaussians", "masks"), input.rendered, strict=False))
        return options_of({**rendered, "start": input.start})

    def field_seed(self, job: VariantJob) -> int:
        """Return a field's seed, or 0 if the field is deterministic, so that other seeds do not rerun it."""
        return self.seed(job) if self.stages(job).field.is_random else 0

    def clip_stage(self, job: VariantJob) -> str:
        """Return the stage that computes or imports the CLIP vectors."""
        return "langsplat" if self.row(job).features else "clip"

    def baseline(self, job: VariantJob) -> tuple[str, ...]:
        return (method_of(self.stages(job).method.name).fit,)

    def names(self, _: object) -> str:
        """Return each variant's name in tables and figures, as JSON; Snakemake would expand plain text."""
        return inert(json.dumps(dict(self.run.labels)))

    def queries(self, job: Job) -> str:
        """Return the queries for the panel of a scene without labels on images, as JSON."""
        of_dataset = self.run.queries.get(job.dataset, ())
        return inert(json.dumps(self.run.queries.get(f"{job.dataset}/{job.scene}", of_dataset)))


def without_scene(run: RunSettings, rows: Iterable[SceneRow]) -> list[str]:
    """Return a line for each scene in `overrides`, `queries` and `sweep_scenes` that is not in the rows.

    SettingsError is raised if a name is probably misspelt, or is not that of a known group or data set.
    """
    require_known("groups", run.groups, GROUPS)
    datasets = {row.dataset for row in rows} | {PHOTOS}
    scenes = [row.name for row in rows]
    # Settings of a scene that was removed from the sheet may stay in the configuration.
    named = [key for key in (*run.overrides, *run.queries) if "/" in key]
    gone = [key for key in named if key.partition("/")[0] in datasets]
    require_known("overrides", run.overrides, [*GROUPS, *scenes, *gone])
    require_known("queries", run.queries, [*sorted({*datasets, *GROUPS}), *scenes, *gone])
    known = {
        **dict.fromkeys(gone, ("overrides or queries", scenes)),
        **dict.fromkeys(run.sweep_scenes, ("sweep_scenes", [row.scene for row in rows])),
    }
    lines = []
    for key, (where, names) in sorted((key, found) for key, found in known.items() if key not in found[1]):
        line = f"the configuration ({where}) names the scene {key!r}, which is not in {run.scenes}"
        if near := difflib.get_close_matches(key, names, n=1, cutoff=0.85):
            raise SettingsError(line, expected=f"did you mean {near[0]!r}?", fix="correct or remove the name")
        lines.append(f"{line}; it is ignored")
    return lines


def some(names: list[str]) -> str:
    """Return the first three names, and the number of remaining names."""
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return ", ".join(names[:3]) + more
