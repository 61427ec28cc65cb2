# What all rules use, namely the validated configuration, the scenes, settings and code digests as
# parameters, and how stages are shared between variants.
import json
import os
import re
import shlex
from pathlib import Path
from types import SimpleNamespace

from snakemake.exceptions import WorkflowError
from snakemake.logging import logger

from hilsplat.base.artifacts import sha256_of_path
from hilsplat.base.code_hash import code_hash as code_of
from hilsplat.base.errors import HilsplatError
from hilsplat.cli.stage_modules import STAGE_MODULES
from hilsplat.datasets.sources import (
    absence,
    image_files,
    is_exported,
    label_files,
    label_sets,
    published,
)
from hilsplat.evaluate.tables.build import TABLES
from hilsplat.methods.registry import METHODS, OURS, require_method
from hilsplat.scene.sheet import choose_scenes, read_sheet
from hilsplat.configuration import UPSTREAM, parse_run


def or_stop(function, *arguments):
    """Call, and turn an error that a user can fix into Snakemake's own, without a traceback."""
    try:
        return function(*arguments)
    except HilsplatError as error:
        raise WorkflowError(str(error)) from None


RUN = or_stop(parse_run, config)
for name in RUN.variant_names():
    or_stop(require_method, RUN.stages(name).method.name)
ALL_SCENES = or_stop(read_sheet, Path(RUN.scenes), RUN.groups, RUN.data_root)
CHOSEN = or_stop(choose_scenes, ALL_SCENES, RUN.groups, RUN.only)
if more := {row.group for row in CHOSEN} - set(
    RUN.groups
):  # their sources are checked too
    or_stop(read_sheet, Path(RUN.scenes), {*RUN.groups, *more}, RUN.data_root)
ABSENT = {
    row.name: reason
    for row in CHOSEN
    if (reason := absence(row.source, RUN.data_root)) is not None
}
SCENES = [row for row in CHOSEN if row.name not in ABSENT]
for name, reason in ABSENT.items():
    logger.warning(f"{name} is skipped: {reason}")
if not SCENES:
    raise WorkflowError(
        f"no scene to run: groups {list(RUN.groups)}, only {list(RUN.only)}, "
        f"data_root {RUN.data_root!r}; {RUN.scenes} holds "
        f"{', '.join(f'{row.name} ({row.group})' for row in ALL_SCENES)}"
    )

CACHE = Path("results/.cache")
ENVIRONMENT = "../workflow/envs/hilsplat.yaml"

try:
    CORES = workflow.cores
except WorkflowError:  # not given, as with --report and --lint, which run no job
    CORES = 1
# With at least as many scenes as cores, one thread a job keeps all cores busy.
THREADS = max(1, CORES // min(len(SCENES), CORES))


def any_of(names):
    """Regular expression that matches exactly these names; none where there is no name."""
    return "|".join(sorted({re.escape(name) for name in names})) or "(?!)"


def variants_by_method(baselines):
    """Variants whose field a baseline writes, or those whose field is ours."""
    return [
        name
        for name in RUN.variant_names()
        if (RUN.stages(name).method.name != OURS) == baselines
    ]


def row_of(wildcards):
    """Row of the scene sheet that the wildcards name."""
    for row in ALL_SCENES:
        if (row.dataset, row.scene) == (wildcards.dataset, wildcards.scene):
            return row
    raise WorkflowError(f"{wildcards.dataset}/{wildcards.scene} is not in {RUN.scenes}")


def scopes_of(row):
    """Keys of `overrides` that apply to a scene, general first."""
    return (row.group, f"{row.dataset}/{row.scene}")


def stages_of(wildcards):
    """All settings of a scene and, where a variant is named."""
    variant = getattr(wildcards, "variant", "default")
    return or_stop(RUN.stages, variant, scopes_of(row_of(wildcards)))


def settings_of(section):
    """Parameter: a section's settings for this scene and variant, as JSON."""
    return lambda wildcards: getattr(stages_of(wildcards), section).model_dump_json()


def code(stage):
    """Parameter: digest of the code that a stage runs; a function tells the stage from the wildcards."""
    if callable(stage):
        return lambda wildcards: code(stage(wildcards))
    return or_stop(code_of, STAGE_MODULES[stage])


def code_of_method(wildcards):
    """Parameter: digest of the code of the baseline that writes a variant's field."""
    return code("method") + or_stop(code_of, METHODS[stages_of(wildcards).method.name])


def stage_of_masks(wildcards):
    """Stage that makes the masks; the diagnostic segmenter has its own."""
    diagnostic = stages_of(wildcards).masks.segmenter == "truth-perturbed"
    return "truth_masks" if diagnostic else "masks"


def truth_of_masks(wildcards):
    """Input of masks: the true labels where the diagnostic segmenter is asked for, else nothing."""
    if stage_of_masks(wildcards) == "masks":
        return []
    row = row_of(wildcards)
    if not row.world:
        raise WorkflowError(
            f"{row.name}, variant {wildcards.variant}: masks.segmenter truth-perturbed needs the true "
            "labels of a synthetic scene, and this one has none"
        )
    return f"results/{row.dataset}/{row.scene}/world/truth"


def truth_option_of_masks(wildcards, input):
    """Parameter of masks: the options of the diagnostic segmenter, else nothing."""
    if not input.truth:
        return ""
    faults = stages_of(wildcards).perturb.model_dump_json()
    return f"--truth {shlex.quote(input.truth)} --perturb {shlex.quote(faults)}"


def shared_variant(stage, wildcards):
    """First variant whose settings, up to this stage, equal those of the wildcards' variant.

    A sweep over Omega thus retrains fields and shares masks, trees and embeddings with `default`.
    """
    scopes = scopes_of(row_of(wildcards))
    wanted = or_stop(RUN.stages, wildcards.variant, scopes)
    for name in RUN.variant_names():
        other = or_stop(RUN.stages, name, scopes)
        if all(
            getattr(other, section) == getattr(wanted, section)
            for section in UPSTREAM[stage]
        ) and (
            not or_stop(RUN.is_random, stage, wildcards.variant, scopes)
            or RUN.seed_of(name) == RUN.seed_of(wildcards.variant)
        ):
            return name
    return wildcards.variant


def shared(stage, path):
    """Input function: a stage's output under the variant that it is shared with."""
    return (
        lambda wildcards: f"results/{wildcards.dataset}/{wildcards.scene}/{shared_variant(stage, wildcards)}/{path}"
    )


def compared(stage, path):
    """Input function: a stage's output for every variant that is compared, wherever it is shared."""

    def paths(wildcards):
        scene = {"dataset": wildcards.dataset, "scene": wildcards.scene}
        jobs = [SimpleNamespace(**scene, variant=name) for name in RUN.main_variants]
        return list(dict.fromkeys(shared(stage, path)(job) for job in jobs))

    return paths


def photos_of(wildcards):
    """Files that a scene of photographs is made from; one more or one less reruns its poses."""
    row = row_of(wildcards)
    labels = set(label_files_of(row))
    return sorted(
        str(path)
        for path in row.folder.rglob("*")
        if path.is_file() and not path.name.startswith(".") and str(path) not in labels
    )


def brought_gaussians_of(wildcards):
    """Input: somebody's PLY that takes the place of a fit, with the JSON beside it; mostly nothing."""
    ply = row_of(wildcards).gaussians
    if ply is None:
        return []
    beside = ply.with_suffix(".json")
    return [str(ply), *([str(beside)] if beside.is_file() else [])]


def brought_option_of(wildcards, input):
    """Parameter: the option that brings somebody's PLY, else nothing."""
    return f"--brought {shlex.quote(input.brought[0])}" if input.brought else ""


def digest_of_model(section):
    """Parameter: digest of the model folder that a stage reads; "none" where it reads none."""

    def digest(wildcards):
        stages = stages_of(wildcards)
        if section == "masks" and stages.masks.segmenter != "sam":
            return "none"
        folder = Path(getattr(stages, section).model)
        if not folder.is_dir():
            return f"{folder} is missing"  # the stage itself says what to do
        return memo_digest(folder)

    return digest


_digests = {}


def memo_digest(folder):
    """Digest of a folder's files, computed once while sizes and times of the files stay."""
    if folder in _digests:
        return _digests[folder]
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    stamp = json.dumps(
        [[str(f), f.stat().st_size, f.stat().st_mtime_ns] for f in files]
    )
    memo = CACHE / "digests.json"
    try:
        known = json.loads(memo.read_text())
    except (OSError, ValueError):
        known = {}
    if stamp not in known:
        known[stamp] = sha256_of_path(folder)
        memo.parent.mkdir(parents=True, exist_ok=True)
        temporary = memo.with_suffix(f".{os.getpid()}")
        temporary.write_text(json.dumps(known))
        os.replace(temporary, memo)
    _digests[folder] = known[stamp]
    return known[stamp]


def images_of(wildcards):
    """Folder that the poses of a scene are found from."""
    row = row_of(wildcards)
    if row.world:
        return f"results/{row.dataset}/{row.scene}/world/images"
    if is_exported(row.source):
        return f"results/{row.dataset}/{row.scene}/source"
    return str(row.folder)


def image_files_of(wildcards):
    """Input of poses: a folder that a rule writes, or each file of a folder of photographs."""
    row = row_of(wildcards)
    if row.world or is_exported(row.source):
        return images_of(wildcards)
    return photos_of(wildcards)


def source_files_of(wildcards):
    """Input of source: files of a data set that images and poses are written from."""
    return [str(path) for path in image_files(row_of(wildcards).source, RUN.data_root)]


def labels_of(row):
    """Labels of a scene of a published data set, as `data set/scene`; several may share its images."""
    return label_sets(row.source, RUN.data_root)


def label_files_of(row):
    """Files that only evaluation reads: an edited one reruns nothing before it."""
    return [
        str(path.resolve())
        for labels in labels_of(row)
        for path in label_files(labels, RUN.data_root)
    ]


def labelled(rows):
    """Scenes that have annotations or labels to be scored against."""
    return [row for row in rows if row.world or labels_of(row)]


def truth_option_of(wildcards, input):
    """Parameter: what a scene is scored against."""
    row = row_of(wildcards)
    if row.world:
        return f"--truth {shlex.quote(truth_of(wildcards)[0])} --kind {row.world[0]}"
    options = [f"--labels {shlex.quote(labels)}" for labels in labels_of(row)]
    return " ".join([*options, f"--data-root {shlex.quote(str(Path(RUN.data_root)))}"])


def data_of(row):
    """What a scene is to a table: its kind of synthetic scene, or its published data set."""
    if row.world:
        return row.world[0]
    place = published(row.source)
    return place[0] if place else ""


def variants_of(table, row):
    """Variants of a table for a scene, every seed of each that holds something random."""
    listed = getattr(RUN, TABLES[table].variants)
    scopes = scopes_of(row)
    return [name for variant in listed for name in or_stop(RUN.seeded, variant, scopes)]


def scores_of(table):
    """Score files that a table is built from; sweeps take the scenes that are named for them."""
    kind = TABLES[table]
    rows = [row for row in labelled(SCENES) if data_of(row) in kind.data]
    if kind.is_sweep and RUN.sweep_scenes:
        rows = [row for row in rows if row.scene in RUN.sweep_scenes]
    return [
        f"results/{row.dataset}/{row.scene}/{variant}/scores.csv"
        for row in rows
        for variant in variants_of(table, row)
    ]


def absent_of(table):
    """Parameter: options that tell which scenes of a table's data sets were not measured."""
    told = {}
    for row in ALL_SCENES:
        reason = absence(row.source, RUN.data_root)
        place = published(row.source)
        if place and place[0] in TABLES[table].data and reason is not None:
            told.setdefault(row.dataset, []).append((row.scene, reason))
    sentences = []
    for dataset, scenes in told.items():
        reasons = {reason for _, reason in scenes}
        others = "" if len(reasons) == 1 else " The others cannot be read either."
        listed = names([scene for scene, _ in scenes])
        sentences.append(f"{dataset} ({listed}): {scenes[0][1]}.{others}")
    return " ".join(f"--absent {shlex.quote(sentence)}" for sentence in sentences)


def names(scenes):
    """Some names, the first three in full."""
    more = f" and {len(scenes) - 3} more" if len(scenes) > 3 else ""
    return ", ".join(scenes[:3]) + more


def targets_of_tables():
    """Every table, measured on whatever scenes there are; the paper's rows are always there."""
    return [f"results/tables/{name}.csv" for name in TABLES]


def targets_of_run():
    """Pictures of every scene, and tables and plots where the run has a scene to measure.

    A run of photographs would leave tables of reported rows where a benchmark's were.
    """
    measured = [*targets_of_tables(), *targets_of_plots()] if labelled(SCENES) else []
    return [*targets_of_figures(), *measured]


def targets_of_figures():
    """The panel of every scene, masks against the truth where it is known, methods side by side in the
    scenes of the sweeps."""
    compared = [
        row for row in SCENES if not RUN.sweep_scenes or row.scene in RUN.sweep_scenes
    ]
    return [
        *(f"results/figures/{row.dataset}/{row.scene}/panel.png" for row in SCENES),
        *(
            f"results/figures/{row.dataset}/{row.scene}/masks.png"
            for row in SCENES
            if row.world
        ),
        *(
            f"results/figures/{row.dataset}/{row.scene}/comparison.png"
            for row in compared
        ),
    ]


def targets_of_plots():
    """Plots of the sweeps."""
    return [f"results/figures/sweep-{name}.png" for name in ("theta", "omega")]


def figure_truth_of(wildcards):
    """Parameter of figures: what names the queries and is outlined, where there is something."""
    row = row_of(wildcards)
    if row.world:
        return f"--truth {shlex.quote(truth_of(wildcards)[0])}"
    on_images = [
        labels for labels in labels_of(row) if not is_exported(f"data:{labels}")
    ]
    if not on_images:
        return ""
    return f"--labels {shlex.quote(on_images[-1])} --data-root {shlex.quote(str(Path(RUN.data_root)))}"


def queries_of(wildcards):
    """Parameter: texts for the panel of a scene without labels on images, as JSON."""
    of_dataset = RUN.queries.get(wildcards.dataset, ())
    name = f"{wildcards.dataset}/{wildcards.scene}"
    return json.dumps(RUN.queries.get(name, of_dataset))


def truth_of(wildcards):
    """Input: the annotations of a scene, where it has some."""
    row = row_of(wildcards)
    return [f"results/{row.dataset}/{row.scene}/world/truth"] if row.world else []


def truth_or_labels_of(wildcards):
    """Input of evaluate: the annotations of a synthetic scene, or the label files of a published one."""
    return truth_of(wildcards) or label_files_of(row_of(wildcards))


def print_where_time_went():
    """After a run: seconds and memory per stage, from the benchmark files."""
    shell("hilsplat efficiency --results results --out results/efficiency.csv")
