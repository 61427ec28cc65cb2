"""What a stage is: a function with typed inputs, settings and outputs, whose calls are locked and recorded.

`hilsplat.stages` lists all stages. A stage's inputs, settings and outputs are those of its function's
signature, by the types below; commands, parameters of rules, digests of code and provenance derive from it.
"""

import hashlib
import inspect
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Generic, Literal, NamedTuple, ParamSpec, TypeVar, get_args, get_type_hints

import typer

from hilsplat.base.artifacts import provenance_path
from hilsplat.base.atomic import output_lock, require_free_space, was_interrupted
from hilsplat.base.cache import writable
from hilsplat.base.code import code_digest, imports_of, modules_of, statements_of
from hilsplat.base.errors import HilsplatError
from hilsplat.base.lineage import RASTERISER, Inputs, write_provenance
from hilsplat.base.ownership import require_replaceable
from hilsplat.base.removal import delete
from hilsplat.configuration import SECTIONS, StageSettings
from hilsplat.models.store import model_path
from hilsplat.settings import LARGEST, Section


class Role(Enum):
    """Role of a parameter: a path that is read, a path that is written, or a value given as JSON."""

    INPUT = "input"
    OUTPUT = "output"
    JSON = "json"


DEFAULT_CACHE = Path("results/.cache")
MAX_THREADS = max(16, os.cpu_count() or 1)
"""Maximum number of threads; more would only cost start-up time and memory."""
MIN_FREE_MIB = 200.0  # minimum free disk space to start a stage

PathIn = Annotated[Path, typer.Option(help="input artifact", show_default=False), Role.INPUT]
PathOut = Annotated[Path, typer.Option(help="output; written atomically", show_default=False), Role.OUTPUT]
Threads = Annotated[
    int,
    typer.Option(
        min=1,
        callback=lambda number: min(number, MAX_THREADS),
        help="number of threads; does not affect results",
    ),
]
Memory = Annotated[
    float | None, typer.Option(min=1, help="memory that the stage may use, in MiB; default: all free memory")
]
Seed = Annotated[int, typer.Option(min=0, max=LARGEST + 10, help="random seed")]
Cache = Annotated[Path, typer.Option(callback=writable, help="cache folder of finished views, for resuming")]
DataRoot = Annotated[Path, typer.Option(help="folder of the data sets")]

P = ParamSpec("P")
R = TypeVar("R")
Paths = Path | Sequence[Path]


class Reads(NamedTuple):
    """Inputs of a call that are not parameters, and the import paths of plugins that it uses."""

    inputs: Mapping[str, Paths] = {}
    plugins: tuple[str, ...] = ()


@dataclass(frozen=True)
class Facts:
    """What decides which stage makes an artifact of a scene's variant."""

    settings: StageSettings
    is_imported: bool = False  # the scene has masks and CLIP vectors of LangSplat
    is_refined: bool = False  # key views answer queries before all photographs have masks


@dataclass(frozen=True, eq=False)
class Stage(Generic[P, R]):
    """A stage; calling it runs its function, and locks and records the output.

    Attributes:
        artifact: name of the output; stages with an input of this name read it.
        file: name of the output's file or folder.
        command: words of the command after `hilsplat`; empty if none is derived.
        scope: number of outputs: one per run, per scene, or per variant of a scene.
        when: condition under which this stage makes the artifact, if several can; the first match counts.
        beside: further outputs, given the output.
        reads: further inputs of a call, given its arguments.
        loop: the loop (`base.progress.track`) that takes almost all of the time.
    """

    function: Callable[P, R]
    name: str
    artifact: str
    file: str
    command: str
    scope: Literal["run", "scene", "variant"] = "variant"
    when: Callable[[Facts], bool] | None = None
    beside: Callable[[Path], tuple[Path, ...]] = lambda out: ()
    reads: Callable[[Mapping[str, Any]], Reads] = lambda arguments: Reads()
    loop: str = ""

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> R:
        """Run the stage.

        Raises:
            ArtifactError: an output would replace something other than an earlier output of the stage.
            HilsplatError: an input is missing, or changed while the stage ran.
        """
        bound = inspect.signature(self.function).bind(*args, **kwargs)
        bound.apply_defaults()
        with _recorded(self, bound.arguments):
            return self.function(*bound.args, **bound.kwargs)

    @cached_property
    def hints(self) -> dict[str, Any]:
        """Annotation of each parameter."""
        hints = get_type_hints(inspect.unwrap(self.function), include_extras=True)
        return {name: hint for name, hint in hints.items() if name != "return"}

    def _with(self, role: Role) -> list[str]:
        return [name for name, hint in self.hints.items() if role in metadata_of(hint)]

    @cached_property
    def inputs(self) -> list[str]:
        """Names of the parameters that are paths of inputs; those of artifacts are named like these."""
        return self._with(Role.INPUT)

    @cached_property
    def needs(self) -> list[str]:
        """Names of the inputs that are not optional."""
        parameters = inspect.signature(self.function).parameters
        return [name for name in self.inputs if parameters[name].default is inspect.Parameter.empty]

    @cached_property
    def outputs(self) -> list[str]:
        """Names of the parameters that are paths of outputs, `out` first."""
        return sorted(self._with(Role.OUTPUT), key=lambda name: name != "out")

    @cached_property
    def json(self) -> list[str]:
        """Names of the parameters that commands take as JSON, besides settings."""
        return self._with(Role.JSON)

    @cached_property
    def arguments(self) -> list[str]:
        """Names of the parameters that commands take without an option's name."""
        argument = type(typer.Argument())
        return [
            name
            for name, hint in self.hints.items()
            if any(isinstance(value, argument) for value in metadata_of(hint))
        ]

    @cached_property
    def sections(self) -> dict[str, str]:
        """Section of the settings of each parameter that is one."""
        classes = {
            name: hint
            for name, hint in self.hints.items()
            if isinstance(hint, type) and issubclass(hint, Section)
        }
        names = {cls: section for section, cls in SECTIONS.items()}
        return {name: names[cls] for name, cls in classes.items()}

    def modules(self) -> list[str]:
        """Return the modules that the function imports, directly or not."""
        return modules_of(*imports_of(self.function))

    def code_digest(self, plugins: Sequence[str] = ()) -> str:
        """Return the digest of the function, its modules, and the plugins that a call uses."""
        text = statements_of(self.function) + code_digest(*imports_of(self.function), *plugins)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass
class Registry:
    """Stages by name, in the order of the data flow."""

    stages: dict[str, Stage[..., Any]] = field(default_factory=dict)

    def stage(
        self, *, artifact: str = "", file: str = "", command: str | None = None, **facts: Any
    ) -> Callable[[Callable[P, R]], Stage[P, R]]:
        """Register a function as a stage, with the attributes of `Stage`; names default to its own."""

        def register(function: Callable[P, R]) -> Stage[P, R]:
            name = function.__name__
            stage = Stage(
                function,
                name,
                artifact or name,
                file or artifact or name,
                name.replace("_", "-") if command is None else command,
                **facts,
            )
            self.stages[name] = stage
            return stage

        return register


def metadata_of(hint: Any) -> tuple[Any, ...]:
    """Return what a hint is annotated with, also if it is a part of a union with None."""
    metadata = getattr(hint, "__metadata__", ())
    return metadata or tuple(value for part in get_args(hint) for value in getattr(part, "__metadata__", ()))


@contextmanager
def _recorded(stage: Stage[..., Any], arguments: Mapping[str, Any]) -> Iterator[None]:
    """Lock the output, check inputs and disk space, and write provenance when the call ends."""
    sections = {section: arguments[name] for name, section in stage.sections.items()}
    given = {name: arguments[name] for name in stage.inputs if arguments[name] is not None}
    named = [model_path(section.model) for section in sections.values() if section.uses_model]
    models = [folder for folder in named if folder.is_dir()]  # the stage reports a missing folder
    extra = stage.reads(arguments)
    inputs = {**given, **dict(zip(["model"], models, strict=False)), **extra.inputs}
    out = arguments["out"]
    beside = (*(arguments[name] for name in stage.outputs[1:]), *stage.beside(out))
    # A picture has a PDF beside it, and a field a report; before the first run, such a file is the user's.
    endings = {".png": ".pdf", ".webp": ".pdf", ".safetensors": ".report.json"}
    side_files = {
        path.with_suffix(endings[path.suffix]): path for path in (out, *beside) if path.suffix in endings
    }
    is_first = not (provenance_path(out).exists() or was_interrupted(out))
    new = [file for file, path in side_files.items() if is_first and not path.exists()]
    paths = [path for value in inputs.values() for path in ([value] if isinstance(value, Path) else value)]
    require_replaceable((out, *beside, *new), stage.name, paths)
    require_free_space(out.parent, MIN_FREE_MIB)
    with output_lock(out, *beside, *new):
        RASTERISER.set(None)
        before, code = Inputs(stage.name, inputs), stage.code_digest(extra.plugins)
        yield
        try:
            before.require_unchanged()
        except HilsplatError:
            delete(provenance_path(out), r".+\.provenance\.json")  # so that the output is rebuilt
            raise
        write_provenance(
            out,
            stage=stage.name,
            code=code,
            command=_command(),
            settings={name: section.model_dump(mode="json") for name, section in sections.items()},
            seed=arguments.get("seed"),
            inputs=before,
            beside=(*beside, *filter(Path.exists, side_files)),
            plugins=extra.plugins,
        )


def _command() -> list[str]:
    """Return the command line without `--log`, so that a copied command prints; nothing in other programs."""
    if "hilsplat.cli.main" not in sys.modules:
        return []
    words = ["hilsplat", *sys.argv[1:]]
    return words[:1] + words[3:] if words[1:2] == ["--log"] else words
