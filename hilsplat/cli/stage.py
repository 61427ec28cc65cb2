"""Command groups, options shared by commands, and the log, lock and provenance of each stage."""

import logging
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from hilsplat.base.artifacts import parse_json, provenance_path
from hilsplat.base.atomic import output_lock, require_free_space, was_interrupted
from hilsplat.base.cache import writable
from hilsplat.base.errors import HilsplatError, SettingsError, visible
from hilsplat.base.plugins import load
from hilsplat.base.progress import LOG_FORMAT, LogFormatter
from hilsplat.base.removal import delete
from hilsplat.models.store import model_path
from hilsplat.workflow.stages import STAGES, stage_code

app = typer.Typer(
    help="Turn photographs into a 3D Gaussian scene that answers text queries at three semantic levels.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
world_app = typer.Typer(help="Make and inspect scenes of the synthetic world.", no_args_is_help=True)
models_app = typer.Typer(help="Get, list, check and split models (SAM, CLIP).", no_args_is_help=True)
datasets_app = typer.Typer(help="List, check and export published data sets.", no_args_is_help=True)
cache_app = typer.Typer(help="Show or prune the caches of a results folder.", invoke_without_command=True)
app.add_typer(world_app, name="world")
app.add_typer(models_app, name="models")
app.add_typer(datasets_app, name="datasets")
app.add_typer(cache_app, name="cache")

PathIn = Annotated[Path, typer.Option(help="input artifact", show_default=False)]
PathOut = Annotated[Path, typer.Option(help="output; written atomically", show_default=False)]
Settings = Annotated[str, typer.Option(help="settings as JSON; omitted keys keep their defaults")]
Threads = Annotated[
    int,
    typer.Option(
        min=1,
        callback=lambda number: min(number, MOST_THREADS),
        help="number of threads; does not affect results",
    ),
]
MOST_THREADS = max(16, os.cpu_count() or 1)
"""Maximum number of threads; more would only cost start-up time and memory."""

Memory = Annotated[
    float | None, typer.Option(min=1, help="memory for views in parallel, in MiB; default: all free memory")
]
Seed = Annotated[int, typer.Option(min=0, max=2_000_000_000, help="random seed")]
Cache = Annotated[Path, typer.Option(callback=writable, help="cache folder of finished views, for resuming")]
Results = Annotated[Path, typer.Option(help="results folder")]
DataRoot = Annotated[Path, typer.Option(help="folder of the data sets")]

DEFAULT_CACHE = Path("results/.cache")
MIN_FREE_MIB = 200.0  # minimum free disk space to start a stage


def start_logging(*, timestamps: bool = False) -> None:
    """Send log records to stderr; `timestamps` adds time, level and logger unless stderr is a terminal."""
    root = logging.getLogger()
    root.setLevel(logging.INFO)
    root.handlers.clear()
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LogFormatter(LOG_FORMAT if timestamps and not sys.stderr.isatty() else None))
    root.addHandler(handler)
    for noisy in ("matplotlib", "numba", "PIL", "fontTools", "urllib3"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


def echo(text: object) -> None:
    """Print to stdout; commands print nothing in any other way, because texts from files may be hostile."""
    typer.echo(visible(text))  # noqa: TID251


@contextmanager
def stage(
    name: str,
    out: Path,
    *,
    settings: Any = None,
    seed: int | None = None,
    inputs: Mapping[str, Path | Sequence[Path] | None] | None = None,
    plugins: tuple[str, ...] = (),
    beside: tuple[Path, ...] = (),
) -> Iterator[Any]:
    """Yield a stage's function; a call is logged, locked, checked for disk space and recorded in provenance.

    Args:
        settings: the section that the stage uses, or several sections by name. If a single section has a
            setting `device`, provenance records the device that `auto` resolves to.
        seed: None if the stage is deterministic.
        inputs: name -> file, folder or list of files that the stage reads; None for an input not given.
        plugins: import paths of the readers or baselines that the stage uses (`base.plugins`).

    Raises:
        ArtifactError: an output would replace something other than an earlier output of the stage.
        HilsplatError: an input is missing, or changed while the stage ran.
    """
    from hilsplat.base.lineage import Inputs, write_provenance
    from hilsplat.base.ownership import require_replaceable
    from hilsplat.splat.rasterise.device import choose_device

    start_logging(timestamps=True)
    device = getattr(settings, "device", None)
    given = {key: paths for key, paths in (inputs or {}).items() if paths is not None}
    paths: list[Path] = []
    for each in given.values():
        paths += [each] if isinstance(each, Path) else each
    # A PNG has a PDF beside it, and a field a report; before the first run, such a file is the user's.
    kinds = {".png": ".pdf", ".safetensors": ".report.json"}
    extra = {each.with_suffix(kinds[each.suffix]): each for each in (out, *beside) if each.suffix in kinds}
    is_first = not (provenance_path(out).exists() or was_interrupted(out))
    foreign = [path for path, each in extra.items() if is_first and not each.exists()]
    require_replaceable((out, *beside, *foreign), name, paths)
    require_free_space(out.parent, MIN_FREE_MIB)
    with output_lock(out):
        read, code = Inputs(name, given), stage_code(name, plugins)
        yield load(STAGES[name])
        try:
            read.require_unchanged()
        except HilsplatError:
            delete(provenance_path(out), r".+\.provenance\.json")  # so that the output is rebuilt
            raise
        write_provenance(
            out,
            stage=name,
            code=code,
            command=_command(),
            settings=_recorded(settings),
            seed=seed,
            inputs=read,
            beside=(*beside, *filter(Path.exists, extra)),
            plugins=plugins,
            device=None if device is None else choose_device(device),
        )


def _command() -> list[str]:
    """Return the command line without `--log`, so that a copied command prints to the terminal."""
    words = ["hilsplat", *sys.argv[1:]]
    return words[:1] + words[3:] if words[1:2] == ["--log"] else words


def _recorded(settings: Any) -> dict[str, Any]:
    if isinstance(settings, dict):
        return {name: _recorded(section) for name, section in settings.items()}
    return settings.model_dump(mode="json") if settings is not None else {}


def section_of(name: str, text: str) -> Any:
    """Parse one section of the settings from JSON, and replace `auto` with the installed models."""
    from hilsplat.configuration import parse_section, with_models

    return with_models(parse_section(name, text))


def model_input(section: Any) -> dict[str, Path]:
    """Return a section's model folder as an input, or {} if it is missing (the stage reports the error)."""
    folder = model_path(section.model)
    return {"model": folder} if folder.is_dir() else {}


def json_option(option: str, text: str, kind: type) -> Any:
    """Parse a JSON option that must be a list or dict of strings; raise SettingsError otherwise."""
    try:
        value = parse_json(text)
    except ValueError as error:
        raise SettingsError(f"{option} is not JSON: {error}", found=text[:80]) from error
    texts = value.values() if isinstance(value, dict) else value
    if not isinstance(value, kind) or not all(isinstance(each, str) for each in texts):
        raise SettingsError(f"{option} is not a JSON {kind.__name__} of strings", found=text[:80])
    return value
