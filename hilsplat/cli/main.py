"""The `hilsplat` command: one subcommand per stage, and user commands for scenes and models.

Commands import heavy libraries only when they run.
"""

import gc
import logging
import os
import signal
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

gc.set_threshold(50_000)  # imports create many permanent objects, which are not searched for garbage so often

_interrupt = signal.getsignal(signal.SIGINT)
if _interrupt is signal.default_int_handler:  # until all is imported, Ctrl-C would print a traceback
    signal.signal(signal.SIGINT, signal.SIG_DFL)

# The summation order of linear algebra libraries depends on the number of threads. Stages therefore run on
# several cores through numba or our own pools, where the number of cores does not affect results.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
os.environ["MPLBACKEND"] = "agg"
os.environ["PYTHONSAFEPATH"] = "1"  # processes that we start import no module from the working folder
warnings.filterwarnings("ignore", "Glyph .* missing from font")  # pictures show boxes instead of such letters
# These variables break our loops or change results.
for _name in ("NUMBA_DISABLE_JIT", "NUMBA_NUM_THREADS", "NUMBA_OPT"):
    os.environ.pop(_name, None)

# Otherwise, a file would get the number of a stream that is closed (cron, daemons), and receive its output.
for _number in range(3):
    try:
        os.set_inheritable(_number, True)
    except OSError:
        os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
sys.stdout = sys.stdout or open(1, "w", closefd=False)  # noqa: SIM115
sys.stderr = sys.stderr or open(2, "w", closefd=False)  # noqa: SIM115

import typer  # noqa: E402

from hilsplat.base.cache import use_writable_cache  # noqa: E402
from hilsplat.base.errors import (  # noqa: E402
    HilsplatError,
    is_interruption,
    require_working_directory,
    system_error,
)
from hilsplat.base.processes import end_with_workflow, keep_freed_memory  # noqa: E402
from hilsplat.cli.common import app, echo, sort_into_panels, start_logging  # noqa: E402


@contextmanager
def _reported() -> Iterator[None]:
    """Exit if the block fails; for errors that the user can fix, print a message without a traceback."""
    try:
        yield
    except Exception as error:
        if is_interruption(error):
            sys.exit(130)
        message = system_error(error)
        if message is None and sys.gettrace() is not None:  # for post-mortem debugging
            raise
        if not logging.getLogger().handlers:  # the commands could not be imported
            start_logging()
        logging.getLogger("hilsplat").error("%s", message or "unexpected error", exc_info=message is None)
        sys.exit(1)


with _reported():  # plugins may be broken
    from hilsplat.cli import group_commands, scene_commands, stage_commands, user_commands  # noqa: F401

    sort_into_panels()
if _interrupt is signal.default_int_handler:
    signal.signal(signal.SIGINT, _interrupt)


def main() -> None:
    """Run the command."""
    end_with_workflow()
    keep_freed_memory()
    try:
        with _reported():
            require_working_directory()
            start_logging()
            use_writable_cache()
            app()
            sys.stdout.flush()
    finally:  # otherwise, garbage-collecting numba and matplotlib objects at exit takes 0.4 s
        gc.freeze()


@app.callback(invoke_without_command=True)
def options(
    version: Annotated[bool, typer.Option("--version", help="print the version and exit")] = False,
    log: Annotated[Path | None, typer.Option(help="write stdout and stderr to this file")] = None,
) -> None:
    """Handle the options that precede a command."""
    if log is not None:
        if log.suffix != ".log" and log.is_file() and log.stat().st_size:
            raise HilsplatError(
                f"--log {log} exists and is not a .log file", fix="choose a new file, or a .log file"
            )
        log.parent.mkdir(parents=True, exist_ok=True)
        file = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o666)
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
            os.dup2(file, stream.fileno())  # also redirects libraries that print to the file descriptor
    start_logging()
    if version:
        from hilsplat.base.lineage import version_of

        echo(f"hilsplat {version_of('hilsplat') or 'not installed'}")
        raise typer.Exit
