"""The configuration of a run: settings of each stage, variants, seeds, scenes and tables."""

import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

import yaml
from pydantic import BaseModel, Field, ValidationError, create_model, field_validator
from pydantic.fields import FieldInfo

from hilsplat import settings
from hilsplat.base.artifacts import parse_json
from hilsplat.base.errors import SettingsError, nearest
from hilsplat.base.files import NAME_RULE, name_problem, project_path, regular
from hilsplat.base.levels import path_of
from hilsplat.base.plugins import entry_points
from hilsplat.baselines import MethodSettings, own_settings, settings_class
from hilsplat.models.store import AUTO, EMBEDDED, read_model, real_model
from hilsplat.settings import LARGEST, Section, knob

CONFIG = Path("config/config.yaml")
"""The project's configuration; files given with `--configfile` override it."""

MAX_SHOWN = 120  # maximum number of characters of a value in a message


class CoreSettings(Section):
    """The sections of the pipeline by name; plugins add their own."""

    poses: settings.PosesSettings = Field(default_factory=settings.PosesSettings)
    gaussians: settings.GaussiansSettings = Field(default_factory=settings.GaussiansSettings)
    masks: settings.MasksSettings = Field(default_factory=settings.MasksSettings)
    coverage_tree: settings.CoverageTreeSettings = Field(default_factory=settings.CoverageTreeSettings)
    clip: settings.ClipSettings = Field(default_factory=settings.ClipSettings)
    contributions: settings.ContributionsSettings = Field(default_factory=settings.ContributionsSettings)
    semantic_tree: settings.SemanticTreeSettings = Field(default_factory=settings.SemanticTreeSettings)
    autoencoder: settings.AutoencoderSettings = Field(default_factory=settings.AutoencoderSettings)
    field: settings.FieldSettings = Field(default_factory=settings.FieldSettings)
    method: MethodSettings = Field(default_factory=MethodSettings)
    evaluate: settings.EvaluateSettings = Field(default_factory=settings.EvaluateSettings)
    query: settings.QuerySettings = Field(default_factory=settings.QuerySettings)
    figures: settings.FiguresSettings = Field(default_factory=settings.FiguresSettings)

    @field_validator("method", mode="before")
    @classmethod
    def _of_named_method(cls, value: Any) -> Any:
        return value if isinstance(value, MethodSettings) else validated("method", value)

    def resolve_auto(self) -> "CoreSettings":
        """Return all sections after resolving values that depend on others: models, crops, theta."""
        clip, masks = resolve_auto(self.clip), resolve_auto(self.masks)
        if masks.levels == "tree" and masks.theta is None:
            masks = masks.model_copy(update={"theta": self.coverage_tree.theta})
        if clip.crops == AUTO:
            crops = "masks" if self.autoencoder.targets == "mask" else "nodes"
            clip = clip.model_copy(update={"crops": crops})
        return self.model_copy(update={"masks": masks, "clip": clip})


_PLUGIN_SECTIONS: dict[str, type[Section]] = dict(
    entry_points("hilsplat.settings", Section, tuple(CoreSettings.__annotations__))
)

if TYPE_CHECKING:
    StageSettings = CoreSettings
else:
    _fields = {name: (section, Field(default_factory=section)) for name, section in _PLUGIN_SECTIONS.items()}
    StageSettings = create_model("StageSettings", __base__=CoreSettings, **_fields)


SECTIONS: dict[str, type[Section]] = _PLUGIN_SECTIONS | CoreSettings.__annotations__
"""Section -> its class; those of plugins first, because they make what the pipeline reads."""


def parse_section(name: str, text: str) -> Any:
    """Parse a section from JSON; raise SettingsError if a key is unknown or a value is invalid."""
    try:
        values = parse_json(text or "{}")
    except ValueError as error:
        raise SettingsError(f"{name}: the settings are not valid JSON: {error}", found=text[:80]) from error
    return validated(name, values)


def validated(name: str, values: Any, where: str = "") -> Any:
    """Validate a section, that of the named method for `method`; `where` is its place, if not at the top."""
    section = settings_class(values) if name == "method" else SECTIONS[name]
    try:
        return section.model_validate(values)
    except ValidationError as error:
        raise settings_error(error, where or name, section) from error


Settings = TypeVar("Settings", bound=Section)


def resolve_auto(section: Settings) -> Settings:
    """Replace `auto` in a section with existing models, so that records name the models that were used.

    `masks.segmenter: auto` selects the SAM model in `masks.model` or, if that is also auto, the best
    pretrained SAM; if there is none, the graph segmenter. `masks.model: auto` and `clip.model: auto`
    select the best pretrained model, else the embedded one. Other sections are returned unchanged.
    """
    if isinstance(section, settings.ClipSettings) and section.model == AUTO:
        return section.model_copy(update={"model": str(real_model("clip") or EMBEDDED["clip"])})
    if isinstance(section, settings.MasksSettings) and AUTO in (section.segmenter, section.model):
        named = section.model != AUTO
        folder = Path(section.model) if named else real_model("sam") or Path(EMBEDDED["sam"])
        segmenter = section.segmenter
        if segmenter == AUTO:  # if a named folder is missing, the stage reports it
            model = read_model(folder)
            is_real = not model.embedded if model else named
            segmenter = "sam" if is_real else "graph"
        return section.model_copy(update={"segmenter": segmenter, "model": str(folder)})
    return section


def settings_error(error: ValidationError, where: str, model: type[BaseModel]) -> SettingsError:
    """Convert pydantic's error to one line per key: location, problem, and allowed or found values."""
    lines = []
    for problem in error.errors():
        path = [str(part) for part in problem["loc"]]
        key = ".".join([where, *path] if where else path)
        if problem["type"] == "extra_forbidden":
            section: Any = model
            for part in path[:-1]:
                section = section.model_fields[part].annotation
            lines.append(f"{key}: unknown key; {nearest(path[-1], sorted(section.model_fields))}")
        else:
            found = json.dumps(problem.get("input"), default=str)
            found = found if len(found) <= MAX_SHOWN else f"{found[:MAX_SHOWN]}..."
            lines.append(f"{key}: {problem['msg']}; found {found}")
    return SettingsError("the settings are not valid:\n  " + "\n  ".join(lines))


RESERVED = ("annotations", "benchmarks", "export", "gaussians", "logs", "queries", "scene", "source")
"""Names of files and folders in a scene folder; a variant cannot have such a name."""

SEEDED = re.compile(r"(.+)\.seed([0-9]+)")
"""Name of a variant with a seed other than the first: the variant and the seed's number."""


class RunSettings(StageSettings):
    """The whole configuration: what to run, and the settings to use."""

    seed: int = knob(0, "random seed", ge=0)
    scenes: str = knob("config/scenes.tsv", "scene sheet, relative to the project")
    results: str = knob("results", "results folder, relative to the working folder", pattern="^[^{}<>]+$")
    groups: tuple[str, ...] = knob(("benchmark",), "groups of the scene sheet to run")
    only: tuple[str, ...] = knob(
        (), "scenes to run, from any group, such as table-1 or synthetic/*; empty: all in `groups`"
    )
    # The report shows the data root without escaping < and >, so these are not allowed.
    data_root: str = knob("", "folder of published data sets; empty: no published scenes", pattern="^[^<>]*$")
    main_variants: tuple[str, ...] = knob(("default",), "variants in the main tables")
    ablation_variants: tuple[str, ...] = knob((), "variants in the paper's ablation table")
    component_variants: tuple[str, ...] = knob((), "variants in the components table, our own ablation")
    theta_variants: tuple[str, ...] = knob((), "variants in the sweep over theta")
    omega_variants: tuple[str, ...] = knob((), "variants in the sweep over Omega")
    pruning_variants: tuple[str, ...] = knob((), "variants in the pruning tables")
    sweep_scenes: tuple[str, ...] = knob(
        (), "scenes in ablation, sweep and pruning tables; empty: all tabletop and photographed scenes"
    )
    seeds: int = knob(1, "number of training seeds; if above 1, tables report mean and spread", ge=1, le=10)
    ablation_seeds: int = knob(1, "the same for the paper's ablation table, if above `seeds`", ge=1, le=10)
    variants: dict[str, dict[str, dict[str, Any]]] = knob(
        {}, "named overrides: variant -> section -> setting -> value; 'default' always exists"
    )
    labels: dict[str, str] = knob({}, "variant -> its name in tables")
    overrides: dict[str, dict[str, dict[str, Any]]] = knob(
        {}, "settings for a group or a scene: group or dataset/scene -> section -> setting -> value"
    )
    queries: dict[str, tuple[str, ...]] = knob(
        {}, "panel queries for scenes without image labels, by dataset/scene or data set"
    )

    @field_validator("groups", "only", "sweep_scenes", mode="before")
    @classmethod
    def _names(cls, value: Any) -> Any:
        """Accept a single name, because `only=desk` on a command line is a string."""
        return (value,) if isinstance(value, str) else value

    @field_validator("results")
    @classmethod
    def _normalised(cls, value: str) -> str:
        """Remove a final slash, as shells add it, and a leading `./`, because paths are compared as texts."""
        return str(Path(value))

    def every_variant(self) -> list[str]:
        """Return all variants, tabulated or not, once per seed, in order: "default", then `variants`."""
        return [
            name for first in dict.fromkeys(["default", *self.variants]) for name in self.all_seeds(first)
        ]

    def variant_names(self) -> list[str]:
        """Return the variants in the run's tables, "default" first, each once per seed."""
        names = [
            *("default", *self.main_variants, *self.ablation_variants, *self.component_variants),
            *(*self.theta_variants, *self.omega_variants, *self.pruning_variants),
        ]
        return [name for first in dict.fromkeys(names) for name in self.all_seeds(first)]

    def all_seeds(self, variant: str, table: str = "") -> list[str]:
        """Return a variant's name, and its names with the other seeds: `<name>.seed1`, ...

        Args:
            table: key that lists the variants of a table, to return only the seeds in that table.
        """
        is_ablation = table == "ablation_variants" or (not table and variant in self.ablation_variants)
        seeds = max(self.seeds, self.ablation_seeds) if is_ablation else self.seeds
        return [variant, *(f"{variant}.seed{number}" for number in range(1, seeds))]

    def seed_of(self, variant: str) -> int:
        return self.seed + seed_parts(variant)[1]

    def stages(self, variant: str = "default", scopes: tuple[str, ...] = ()) -> StageSettings:
        """Return the settings of a variant for a scene.

        Args:
            scopes: keys of `overrides` to apply, general ones first (group, then dataset/scene).

        Raises:
            SettingsError: the variant is unknown or an override is invalid.
        """
        variant, _ = seed_parts(variant)
        sections: dict[str, Section] = {name: getattr(self, name) for name in SECTIONS}
        layers = [(f"overrides.{scope}", self.overrides.get(scope, {})) for scope in scopes]
        if variant in self.variants:
            layers.append((f"variants.{variant}", self.variants[variant]))
        elif variant != "default":
            raise SettingsError(
                f"variant {variant!r} is not defined", expected=f"one of default, {', '.join(self.variants)}"
            )
        for where, layer in layers:
            require_known(where, layer, SECTIONS)
            for section, values in layer.items():
                below = sections[section].model_dump()
                if section == "method" and values.get("name", below["name"]) != below["name"]:
                    below = {}  # settings of a different method
                sections[section] = validated(section, below | values, f"{where}.{section}")
        return StageSettings.model_validate(sections)


entry_points("hilsplat.settings", Section, tuple(RunSettings.__annotations__))  # refuses these names as well


def seed_parts(name: str) -> tuple[str, int]:
    """Split a variant name into the variant and its seed number (0 if the name has none)."""
    match = SEEDED.fullmatch(name)
    return (match[1], int(match[2])) if match else (name, 0)


def parse_run(config: dict[str, Any]) -> RunSettings:
    """Validate a configuration with variants and overrides; raise a SettingsError that names all bad keys."""
    if "\\u0000" in json.dumps(config, default=str):
        raise SettingsError(
            "a string in the configuration contains a null byte", fix="remove it; commands cannot contain one"
        )
    try:
        run = RunSettings.model_validate(config)
    except ValidationError as error:
        raise settings_error(error, "", RunSettings) from error
    for name in dict.fromkeys([*run.variants, *run.groups]):
        if (problem := name_problem(name)) is not None:
            raise SettingsError(
                f"{name!r} cannot be the name of a variant or group: {problem}",
                expected=NAME_RULE,
                fix="rename it in the configuration",
            )
    taken = dict.fromkeys((*RESERVED, *entry_points("hilsplat.generators")), "for files in a scene folder")
    for name in dict.fromkeys(["default", *run.variants]):
        # Names that differ only in case share a folder on some file systems; other seeds have own folders.
        key = seed_parts(name)[0].casefold()
        if key in taken:
            raise SettingsError(
                f"variants.{name}: this name is reserved {taken[key]}",
                expected=f"a name other than {', '.join(sorted(taken))}, also if the case is ignored",
                fix="rename the variant",
            )
        taken[key] = f"by the variant {name}"
    for key, text in ((key, text) for key, texts in run.queries.items() for text in texts):
        try:
            path_of(text)
        except SettingsError as error:
            error.add_line("in", f"queries.{key}")
            raise
    for variant in dict.fromkeys([*run.variant_names(), *run.variants]):
        run.stages(variant)
    for scope in run.overrides:
        run.stages(scopes=(scope,))
    require_known("labels", run.labels, ["default", *run.variants])
    return run


def require_known(where: str, keys: Iterable[str], known: Collection[str]) -> None:
    """Refuse unknown keys, which would have no effect, and suggest a known one."""
    for key in keys:
        if key not in known:
            fix = f"correct the key, or remove it from {where}"
            raise SettingsError(f"{where}.{key}: unknown name", expected=nearest(key, known), fix=fix)


class _UniqueKeys(yaml.SafeLoader):  # type: ignore[misc]
    """YAML loader that refuses duplicate keys, because all but the last would be ignored."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key, _ in node.value:
            if key.tag != "tag:yaml.org,2002:merge" and isinstance(key, yaml.ScalarNode):
                if key.value in seen:
                    problem = f"key {key.value!r} is duplicated"
                    raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
                seen.add(key.value)
        return super().construct_mapping(node, deep)


def read_config(path: Path) -> dict[str, Any]:
    """Read a configuration file; raise SettingsError if it is missing or not a YAML mapping."""
    try:
        content = yaml.load(regular(Path(path)).read_text(encoding="utf-8"), _UniqueKeys)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        position = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        fault = "cannot be used" if isinstance(error, yaml.constructor.ConstructorError) else "is not YAML"
        raise SettingsError(
            f"{path}{position} {fault}: {error.problem or error.context}",
            fix="indent with spaces, close brackets and quotes, and quote strings with colons or braces",
        ) from error
    except FileNotFoundError as error:
        raise SettingsError(f"{path} is missing", fix="correct the path") from error
    except (yaml.YAMLError, ValueError, RecursionError, OSError) as error:  # ValueError: bad date or UTF-8
        raise SettingsError(f"{path} cannot be read: {error}", fix="save it as YAML in UTF-8") from error
    if not isinstance(content, dict):
        kind = "nothing" if content is None else type(content).__name__
        raise SettingsError(f"{path} does not contain settings", expected="lines like key: value", found=kind)
    try:
        json.dumps(content, default=str)
    except (ValueError, RecursionError, TypeError) as error:  # a self-referencing alias; a list as key
        raise SettingsError(f"{path} cannot be used: {error}", fix="remove aliases and list keys") from error
    return content


def merged_config(paths: Sequence[Path], *overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Merge `config/config.yaml`, further files and overrides in order, recursively as Snakemake does."""
    merged = read_config(project_path(CONFIG))
    for layer in (*map(read_config, paths), *overrides):
        merged = _merge(merged, layer)
    return merged


def first_unusable(paths: Sequence[Path]) -> str:
    """Return the name of the first layer of `merged_config` that makes the configuration invalid."""
    for count, name in enumerate([CONFIG, *paths]):
        try:
            parse_run(merged_config(paths[:count]))
        except SettingsError:
            return str(name)
    return "--config"


def _merge(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(below)
    for key, value in above.items():
        both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
        merged[key] = _merge(merged[key], value) if both else value
    return merged


def config_schema() -> dict[str, Any]:
    """Return the configuration's JSON schema, for editors that check YAML (`hilsplat settings --schema`).

    Section `method` may contain the settings of any method.
    """
    schema = RunSettings.model_json_schema()
    properties = schema["$defs"]["MethodSettings"]["properties"]
    for name in own_settings():
        properties |= settings_class({"name": name}).model_json_schema()["properties"]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def knob_table() -> str:
    """Format all settings as text: name, default, choices or range, unit, origin, meaning."""
    entries: dict[tuple[str, str], list[str]] = {}  # entry -> methods, if it is a setting of some methods
    models: dict[str, type[BaseModel]] = {"": RunSettings, **SECTIONS}
    for section, model in models.items():
        for name, field in model.model_fields.items():
            if section or name not in SECTIONS:
                entries[_entry(f"{section}.{name}" if section else name, field)] = []
        if section == "method":
            for method, fields in own_settings().items():
                for name, field in fields.items():
                    entries.setdefault(_entry(f"method.{name}", field), []).append(method)
    lines = []
    for (facts, description), methods in entries.items():
        lines += [facts, f"    {', '.join(methods)}: {description}" if methods else f"    {description}"]
    return "\n".join(lines)


def _entry(key: str, field: FieldInfo) -> tuple[str, str]:
    """Return the line with a setting's facts, and its description."""
    extra = field.json_schema_extra
    assert isinstance(extra, dict), key  # every field is defined with `knob`
    choices: list[str] = []
    limits = [*field.metadata]
    is_union = get_origin(field.annotation) in (Union, UnionType)
    for part in get_args(field.annotation) if is_union else [field.annotation]:
        if get_origin(part) is Literal:
            choices += get_args(part)
        elif get_origin(part) is Annotated:
            limits += get_args(part)[1].metadata
    bounds = ", ".join(
        f"{symbol} {getattr(limit, attribute)}"
        for limit in limits
        for attribute, symbol in (("ge", ">="), ("gt", ">"), ("le", "<="), ("lt", "<"))
        if hasattr(limit, attribute) and getattr(limit, attribute) != LARGEST
    )
    facts = ["|".join(choices), bounds, extra["unit"], f"origin: {extra['origin']}"]
    details = "; ".join(str(fact) for fact in facts if fact)
    return f"{key} = {field.default!r}  ({details})", str(field.description)
