# What all rules use, namely the validated configuration, the scenes, settings and code digests as
# parameters, and how stages are shared between variants.
import json
import os
import re
import shlex
from pathlib import Path

from snakemake.exceptions import WorkflowError
from snakemake.logging import logger

from hilsplat.base.artifacts import sha256_of_path
from hilsplat.base.code_hash import code_hash as code_of
from hilsplat.base.errors import HilsplatError
from hilsplat.cli import STAGE_MODULES
from hilsplat.datasets.published import FRAMES, PROMPTS
from hilsplat.scene.sheet import read_sheet
from hilsplat.settings import UPSTREAM, parse_run


def or_stop(function, *arguments):
    """Call, and turn an error that a user can fix into Snakemake's own, without a traceback."""
    try:
        return function(*arguments)
    except HilsplatError as error:
        raise WorkflowError(str(error)) from None


RUN = or_stop(parse_run, config)
ALL_SCENES = or_stop(read_sheet, Path(RUN.scenes), RUN.groups, RUN.data_root)
CHOSEN = [
    row
    for row in ALL_SCENES
    if row.group in RUN.groups and (not RUN.only or row.scene in RUN.only)
]
SCENES = [row for row in CHOSEN if row.world or row.folder]
for row in CHOSEN:
    if row not in SCENES:
        logger.warning(f"{row.name} is skipped: data_root is not set")
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
    """Regular expression that matches exactly these names."""
    return "|".join(sorted({re.escape(name) for name in names}))


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
        ):
            return name
    return wildcards.variant


def shared(stage, path):
    """Input function: a stage's output under the variant that it is shared with."""
    return (
        lambda wildcards: f"results/{wildcards.dataset}/{wildcards.scene}/{shared_variant(stage, wildcards)}/{path}"
    )


def photos_of(wildcards):
    """Files that a scene of photographs is made from; one more or one less reruns its poses."""
    folder = row_of(wildcards).folder
    return sorted(
        str(path)
        for path in folder.rglob("*")
        if path.is_file() and not path.name.startswith(".")
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
    return (
        f"results/{row.dataset}/{row.scene}/world/images"
        if row.world
        else str(row.folder)
    )


def image_files_of(wildcards):
    """Input of poses: the rendered folder, or each file of a folder of photographs."""
    return images_of(wildcards) if row_of(wildcards).world else photos_of(wildcards)


def labels_of(row):
    """Published labels of a scene as `data set/scene`, or "" where it has none."""
    dataset, _, scene = row.source.removeprefix("data:").partition("/")
    is_published = row.source.startswith("data:") and dataset in (*FRAMES, *PROMPTS)
    return f"{dataset}/{scene}" if is_published else ""


def labelled(rows):
    """Scenes that have annotations or labels to be scored against."""
    return [row for row in rows if row.world or labels_of(row)]


def truth_option_of(wildcards, input):
    """Parameter: what a scene is scored against."""
    row = row_of(wildcards)
    if row.world:
        return f"--truth {shlex.quote(str(input.truth))}"
    root = (
        row.folder.parent.parent
    )  # the sheet resolved `data:<data set>/<scene>` below the data root
    return (
        f"--labels {shlex.quote(labels_of(row))} --data-root {shlex.quote(str(root))}"
    )


def scores_of(variants):
    """Score files of all labelled scenes for some variants."""
    return [
        f"results/{row.dataset}/{row.scene}/{variant}/scores.csv"
        for row in labelled(SCENES)
        for variant in variants
    ]


TABLES = {
    "hierarchy": RUN.main_variants,
    "lerf": RUN.main_variants,
    "ablation": RUN.ablation_variants,
}


def targets_of_tables():
    """Tables that the configured scenes can fill; none where no scene has labels."""
    if not labelled(SCENES):
        return []
    return [
        f"results/tables/{name}.csv" for name, variants in TABLES.items() if variants
    ]


def targets_of_figures():
    """The panel of every scene."""
    return [f"results/figures/{row.dataset}/{row.scene}/panel.png" for row in SCENES]


def queries_of(wildcards):
    """Parameter: texts for the panel of a scene without labels, as JSON."""
    return json.dumps(RUN.queries.get(f"{wildcards.dataset}/{wildcards.scene}", ()))


def truth_of(wildcards):
    """Input: the annotations of a scene, where it has some."""
    row = row_of(wildcards)
    return [f"results/{row.dataset}/{row.scene}/world/truth"] if row.world else []


def print_where_time_went():
    """After a run: seconds and memory per stage, from the benchmark files."""
    shell("hilsplat efficiency --results results --out results/efficiency.csv")
