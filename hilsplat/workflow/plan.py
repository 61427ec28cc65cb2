"""The plan of a run: its scenes, and the settings, shared inputs and parameters of each job."""

import difflib
import functools
import json
import re
import shlex
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from hilsplat.base.errors import SettingsError, shorten_list
from hilsplat.base.files import INSTALLED, project_path
from hilsplat.baselines import method_of
from hilsplat.configuration import SECTIONS, RunSettings, StageSettings, parse_run, require_known
from hilsplat.datasets.sources import is_open_ended, published, unlisted
from hilsplat.models.store import AUTO, model_digest, model_path, planned_model
from hilsplat.scene.finished import KEY_VIEWS
from hilsplat.scene.sheet import (
    DEFAULT_SHEET,
    GROUPS,
    PHOTOS,
    SceneRow,
    choose_scenes,
    read_sheet,
    row_of_data,
    with_installed,
)
from hilsplat.settings import MasksSettings
from hilsplat.stage import Facts, Stage
from hilsplat.stages import all_stages, family_of, kinds_of, stage_of
from hilsplat.workflow.models import (
    check_device,
    check_models,
    check_stages,
    describe_models,
    doubt_about_photographs,
)
from hilsplat.workflow.scene_data import Job, SceneData, VariantJob, of_variant, portable

MIN_PHOTOGRAPHS = 16
"""Minimum number of photographs for key views; with fewer, the key views (half) would link too few masks."""

SCORED = "evaluate"  # the stage that reads everything that a variant may change
Option = Callable[[Any], Any]  # an option of a stage's command: a function of the wildcards


UNCOMPARED = frozenset({"device"})
"""Settings whose change doesn't rerun a stage. Devices have equal results up to rounding, and a change to the
CPU must not discard what a card has finished."""

LINKING = ("contributions", "coverage_tree", "semantic_tree")
"""Artifacts that relate masks to each other and to Gaussians."""


class Identity(NamedTuple):
    """What an artifact of a variant is made from; artifacts with equal identities are the same."""

    stages: tuple[str, ...]
    settings: tuple[tuple[str, Any], ...]  # section and its values
    seed: int | None


def any_of(names: Iterable[str]) -> str:
    """Return a regular expression that matches exactly the given names.

    Names with the same beginning share it, because Snakemake matches the names of thousands of scenes for
    each file, and Python would try one after the other.
    """
    tails: dict[str, set[str]] = {}
    for name in names:
        tails.setdefault(name[:1], set()).add(name[1:])
    is_end = tails.pop("", None) is not None
    branches: dict[str, list[str]] = {}  # first letters, by what may follow them
    for letter, following in sorted(tails.items()):
        branches.setdefault(any_of(following), []).append(re.escape(letter))
    if not branches:
        return "" if is_end else "(?!)"
    parts = [
        (letters[0] if len(letters) == 1 else f"[{''.join(letters)}]") + following
        for following, letters in branches.items()
    ]
    if len(parts) == 1 and not is_end:
        return parts[0]
    return f"(?:{'|'.join(parts)})" + ("?" if is_end else "")


def escape_json_for_report(text: str) -> str:
    """Return the same JSON with `<` escaped: Snakemake's report copies parameters unescaped into a script."""
    return text.replace("<", "\\u003c")


def words_of(stage: Stage[..., Any], values: Mapping[str, Any]) -> str:
    """Return options and arguments of a stage's command: one for each value, none for an empty value."""
    words: list[str] = []
    for name, value in values.items():
        option = [] if name in stage.arguments else [f"--{name.replace('_', '-')}"]
        if value is True:
            words += option
            continue
        items: list[str] = [value] if isinstance(value, str) else list(value or ())
        words += [word for item in items if item for word in (*option, shlex.quote(item))]
    return " ".join(words)


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
        if self.results.exists() and not self.results.is_dir():
            raise SettingsError(
                f"results: {self.results} is not a folder", fix="move that file, or choose another folder"
            )
        require_variant_sections(run)
        sheet = project_path(run.scenes)
        rows = with_installed(read_sheet(sheet, (), run.data_root), run.only, run.data_root)
        names_of_data = unlisted({row.source for row in rows}, run.groups, run.data_root)
        self.rows = (*rows, *(row_of_data(name, run.data_root) for name in names_of_data))
        self.ignored = without_scene(run, [*self.rows, *read_sheet(INSTALLED / DEFAULT_SHEET, ())])
        self.data = SceneData(self.rows, run.data_root, self.path)
        chosen = choose_scenes(self.rows, run.groups, run.only)
        read_sheet(sheet, {row.name for row in chosen}, run.data_root)  # checks their sources
        reasons = {row.name: self.data.absence(row) for row in chosen}
        self.absent = {name: reason for name, reason in reasons.items() if reason is not None}
        self.scenes = tuple(row for row in chosen if row.name not in self.absent)
        if not self.scenes:
            raise SettingsError(
                "there are no scenes to run",
                expected=f"scenes of {sheet}, such as {shorten_list([row.name for row in self.rows], 12)}",
                found="\n            ".join(
                    [
                        f"groups {list(run.groups)}, only {list(run.only)}, data_root {run.data_root!r}",
                        *self.absent_lines(),
                    ]
                ),
                fix="select a scene (hilsplat run photos/desk) or other groups, or set data_root",
            )
        rows_of: dict[Path | None, SceneRow] = {}
        for row in filter(lambda row: published(row.source), self.scenes):
            if (other := rows_of.setdefault(row.folder, row)) is not row:
                raise SettingsError(
                    f"{other.name} and {row.name} are the same scene of a data set, with the same scores",
                    fix="remove one of their rows, or run them one at a time into separate results folders",
                )
        # A thousand scenes have tens of thousands of jobs, so settings are resolved and folders read once.
        self.stages_of = functools.cache(lambda *which: run.stages(*which).resolve_auto())
        self.options: dict[str, Option] = {
            "unit": lambda job: self.row(job).unit,
            "render": lambda job: self.row(job).generated is not None,
            "poses": lambda job: portable(self.row(job).poses),
            "source": self.data.generated_source,
            "dataset": lambda job: job.dataset,
            "variant": lambda job: job.variant,
            "labels": lambda job: self.data.labels(self.row(job)),
            "data_root": self.data.root,
            "names": self.names,
            "queries": self.queries,
        }
        self._json = functools.cache(
            lambda section, omitted, *which: self._section(section, *which).model_dump_json(
                exclude={*omitted}
            )
        )
        self.identity = functools.cache(self._identity)
        self._variants = run.every_variant()
        self._files = [(stage.scope, stage.file) for stage in all_stages().values()]
        names = {row.name for row in self.rows}
        places = [self.results / dataset for dataset in sorted({row.dataset for row in self.rows})]
        inside = [path for folder in places if folder.is_dir() for path in folder.iterdir()]
        self._unlisted = {f"{path.parent.name}/{path.name}" for path in inside} - names
        self._first_alike = functools.cache(self._first_with_equal_identity)
        for row in self.scenes:
            self.data.require_usable_files(row)

    def absent_lines(self) -> list[str]:
        """Return a line for each data set with skipped scenes, or for each reason if there are several."""
        skipped: dict[tuple[str, str], list[str]] = {}
        for name, reason in self.absent.items():
            dataset, _, scene = name.partition("/")
            skipped.setdefault((dataset, reason), []).append(scene)
        return [f"{data} ({shorten_list(names)}) is skipped: {why}" for (data, why), names in skipped.items()]

    def require_usable(self, *, devices: bool) -> None:
        """Check that the models exist and, with `devices`, that this machine has the configured devices."""
        where: dict[StageSettings, str] = {}
        for row in self.scenes:
            for variant in self.run.variant_names():
                where.setdefault(self.stages_of(variant, self.scopes(row)), f"{row.name}, variant {variant}")
        for stages, origin in where.items():
            check_models(stages, origin)
            check_stages(stages, origin)
            if devices:
                check_device(stages, origin)

    def path(self, job: Job, *parts: str) -> str:
        return "/".join([self.run.results, job.dataset, job.scene, *parts])

    def row(self, job: Job) -> SceneRow:
        return self.data.row(job)

    def stages(self, job: Job) -> StageSettings:
        """Return all settings of a scene and, if the job has one, a variant."""
        return self.stages_of(*self.which(job))

    def which(self, job: Job) -> tuple[str, tuple[str, ...]]:
        """Return the variant and the overrides that determine a job's settings."""
        return getattr(job, "variant", "default"), self.scopes(self.row(job))

    def _section(self, section: str, variant: str, scopes: tuple[str, ...]) -> Any:
        return getattr(self.stages_of(variant, scopes), section)

    def settings(self, section: str, job: Job, omitted: frozenset[str] = frozenset()) -> str:
        """Return a section's settings for a job, as JSON; only levels apply to imported masks."""
        if section == "masks" and self.row(job).features is not None:
            masks = self.stages(job).masks
            imported = MasksSettings(segmenter="graph", levels=masks.levels, theta=masks.theta)
            return imported.model_dump_json(exclude={*omitted})
        return escape_json_for_report(self._json(section, omitted, *self.which(job)))

    def seeded(self, variant: str, row: SceneRow, table: str) -> list[str]:
        """Return a variant and, if it is random, its repetitions with a table's other seeds."""
        is_random = self.identity(SCORED, variant, *self.situation(row)).seed is not None
        return self.run.all_seeds(variant, table) if is_random else [variant]

    def seed(self, stage: Stage[..., Any], job: Job) -> int:
        """Return a job's seed, 0 for a variant's stage that is deterministic."""
        if stage.scope != "variant":
            return self.run.seed
        sections = [self._section(section, *self.which(job)) for section in stage.sections.values()]
        is_random = any(section.is_random for section in sections)
        return self.run.seed_of(getattr(job, "variant", "default")) if is_random else 0

    def log(self, name: str, wildcards: str = "") -> str:
        """Return the path of a stage's log."""
        return self._beside(name, "logs", f"{wildcards}.log")

    def benchmark(self, name: str, wildcards: str = "") -> str:
        """Return the path of a stage's benchmark."""
        return self._beside(name, "benchmarks", f"{wildcards}.jsonl")

    @staticmethod
    def _beside(name: str, folder: str, ending: str) -> str:
        stage = stage_of(name)
        places = {"run": "", "scene": "/{dataset}/{scene}", "variant": "/{dataset}/{scene}/{variant}"}
        return f"<results>{places[stage.scope]}/{folder}/{family_of(stage)}{ending}"

    def params(
        self,
        name: str,
        /,
        *,
        files: Callable[[Any], list[str] | str] | None = None,
        plugins: Callable[[Any], tuple[str, ...]] = lambda job: (),
        **options: Option,
    ) -> dict[str, Any]:
        """Return the parameters of a stage's rule: the command, and digests of what Snakemake can't compare.

        Args:
            files: input function of a user's files, whose contents count.
            plugins: function of a job's readers or baseline, whose code counts.
            options: values of the stage's parameters that are neither inputs of the rule nor settings, if
                they differ from `self.options`.
        """
        stage = stage_of(name)

        def settings(wildcards: Any) -> str:
            return words_of(stage, self._values(stage, wildcards, options, UNCOMPARED))

        def command(wildcards: Any, input: Any, output: Any) -> str:
            values = words_of(stage, self._values(stage, wildcards, options))
            paths = words_of(stage, self._paths(stage, wildcards, input, output))
            return f"{stage.command} {values} {paths}"

        code = functools.cache(stage.code_digest)
        # Snakemake compares only parameters that don't derive from input and output.
        params: dict[str, Any] = {
            "command": command,
            "settings": settings,
            "code": lambda wildcards: code(plugins(wildcards)),
        }
        if files is not None:
            params["files"] = self.data.content(files)
        models = [name for name in stage.sections.values() if "model" in SECTIONS[name].model_fields]
        return params | ({"model": self.model(models[0])} if models else {})

    def _values(
        self,
        stage: Stage[..., Any],
        job: Any,
        options: Mapping[str, Option],
        omitted: frozenset[str] = frozenset(),
    ) -> dict[str, Any]:
        """Return the values of a stage's parameters that don't depend on its rule's input and output.

        Settings lack the `omitted` ones.
        """
        values: dict[str, Any] = {}
        for name in stage.hints:
            if (option := options.get(name, self.options.get(name))) is not None:
                values[name] = option(job)
            elif name in stage.sections:
                values[name] = self.settings(stage.sections[name], job, omitted)
            elif name == "seed":
                values[name] = str(self.seed(stage, job))
        return values

    def _paths(self, stage: Stage[..., Any], job: Any, input: Any, output: Any) -> dict[str, Any]:
        """Return the paths of a stage's parameters, which a module may have prefixed."""
        parents = Path(output.out).parents
        paths: dict[str, Any] = {
            "images": lambda: self.data.images(job, input),
            "folder": lambda: str(Path(input.gaussians).parent),
            "cache": lambda: str(parents[{"run": 0, "scene": 2, "variant": 3}[stage.scope]] / ".cache"),
        }
        values: dict[str, Any] = {}
        for name in stage.hints:
            if name in paths:
                values[name] = paths[name]()
            elif name in stage.inputs:
                values[name] = getattr(input, name, "")
            elif name in stage.outputs[1:]:
                values[name] = getattr(output, name)
        return values

    def vocabulary(self, job: Job) -> list[str]:
        """Return the input of `names`: the user's own vocabulary, if any."""
        named = self.stages(job).query.vocabulary
        return [] if named == AUTO else [named]

    def model(self, section: str) -> Callable[[Job], str]:
        """Return the parameter function for the digest of a section's model folder, or "none"."""

        def digest(job: Job) -> str:
            settings = getattr(self.stages(job), section)
            uses_model = settings.uses_model and not self.row(job).features
            return model_digest(model_path(settings.model), self.results / ".cache") if uses_model else "none"

        return digest

    def model_lines(self) -> list[str]:
        """Return lines about the models of each scene, with warnings about models unfit for photographs."""
        scenes: dict[tuple[str, str], list[str]] = {}
        for row in self.scenes:
            stages = self.stages_of("default", self.scopes(row))
            described = describe_models(stages, row.features)
            key = (described, "" if row.generated else doubt_about_photographs(stages))
            scenes.setdefault(key, []).append(row.name)
        return [
            line
            for (models, doubt), names in scenes.items()
            for line in (f"{shorten_list(names)}: {models}", doubt)
            if line
        ]

    def inputs(self, name: str) -> dict[str, Callable[[VariantJob], str]]:
        """Return input functions for the artifacts of a variant that a stage needs (`shared_path`)."""
        return {artifact: functools.partial(self.shared_path, artifact) for artifact in _of_variant(name)}

    def compared(self, *artifacts: str) -> dict[str, Callable[[Job], list[str]]]:
        """Return input functions for the artifacts of all variants in the main tables."""

        def paths(name: str, job: Job) -> list[str]:
            return list(dict.fromkeys(self.shared_path(name, main) for main in self._main_jobs(job)))

        return {name: functools.partial(paths, name) for name in artifacts}

    def of_default(self, *artifacts: str) -> dict[str, str]:
        """Return patterns of the artifacts of the variant `default`, which shares those of no other."""
        files = {name: kinds_of(name)[-1].file for name in artifacts}
        return {name: f"<results>/{{dataset}}/{{scene}}/default/{file}" for name, file in files.items()}

    def of_key_views(self, artifact: str) -> Callable[[Job], str]:
        """Return the input function for an artifact of the key views."""
        return lambda job: self.shared_path(artifact, of_variant(job, KEY_VIEWS))

    def shared_path(self, artifact: str, job: VariantJob) -> str:
        """Return the path of an artifact, of the first variant whose artifact is the same.

        Variants that are in no table are included, so that shared files do not move when tables change.
        """
        stage = kinds_of(artifact)[-1]
        variant = [self.shared_variant(artifact, job)] if stage.scope == "variant" else []
        return self.path(job, *variant, stage.file)

    def artifacts(self, row: SceneRow) -> list[Path]:
        """Return the existing artifacts of a scene's stages, whatever variants a run computes."""
        folder = Path(self.path(row))
        inside = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        places = {"scene": [folder], "variant": [folder / name for name in self._variants if name in inside]}
        paths = [root / file for scope, file in self._files for root in places.get(scope, ())]
        return [path for path in dict.fromkeys(paths) if path.exists()]

    def compared_scores(self, job: Job) -> list[str]:
        """Return the input of `comparison`: the scores of each variant in the main tables."""
        return [self.path(main, main.variant, "scores.csv") for main in self._main_jobs(job)]

    def _main_jobs(self, job: Job) -> list[VariantJob]:
        return [of_variant(job, name) for name in self.run.main_variants]

    def shared_variant(self, artifact: str, job: VariantJob) -> str:
        """Return the first variant whose artifact equals that of the job's variant."""
        return self._first_alike(artifact, job.variant, *self.situation(self.row(job)))

    def _first_with_equal_identity(self, artifact: str, variant: str, *situation: Any) -> str:
        identity = self.identity(artifact, variant, *situation)
        names = self.run.every_variant()
        return next(
            (name for name in names if self.identity(artifact, name, *situation) == identity), variant
        )

    def situation(self, row: SceneRow) -> tuple[tuple[str, ...], bool]:
        """Return what decides about a scene's artifacts besides the variant."""
        return self.scopes(row), row.features is not None

    def _identity(self, artifact: str, variant: str, scopes: tuple[str, ...], is_imported: bool) -> Identity:
        """Return what an artifact of a variant is made from, directly and through its inputs."""
        settings = self.stages_of(variant, scopes)
        stages: dict[str, Stage[..., Any]] = {}
        waiting = [artifact]
        while waiting:
            kinds = kinds_of(waiting.pop())
            stage = _first_kind(kinds, Facts(settings, is_imported)) if kinds else None
            if stage is not None and stage.scope == "variant" and stage.name not in stages:
                stages[stage.name] = stage
                waiting += stage.inputs
        sections = {name for stage in stages.values() for name in stage.sections.values()}
        values = {name: getattr(settings, name) for name in sorted(sections)}
        seed = self.run.seed_of(variant) if any(each.is_random for each in values.values()) else None
        return Identity(tuple(sorted(stages)), tuple(values.items()), seed)

    def scopes(self, row: SceneRow) -> tuple[str, ...]:
        """Return the existing keys of `overrides` that apply to a scene, the more general key first."""
        return tuple(scope for scope in (row.group, row.name) if scope in self.run.overrides)

    def kind(self, artifact: str, job: VariantJob) -> Stage[..., Any]:
        """Return the stage that makes an artifact of a job's variant."""
        row = self.row(job)
        facts = Facts(self.stages(job), row.features is not None, self.first_answer(job))
        return _first_kind(kinds_of(artifact), facts)

    def datasets(self) -> str:
        """Return a pattern of the wildcard `dataset`; it rejects results of scenes that are not in the sheet.

        It doesn't list the run's scenes, because Snakemake copies the pattern for each file of each job.
        """
        return f"(?!(?:{any_of(self._unlisted)})/)(?:{any_of(row.dataset for row in self.rows)})"

    def jobs_of(self, name: str) -> str:
        """Return a pattern of the wildcard `dataset` of the jobs for which this stage makes its artifact.

        It looks ahead to the scene and the variant, because which stage it is depends on both.
        """
        kinds, scenes = kinds_of(stage_of(name).artifact), dict[tuple[str, ...], list[str]]()
        variants_of = functools.cache(functools.partial(self._variants_of, name, kinds))
        for row in self.rows:
            variants = variants_of(*self.situation(row), self.first_answer(of_variant(row, "default")))
            scenes.setdefault(variants, []).append(row.name)
        # Of the scenes with equal variants, the most are those that are not listed (see `datasets`).
        most, *others = sorted(scenes, key=lambda variants: -len(scenes[variants]))
        listed = any_of(self._unlisted.union(*(scenes[variants] for variants in others)))
        patterns = [f"(?!(?:{listed})/)[^/]+/[^/]+/({any_of(most)})/"]
        patterns += [f"({any_of(scenes[variants])})/({any_of(variants)})/" for variants in others]
        return f"(?={'|'.join(patterns)})[^/]+"

    def _variants_of(
        self,
        name: str,
        kinds: list[Stage[..., Any]],
        scopes: tuple[str, ...],
        is_imported: bool,
        is_refined: bool,
    ) -> tuple[str, ...]:
        facts = {
            variant: Facts(self.stages_of(variant, scopes), is_imported, is_refined and variant == "default")
            for variant in self.run.every_variant()
        }
        return tuple(variant for variant, known in facts.items() if _first_kind(kinds, known).name == name)

    def first_answer(self, job: VariantJob) -> bool:
        """Return whether key views answer queries before all photographs have masks."""
        row, masks = self.row(job), self.stages(job).masks
        of_photographs = job.variant == "default" and row.group == PHOTOS and not row.features
        if not of_photographs or KEY_VIEWS not in self.run.variants:
            return False
        model = planned_model(Path(masks.model)) if masks.segmenter == "sam" else None
        is_slow = model is not None and not model.embedded
        return is_slow and self.data.num_images(job) >= MIN_PHOTOGRAPHS

    def masks_priority(self, job: VariantJob) -> int:
        """Return the priority of `masks`: lower if key views come first, or if cached masks get other levels.

        Ordering by an `ancient` input would be stricter, but then Snakemake 9.27 overlooks that later stages
        have changed.
        """
        return 20 if self.first_answer(job) or self.stages(job).masks.levels == "tree" else 30

    def crops_tree(self, job: VariantJob) -> list[str]:
        """Return the input of `clip`: the semantic tree that selects crops; empty to embed all masks."""
        return [self.shared_path("semantic_tree", job)] if self.stages(job).clip.crops == "nodes" else []

    def first_code(self, job: VariantJob) -> list[str]:
        """Return the input of `autoencoder`: the code of the same masks with levels by head, if there is one.

        Variants share a code unless they differ in what changes masks and their vectors.
        """
        stages, situation = self.stages(job), self.situation(self.row(job))
        if stages.masks.levels == "head" or stages.autoencoder.targets != "mask":
            return []
        identity = self._code_identity(job.variant, *situation)
        for name in self.run.every_variant():
            is_by_head = self.stages_of(name, situation[0]).masks.levels == "head"
            if is_by_head and self._code_identity(name, *situation) == identity:
                return [self.path(job, name, "autoencoder")]
        return []

    def _code_identity(self, variant: str, *situation: Any) -> Identity:
        """Return what a code is made from: not levels and, for masks' own vectors, by default not trees."""
        stages, settings, seed = self.identity("autoencoder", variant, *situation)
        values = dict(settings)
        values["masks"] = values["masks"].model_copy(update={"levels": "head", "theta": None})
        if (values["clip"].crops, values["autoencoder"].targets) == ("masks", "mask"):  # else trees matter
            values["clip"] = values["clip"].model_copy(update={"crops_per_node": 0})
            linking = [kind for artifact in LINKING for kind in kinds_of(artifact)]
            stages = tuple(name for name in stages if name not in {kind.name for kind in linking})
            sections = {name for kind in linking for name in kind.sections.values()} - {"masks"}
            values = {name: value for name, value in values.items() if name not in sections}
        return Identity(stages, tuple(values.items()), seed)

    def first_field(self, job: VariantJob) -> list[str]:
        """Return the input of `field`: LangSplat's initial field; SettingsError if no variant computes it."""
        if self.stages(job).field.start != "langsplat":
            return []
        situation = self.situation(self.row(job))

        def start_of(name: str) -> tuple[Any, ...]:
            masks = self.identity("masks", name, *situation)
            return self.run.seed_of(name), masks, self._code_identity(name, *situation)

        start = start_of(job.variant)
        for name in self.run.every_variant():
            if self.stages_of(name, situation[0]).method.name == "langsplat" and start_of(name) == start:
                return [self.path(job, name, "field.safetensors")]
        raise SettingsError(
            f"{job.dataset}/{job.scene}, variant {job.variant}: field.start is langsplat, but no variant has "
            "method.name langsplat with the same masks and autoencoder",
            fix="add such a variant, or change field.start",
        )

    def baseline(self, job: VariantJob) -> tuple[str, ...]:
        return (method_of(self.stages(job).method.name).fit,)

    def names(self, _: object) -> str:
        """Return each variant's name in tables and figures, as JSON; Snakemake would expand plain text."""
        return escape_json_for_report(json.dumps(dict(self.run.labels)))

    def queries(self, job: Job) -> str:
        """Return the queries for the panel of a scene without labels on images, as JSON."""
        of_dataset = self.run.queries.get(job.dataset, ())
        queries = self.run.queries.get(f"{job.dataset}/{job.scene}", of_dataset)
        return escape_json_for_report(json.dumps(queries))


def _of_variant(name: str) -> list[str]:
    """Return the artifacts of a variant that a stage needs."""
    kinds = {artifact: kinds_of(artifact) for artifact in stage_of(name).needs}
    return [artifact for artifact, stages in kinds.items() if stages and stages[-1].scope == "variant"]


PARTS = _of_variant(SCORED)  # artifacts of a variant that queries read


def _first_kind(kinds: list[Stage[..., Any]], facts: Facts) -> Stage[..., Any]:
    return next(stage for stage in kinds if stage.when is None or stage.when(facts))


def require_variant_sections(run: RunSettings) -> None:
    """Raise SettingsError for a variant that changes a section of the stages that all variants share."""
    stages = [stage for stage in all_stages().values() if stage.scope == "variant"]
    sections = {section for stage in stages for section in stage.sections.values()}
    for variant, changed in run.variants.items():
        for section in changed:
            if section not in sections:
                raise SettingsError(
                    f"variants.{variant}.{section}: variants share this section and cannot change it",
                    expected=f"one of {', '.join(sorted(sections))}",
                    fix="put it under overrides for a group or a scene, or in a separate configuration",
                )


def without_effect(plan: Plan, given: Mapping[str, Any]) -> list[str]:
    """Return a line for each setting of a configuration's layer that `overrides` replace in all scenes."""
    scopes, lines = list(dict.fromkeys(plan.scopes(row) for row in plan.scenes)), []
    for section in (name for name in SECTIONS if given.get(name)):
        unreplaced = getattr(plan.run, section)
        used = [getattr(plan.run.stages(scopes=keys), section) for keys in scopes]
        for name in given[section]:
            if all(getattr(values, name, None) != getattr(unreplaced, name, None) for values in used):
                replacing = [key for key in reversed(scopes[0]) if section in plan.run.overrides[key]]
                scope = max(replacing, key=lambda key: name in plan.run.overrides[key][section])
                setting = f"{section}.{name}"
                lines.append(f"{setting} has no effect, because overrides.{scope}.{setting} replaces it")
    return lines


def kept_by_variants(plan: Plan, given: Mapping[str, Any]) -> list[str]:
    """Return a line for each setting of a configuration's layer that variants of the run set themselves."""
    changes = {name: plan.run.variants.get(name, {}) for name in plan.run.variant_names()}
    lines = []
    for section in (name for name in SECTIONS if given.get(name)):
        for name in given[section]:
            if variants := [key for key, changed in changes.items() if name in changed.get(section, ())]:
                setting = f"{section}.{name}"
                lines.append(f"{setting} has no effect on variants that set it: {shorten_list(variants)}")
    return lines


def without_scene(run: RunSettings, rows: Iterable[SceneRow]) -> list[str]:
    """Return a line for each scene in `overrides`, `queries` and `sweep_scenes` that is not in the rows.

    SettingsError is raised if a name is probably misspelt, or has no effect: `overrides` take the names of
    groups, `queries` those of data sets.
    """
    open_ended = {name for name in (*run.groups, *run.overrides, *run.queries) if is_open_ended(name)}
    groups = list(dict.fromkeys((*GROUPS, *(row.group for row in rows), *open_ended)))
    require_known("groups", run.groups, groups)
    datasets = {row.dataset for row in rows} | {PHOTOS} | open_ended
    scenes = [row.name for row in rows]
    # Settings of a scene that was removed from the sheet may stay in the configuration.
    named = [key for key in (*run.overrides, *run.queries) if "/" in key]
    gone = [key for key in named if key.partition("/")[0] in datasets]
    require_known("overrides", run.overrides, [*groups, *scenes, *gone])
    require_known("queries", run.queries, [*sorted(datasets), *scenes, *gone])
    known = {
        **dict.fromkeys(gone, ("overrides or queries", scenes)),
        **dict.fromkeys(run.sweep_scenes, ("sweep_scenes", [row.scene for row in rows])),
    }
    lines = []
    for key, (where, names) in sorted((key, value) for key, value in known.items() if key not in value[1]):
        line = f"the configuration ({where}) names the scene {key!r}, which is not in {run.scenes}"
        if near := difflib.get_close_matches(key, names, n=1, cutoff=0.85):
            raise SettingsError(line, expected=f"did you mean {near[0]!r}?", fix="correct or remove the name")
        lines.append(f"{line}; it is ignored")
    return lines
