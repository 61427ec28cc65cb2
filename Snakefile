# hilsplat: 3D scenes with text queries at three levels, from photographs, and the paper's tables.
#
#   snakemake --cores 2                                             everything in the configuration
#   snakemake --cores 2 results/synthetic/table-1/gaussians.ply     one file and what it needs
#   snakemake --cores 2 tables                                      the tables
#   snakemake --report results/report.html                          the report of a finished run
#
# `hilsplat run` starts Snakemake with checks and all cores (docs/workflow.md).
#
# A rule names the inputs, outputs and priority of a stage; its command and other parameters derive from the
# stage's definition in hilsplat/stages.py. Where several stages can make a file, `jobs_of` tells them apart.
#
# Priorities minimise the time to a scene's first answer: jobs closest to the CLIP vectors of a semantic tree
# run first, and fields, scores and pictures run after all of them. Gaussians precede masks because users can
# view them. After the vectors, the longest chain runs first: trained code, baseline field, our fields, scores.
from snakemake.exceptions import WorkflowError
from snakemake.logging import logger
from snakemake.utils import min_version

from hilsplat.base.errors import HilsplatError
from hilsplat.base.files import INSTALLED, project_path
from hilsplat.base.plugins import entry_points
from hilsplat.configuration import CONFIG, merged_config
from hilsplat.datasets.registry import DATASETS, readers_of
from hilsplat.evaluate.tables.build import TABLES, published_values
from hilsplat.workflow import targets
from hilsplat.workflow.plan import PARTS, Plan, any_of
from hilsplat.workflow.progress import estimates
from hilsplat.workflow.resources import JobResources
from hilsplat.workflow.run import mark_run, prepare_process, record_run, unmark_run
from hilsplat.workflow.scene_data import portable

min_version("9.20")


configfile: str(project_path(CONFIG))


report: "workflow/report/overview.rst"


LOCK = prepare_process()


try:  # cores of this machine, if it runs the jobs; on a cluster, also on its nodes, they decide nothing
    CORES = None if workflow.nodes or workflow.remote_exec else workflow.cores
except WorkflowError:
    CORES = None
# The jobs of a group run one after the other, also on its node (profiles/slurm).
if workflow.remote_exec:
    workflow.register_resource("place", 1)
if CORES == 0:
    raise WorkflowError("with --cores 0, no job can start; expected at least 1")
try:
    PLAN = Plan(
        merged_config([], config)
    )  # a module's `config:` replaces the configfile
except HilsplatError as error:  # users can fix these errors without a traceback
    raise WorkflowError(str(error)) from None
try:
    PLAN.require_usable(devices=CORES is not None)
except HilsplatError as error:
    if not estimates.is_dry:  # the estimate of a dry run needs no models
        raise WorkflowError(str(error)) from None
    logger.warning(str(error))
RESOURCES = JobResources(PLAN, CORES)
estimates.resources = RESOURCES
for line in PLAN.absent_lines():
    logger.warning(line)
LABELS = {"files": PLAN.data.label_files, "plugins": PLAN.data.label_readers}
SCORED = {**LABELS, "plugins": PLAN.data.scorers}
READERS = readers_of(DATASETS)
FEATURES = {
    "files": PLAN.data.features,
    "features": lambda job: portable(PLAN.row(job).features),
}


pathvars:
    results=PLAN.run.results,


wildcard_constraints:
    dataset=PLAN.datasets(),
    scene="[^/]+",
    variant=any_of(PLAN.run.every_variant()),


# What the rules of all stages share; it is no target. With -P, no module is imported from the working folder.
rule stage:
    log:
        "<results>/logs/stage.log",
    conda:
        str(INSTALLED / "workflow/envs/hilsplat.yaml")
    threads: RESOURCES.threads
    shell:
        "python -P -m hilsplat --log {log:q} {params.command} --threads {threads}"
        " --memory {resources.mem_mib} --out {output.out:q}"


include: "rules/common.smk"
include: "rules/scene.smk"
include: "rules/splat.smk"
include: "rules/segment.smk"
include: "rules/contributions.smk"
include: "rules/semantic_tree.smk"
include: "rules/embed.smk"
include: "rules/field.smk"
include: "rules/evaluate.smk"
include: "rules/report.smk"


for path in entry_points("hilsplat.rules").values():

    include: str(path)


if (INSTALLED / "models/training").is_dir():  # only in a checkout

    include: str(INSTALLED / "models/training/train.smk")


rule all:
    default_target: True
    input:
        targets.default(PLAN),
        rules.efficiency.output,


onstart:
    try:
        mark_run(PLAN.results)
    except HilsplatError as error:  # another run writes to the same results
        raise WorkflowError(str(error)) from None
    record_run(
        PLAN,
        workflow.config_settings.configfiles,
        workflow.config_settings.config,
    )
    for line in PLAN.ignored:
        logger.warning(line)
    for line in PLAN.model_lines():
        logger.info(line)


onsuccess:
    unmark_run()


onerror:
    unmark_run()
