"""Snakemake logger plugin: the progress of a run in place of Snakemake's block of lines per job.

`profiles/default` switches it on. With --verbose, --quiet, --dry-run or another --logger, Snakemake's own
output remains.
"""

import logging
import sys

from snakemake_interface_logger_plugins.base import LogHandlerBase

from hilsplat.workflow.progress import ProgressDisplay, RunProgress


class LogHandler(LogHandlerBase):
    """Shows log records of Snakemake; Snakemake's own filter and formatter apply."""

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

    def emit(self, record: logging.LogRecord) -> None:
        """Show a record."""
        try:
            if self.display is not None:
                self.display.show(record)
            elif text := self.format(record):
                print(text, file=self.stream, flush=True)
        except Exception:
            self.handleError(record)

    def close(self) -> None:
        """Remove the line of progress."""
        if self.display is not None:
            self.display.close()
        super().close()
