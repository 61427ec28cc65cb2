# Shared by all rules: the plan of the run (hilsplat/workflow/plan.py), threads, and the environment.
#
# Priorities lead to a scene's first answer: of the jobs that could start, the nearest to its semantic tree is
# first, and fields, scores and pictures come after all trees. Gaussians are before masks: they can be looked at.
# After the trees the longest chain is first: a trained code, a baseline's field, our fields, scores. Jobs of one
# variant have one thread where there are enough of them for all cores.
#
# All outputs are `update(...)`: Snakemake deletes others before their job begins. A stage replaces its output when the
# new one is whole, so a job that fails, or is killed, leaves the former one.
import functools
import gc
from pathlib import Path

from snakemake.exceptions import WorkflowError
from snakemake.logging import logger

from hilsplat.base.errors import HilsplatError
from hilsplat.base.processes import jobs_end_with_this_process
from hilsplat.evaluate.tables.build import TABLES, published_values
from hilsplat.workflow import targets
from hilsplat.workflow.jobs import CACHE, RESULTS, any_of
from hilsplat.workflow.plan import Plan
from hilsplat.workflow.resources import JobResources, scene_threads, variant_threads
from hilsplat.workflow.soundness import unsound
from hilsplat.workflow.takeover import take_over
from hilsplat.workflow.wanted import wanted

# The plan of many scenes makes millions of objects that stay: looking through them takes a tenth of its time.
gc.set_threshold(200_000, 50, 100)

try:
    PLAN = Plan(config)
except HilsplatError as error:  # a mistake that a user can fix: no traceback
    raise WorkflowError(str(error)) from None
for name, reason in PLAN.absent.items():
    logger.warning(f"{name} is skipped: {reason}")

jobs_end_with_this_process()


def infeasible():
    """Why jobs on this machine cannot work; empty if they can, or run elsewhere."""
    if workflow.resource_settings.nodes is not None:
        return ""
    try:
        PLAN.require_feasible()
    except HilsplatError as error:
        return str(error)
    return ""


def refuse_infeasible():
    """Called before the first job, so that nothing is touched."""
    if problem := infeasible():
        raise WorkflowError(problem)


def checked(inputs):
    """An input function that first settles, once the DAG exists, which artifacts cannot stay as they are.

    Every job of a scene depends on a rule that takes its inputs through this function.
    """

    def settled(wildcards):
        settle_artifacts()
        return inputs(wildcards)

    return settled


@functools.cache
def settle_artifacts():
    # Snakemake would copy each output aside, and back with a new time: our writers need neither.
    workflow.persistence.backup_output = lambda path: None
    workflow.persistence.restore_output = lambda path: Path(path).exists()
    if not workflow.is_main_process:
        return
    if workflow.dryrun and (problem := infeasible()):
        logger.warning(f"a run would be refused: {problem}")
    if (
        workflow.executor_plugin is not None and not workflow.dryrun
    ):  # not for a report, a plan or a graph
        if notice := take_over(Path(workflow.persistence.path), RESULTS):
            logger.warning(notice)
    triggers = {str(trigger) for trigger in workflow.rerun_triggers}
    wrong = unsound(
        wanted(PLAN),
        CACHE,
        compare_settings="params" in triggers,
        compare_inputs="input" in triggers,
    )
    for output, reason in wrong.items():
        logger.warning(f"{output} is made again: {reason}")
    workflow.dag.forcefiles.update(wrong)  # as --forcerun, for jobs of this run alone


ENVIRONMENT = "../workflow/envs/hilsplat.yaml"

try:
    CORES = workflow.cores
except WorkflowError:  # not set under --report and --lint, which run no jobs
    CORES = 1
# A job of a cluster plans itself again on its node, with the node's cores: `max-threads` is the same there.
MOST_THREADS = workflow.resource_settings.max_threads
RESOURCES = JobResources(PLAN, MOST_THREADS)
THREADS = RESOURCES.threads if MOST_THREADS else scene_threads(PLAN, CORES)
VARIANT_THREADS = RESOURCES.threads if MOST_THREADS else variant_threads(PLAN, CORES)
