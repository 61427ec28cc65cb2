"""What surrounds every command: options, log, lock, disk space, provenance."""

import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from hilsplat.base.artifacts import output_lock, parse_json, require_free_space
from hilsplat.base.errors import HilsplatError, SettingsError, place_error
from hilsplat.base.progress import in_run, share_told
from hilsplat.workflow.stages import stage_code

PathIn = Annotated[Path, typer.Option(help="input artifact", show_default=False)]
PathOut = Annotated[Path, typer.Option(help="output; written atomically", show_default=False)]
Settings = Annotated[
    str, typer.Option(help="settings of the stage as JSON; missing keys take their defaults")
]
Threads = Annotated[int, typer.Option(min=1, help="number of threads; results do not depend on it")]
Memory = Annotated[
    float | None,
    typer.Option(
        min=1, help="memory for views at once, MiB; default: what is free; results do not depend on it"
    ),
]
Seed = Annotated[int, typer.Option(min=0, max=2_000_000_000, help="seed for everything random")]
Log = Annotated[Path | None, typer.Option(help="also write the log to this file")]
Cache = Annotated[Path, typer.Option(help="folder of the caches of finished views, for resuming")]
Results = Annotated[Path, typer.Option(help="results folder")]
DataRoot = Annotated[Path, typer.Option(help="folder that holds the data sets")]

DEFAULT_CACHE = Path("results/.cache")
MIN_FREE_MIB = 200.0
"""A stage does not start with less free space than this."""


def start_logging(log: Path | None) -> None:
    """Send log records to the terminal (short) and, if given, to a file (with times).

    A run that shows the progress leaves warnings and errors to the terminal; the file has everything.
    """
    root = logging.getLogger()
    root.setLevel(logging.INFO)
    root.handlers.clear()
    terminal = logging.StreamHandler(sys.stderr)
    clear_line = "\r\033[K" if in_run() and sys.stderr.isatty() else ""  # the run's own line is there
    terminal.setFormatter(logging.Formatter(f"{clear_line}%(message)s"))
    if in_run() and log is not None:
        terminal.setLevel(logging.WARNING)
    root.addHandler(terminal)
    if log is not None:
        try:
            log.parent.mkdir(parents=True, exist_ok=True)
            log.touch()
        except OSError as error:
            raise place_error(error) or error from None
        file = logging.FileHandler(log, mode="w", encoding="utf-8")
        file.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
        root.addHandler(file)
    for noisy in ("matplotlib", "numba", "PIL", "fontTools", "urllib3"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


@contextmanager
def stage(
    name: str,
    out: Path,
    log: Path | None,
    *,
    settings: Any = None,
    seed: int | None = None,
    threads: int = 1,
    inputs: dict[str, Path] | None = None,
    plugins: tuple[str, ...] = (),
    beside: tuple[Path, ...] = (),
) -> Iterator[None]:
    """Everything around a stage's one function call: log, lock, disk space, provenance.

    `settings` is the section that the stage takes, or several by name; `plugins` are the places of the
    readers or baselines that it uses (`base.plugins`); `beside` is what it writes besides `out`.
    """
    from hilsplat.base.provenance import write_provenance

    start_logging(log)
    os.environ["NUMBA_NUM_THREADS"] = str(max(threads, int(os.environ.get("NUMBA_NUM_THREADS", "1"))))
    try:
        for what, path in (inputs or {}).items():
            if not path.exists():
                raise HilsplatError(
                    f"{name}: input {what} is missing: {path}", fix="run the stage that writes it"
                )
        require_free_space(out.parent, MIN_FREE_MIB)
        with output_lock(out), share_told(log):
            yield
            write_provenance(
                out,
                stage=name,
                code=stage_code(name, plugins),
                command=["hilsplat", *sys.argv[1:]],
                settings=_recorded(settings),
                seed=seed,
                inputs=inputs or {},
                beside=beside,
                plugins=plugins,
            )
    except HilsplatError:
        raise
    except Exception as error:  # a bug of ours: the traceback belongs in the log
        if isinstance(error, OSError) and (told := place_error(error)) is not None:
            raise told from error
        logging.getLogger("hilsplat").exception("%s failed on %s", name, out)
        sys.exit(1)


def _recorded(settings: Any) -> dict[str, Any]:
    """Settings as provenance records them."""
    if isinstance(settings, dict):
        return {name: _recorded(section) for name, section in settings.items()}
    return settings.model_dump(mode="json") if settings is not None else {}


def section_of(name: str, text: str) -> Any:
    """One section of the settings, from JSON; `auto` becomes the models that are there."""
    from hilsplat.configuration import parse_section, with_models

    return with_models(parse_section(name, text))


def model_input(section: Any) -> dict[str, Path]:
    """The model folder of a section as an input; a missing one is for the stage to report."""
    folder = Path(section.model)
    return {"model": folder} if folder.is_dir() else {}


def json_option(option: str, text: str, kind: type) -> Any:
    """An option that holds JSON: a list of texts, or texts by name.

    Raises:
        SettingsError: it is not JSON, or holds something else.
    """
    try:
        value = parse_json(text)
    except ValueError as error:
        raise SettingsError(f"{option} is not JSON: {error}", found=text[:80]) from error
    texts = value.values() if isinstance(value, dict) else value
    if not isinstance(value, kind) or not all(isinstance(each, str) for each in texts):
        raise SettingsError(f"{option} is not a {kind.__name__} of texts, as JSON", found=text[:80])
    return value
