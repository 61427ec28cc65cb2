"""Snakemake logger plugin that shows the progress of a run instead of Snakemake's block of lines per job.

`profiles/default` enables it. With --verbose, --quiet or another --logger, Snakemake's own output is
unchanged. A dry run prints a line per job, and a table that estimates the run's time and memory.
"""

import logging
import sys

from snakemake_interface_logger_plugins.base import LogHandlerBase

from hilsplat.base.errors import visible
from hilsplat.workflow.estimate import RunEstimate
from hilsplat.workflow.progress import PLANNED, ProgressDisplay, RunProgress, estimates, is_shown


class LogHandler(LogHandlerBase):
    """Handler of Snakemake's log records; Snakemake's own filter and formatter apply."""

    writes_to_stream = True
    writes_to_file = False
    has_filter = False
    has_formatter = False
    needs_rulegraph = False

    def __post_init__(self) -> None:
        settings = self.common_settings
        self.stream = sys.stdout if settings.stdout else sys.stderr
        unchanged = settings.dryrun or settings.verbose or settings.quiet
        self.display = None if unchanged else ProgressDisplay(self.stream, self.format, RunProgress())
        self.is_dry = settings.dryrun and not settings.quiet
        estimates.is_dry = settings.dryrun
        self.estimate: RunEstimate | None = None

    def emit(self, record: logging.LogRecord) -> None:
        """Show a record."""
        try:
            if self.display is not None:
                self.display.show(record)
            elif text := self._text(record):
                print(visible(text), file=self.stream, flush=True)
            if self.is_dry and getattr(record, "event", None) == "job_info":
                self._count(record)
        except Exception:
            self.handleError(record)

    def _text(self, record: logging.LogRecord) -> str:
        """Return what is printed for a record of a run without a progress line; empty for nothing."""
        event, facts = getattr(record, "event", None), record.__dict__
        if not self.is_dry or self.common_settings.verbose or event in PLANNED or is_shown(record):
            return self.format(record)
        if event != "job_info":
            return ""
        places, reason = "/".join(facts["wildcards"].values()), facts["reason"].partition(": ")[0]
        return ": ".join(filter(None, [f"rule {facts['rule_name']}", places, reason]))

    def _count(self, record: logging.LogRecord) -> None:
        """Add a job to the estimate of a dry run; the Snakefile has already set the plan."""
        if self.estimate is None and estimates.resources is not None:
            self.estimate = RunEstimate(estimates.resources)
        if self.estimate is not None:
            facts = record.__dict__
            memory = facts["resources"].get("mem_mb", 0)
            self.estimate.add(facts["rule_name"], dict(facts["wildcards"]), memory)

    def close(self) -> None:
        """Remove the progress line, or print the table of a dry run."""
        if self.estimate is not None:
            for line in self.estimate.lines():
                print(line, file=self.stream, flush=True)
            self.estimate = None
        if self.display is not None:
            self.display.close()
        super().close()
