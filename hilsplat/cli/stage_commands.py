"""Commands of the stages, derived from their signatures (`hilsplat.stages`)."""

import inspect
from collections.abc import Callable
from typing import Annotated, Any, get_args, get_origin

import typer
from pydantic import TypeAdapter

from hilsplat.base.artifacts import parse_json
from hilsplat.base.errors import SettingsError, first_line
from hilsplat.base.plugins import entry_points
from hilsplat.cli.common import app, cache_app, datasets_app, echo, models_app, start_logging
from hilsplat.configuration import parse_section, resolve_auto
from hilsplat.stage import Stage, metadata_of
from hilsplat.stages import all_stages

JSON_HELP = "settings as JSON; omitted keys keep their defaults"

GROUPS: dict[str, typer.Typer] = {"models": models_app, "datasets": datasets_app, "cache": cache_app}
"""Groups of commands by name, including those of plugins."""


def command_of(stage: Stage[..., Any]) -> Callable[..., None]:
    """Return a stage's command: it parses settings and JSON, and prints the result."""
    names, function = {**stage.sections, **dict.fromkeys(stage.json)}, inspect.unwrap(stage.function)
    unused = {  # rules pass these to all stages
        name: Annotated[float | None, typer.Option(hidden=True)]
        for name in ("threads", "memory")
        if name not in stage.hints
    }

    def command(**options: Any) -> None:
        values = {name: value for name, value in options.items() if name not in unused}
        for name, section in stage.sections.items():
            values[name] = resolve_auto(parse_section(section, values[name]))
        for name in stage.json:
            values[name] = _json_of(name, values[name], stage.hints[name])
        start_logging(timestamps=True)
        result = stage(**values)
        if result is not None:
            echo(result)

    hints: dict[str, Any] = {name: hint for name, hint in stage.hints.items() if name not in names}
    hints |= {name: Annotated[str, typer.Option(help=JSON_HELP)] for name in stage.sections}
    hints |= {name: Annotated[str, _option_of(stage.hints[name])] for name in stage.json}
    hints |= unused
    defaults = {name: parameter.default for name, parameter in inspect.signature(function).parameters.items()}
    defaults |= dict.fromkeys(stage.sections, "{}") | dict.fromkeys(unused)
    defaults |= {
        name: "[]" if get_origin(get_args(stage.hints[name])[0]) is list else "{}" for name in stage.json
    }
    command.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=defaults[name], annotation=hint)
            for name, hint in hints.items()
        ]
    )
    command.__annotations__ = hints
    command.__doc__ = function.__doc__
    return command


def _option_of(hint: Any) -> Any:
    return next(value for value in metadata_of(hint) if isinstance(value, type(typer.Option())))


def _json_of(name: str, text: str, hint: Any) -> Any:
    """Parse a JSON option; raise SettingsError if the value doesn't have the type of the hint."""
    try:
        return TypeAdapter(get_args(hint)[0]).validate_python(parse_json(text), strict=True)
    except ValueError as error:
        problem = f"--{name.replace('_', '-')} is not JSON of type {get_args(hint)[0]}: {first_line(error)}"
        raise SettingsError(problem, found=text[:80]) from error


for _name, _group in entry_points("hilsplat.commands", typer.Typer).items():
    app.add_typer(_group, name=_name)
    GROUPS[_name] = _group
for _stage in all_stages().values():
    if _stage.command:
        *_words, _last = _stage.command.split()
        (GROUPS[_words[0]] if _words else app).command(_last)(command_of(_stage))
