# The progress of a run (hilsplat/workflow/run_progress.py), in place of Snakemake's block of lines per job.
import os

from hilsplat.base.progress import IN_RUN
from hilsplat.workflow.job_times import earlier_ratios, planned_job
from hilsplat.workflow.run_progress import ProgressHandler, RunProgress, stream_handler
from hilsplat.workflow.time_left import Pace


def show_progress():
    """Show the progress of the jobs that are about to run; with --quiet, --verbose or --logger, do nothing."""
    terminal, settings = stream_handler(logger.handlers), workflow.output_settings
    if terminal is None or settings.quiet or settings.verbose:
        return
    dag = workflow.dag
    needed = {job: dag.jobid(job) for job in dag.needrun_jobs() if job.shellcmd}
    jobs = [
        planned_job(
            PLAN,
            number,
            job.rule.name,
            job.wildcards_dict,
            threads=job.threads,
            priority=job.priority,
            after=[needed[other] for other in dag.dependencies[job] if other in needed],
            benchmark=job.benchmark,
            log=next(iter(job.log), None),
        )
        for job, number in needed.items()
    ]
    # A cluster takes all that can start.
    cores = CORES if workflow.local_exec else sum(job.threads for job in jobs)
    run = RunProgress(
        jobs, Pace(earlier_ratios(PLAN, scene_threads(PLAN, CORES))), cores
    )
    logger.removeHandler(terminal)
    logger.addHandler(ProgressHandler(run, terminal))
    os.environ[IN_RUN] = "1"
