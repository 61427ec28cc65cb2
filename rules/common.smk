# Shared by all rules: the plan of the run (hilsplat/workflow/plan.py), resources, and the jobs' environment.
#
# Priorities minimise the time to a scene's first answer: jobs closest to the CLIP vectors of a semantic tree
# run first, and fields, scores and pictures run after all of them. Gaussians precede masks because users can
# view them. After the vectors, the longest chain runs first: trained code, baseline field, our fields, scores.
import gc
import json
from pathlib import Path

from snakemake.exceptions import WorkflowError
from snakemake.logging import logger

from hilsplat.base.lineage import sha256_of_bytes
from hilsplat.base.errors import HilsplatError
from hilsplat.base.files import INSTALLED
from hilsplat.configuration import merged_config
from hilsplat.evaluate.tables.build import TABLES, published_values
from hilsplat.workflow import targets
from hilsplat.workflow.plan import Plan, any_of
from hilsplat.workflow.progress import estimates
from hilsplat.workflow.resources import JobResources
from hilsplat.workflow.run import mark_run, prepare_process, record_run, unmark_run

# Planning many scenes creates millions of permanent objects; less frequent collection saves 10 % of the time.
gc.set_threshold(200_000, 50, 100)

LOCK = prepare_process()


def own_cores():
    """Return this machine's cores if it runs the jobs, or None on a cluster, where --jobs applies instead."""
    try:
        cores = workflow.cores
    except WorkflowError:
        return None
    if cores < 1:
        raise WorkflowError("with --cores 0, no job can start; expected at least 1")
    return cores


def mark_or_refuse():
    """Mark this run, or refuse it if another run writes to the same results."""
    try:
        mark_run(PLAN.results)
    except HilsplatError as error:
        raise WorkflowError(str(error)) from None


def cache_folder(wildcards, input):
    """Return the cache folder in the results folder, whose path a module may prefix."""
    return str(Path(input.scene).parents[2] / ".cache")


def given(files):
    """Return an input function whose files outside the results get no prefix from a module."""

    def found(wildcards):
        paths = files(wildcards)
        is_own = isinstance(paths, str) or PLAN.data.truth(wildcards) == paths
        return paths if is_own else [local(path) for path in paths]

    return found


try:
    PLAN = Plan(merged_config([], config))
    PLAN.require_usable(devices=own_cores() is not None)
except HilsplatError as error:  # users can fix these errors without a traceback
    raise WorkflowError(str(error)) from None
for name, reason in PLAN.absent.items():
    logger.warning(f"{name} is skipped: {reason}")

ENVIRONMENT = "../workflow/envs/hilsplat.yaml"
RESOURCES = JobResources(PLAN, own_cores())
estimates.resources = RESOURCES
