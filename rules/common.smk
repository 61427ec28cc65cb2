# Shared by all rules: the plan of the run (hilsplat/workflow/plan.py), threads, and the environment.
#
# Priorities lead to a scene's first answer: of the jobs that could start, the nearest to its semantic tree is
# first, and fields, scores and pictures come after all trees. Gaussians are before masks: they can be looked at.
import json
from pathlib import Path

from snakemake.exceptions import WorkflowError
from snakemake.logging import logger

from hilsplat.base.errors import HilsplatError
from hilsplat.evaluate.tables.build import TABLES
from hilsplat.workflow.plan import Plan, any_of

try:
    PLAN = Plan(config)
except HilsplatError as error:  # a mistake that a user can fix: no traceback
    raise WorkflowError(str(error)) from None
for name, reason in PLAN.absent.items():
    logger.warning(f"{name} is skipped: {reason}")

ENVIRONMENT = "../workflow/envs/hilsplat.yaml"

try:
    CORES = workflow.cores
except WorkflowError:  # not set under --report and --lint, which run no jobs
    CORES = 1
THREADS = PLAN.threads(CORES)
