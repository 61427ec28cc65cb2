"""The baselines by name: their settings, and where their code is.

A run reads this before it imports the code of any baseline, which takes seconds (torch, numba). Installed
packages add methods with entry points of the group `hilsplat.methods` (docs/extending.md).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from hilsplat.base.errors import SettingsError
from hilsplat.base.plugins import Plugins, entry_points
from hilsplat.settings import HierarchyLosses, Section, Size, knob

OURS = "hilsplat"  # the method of this repository; the `field` stage computes its field

GROUP = "hilsplat.methods"

Granularity = Annotated[float, Field(gt=0, lt=2)]
Granularities = tuple[Granularity, Granularity, Granularity]


def _rising(thresholds: Granularities) -> Granularities:
    if not thresholds[0] < thresholds[1] < thresholds[2]:
        raise ValueError("levels are nested only if the numbers rise from whole to subpart")
    return thresholds


def _falling(thresholds: Granularities) -> Granularities:
    if not thresholds[0] > thresholds[1] > thresholds[2]:
        raise ValueError("levels are nested only if the numbers fall from whole to subpart")
    return thresholds


class MethodSettings(Section):
    """The method that computes the field; a method with further settings has a subclass."""

    name: str = knob(OURS, "hilsplat, a baseline (docs/methods.md), or a method of an installed package")

    @property
    def is_random(self) -> bool:
        """Whether the method depends on the seed; our solver does not."""
        return self.name != OURS and method_of(self.name).is_random


class TrainedSettings(MethodSettings):
    """Training on rendered pixels; the number of steps determines a run's estimated time."""

    steps: int = knob(
        1800,
        "steps, each on one view; per level for langsplat, hi_lsplat, langsplat_v2 and gaussian_grouping, "
        "otherwise for all levels together",
        ge=1,
        origin="LangSplat, LangSplatV2: 30000",
    )
    rate: float = knob(0.0025, "Adam step size", gt=0, origin="LangSplat")
    pixel_step: int = knob(2, "pixel stride in x and y", ge=1, origin="LangSplat: 1")


class HiLSplatSettings(TrainedSettings, HierarchyLosses):
    """LangSplat's training with the paper's losses."""

    language: Literal["l1", "squared"] = knob(
        "l1",
        "loss between rendered and painted codes; squared: that of the solver in section field",
        origin="LangSplat: l1",
    )


class OpenGaussianSettings(TrainedSettings):
    codebook: tuple[Size, Size] = knob(
        (64, 10),
        "number of groups by feature and position, and of groups by feature within each",
        origin="OpenGaussian: (64, 10) on LERF, (64, 5) on ScanNet",
    )


class OmniSeg3DSettings(TrainedSettings):
    thresholds: Annotated[Granularities, AfterValidator(_rising)] = knob(
        (0.5, 0.8, 0.95), "minimum average cosine of a cluster: whole, part, subpart; rising"
    )


class VchSettings(TrainedSettings):
    thresholds: Annotated[Granularities, AfterValidator(_falling)] = knob(
        (0.6, 0.5, 0.45), "maximum edge of a component: whole, part, subpart; falling"
    )


@dataclass(frozen=True)
class Method:
    """A baseline.

    Attributes:
        fit: "module:function"; a function of type `hilsplat.methods.method.Fit`, imported when it runs.
        settings: class of its settings.
        is_random: whether the field depends on the seed.
        averages: whether it averages codes as if they were vectors, so that the code must be linear.
    """

    fit: str
    settings: type[MethodSettings] = MethodSettings
    is_random: bool = True
    averages: bool = False


BASELINES = {
    "dr_splat": Method("hilsplat.methods.dr_splat:fit", averages=True),
    "gaussian_grouping": Method("hilsplat.methods.gaussian_grouping:fit", TrainedSettings, averages=True),
    "hi_lsplat": Method("hilsplat.methods.langsplat:fit", HiLSplatSettings),
    "laga": Method("hilsplat.methods.laga:fit", TrainedSettings, averages=True),
    "langsplat": Method("hilsplat.methods.langsplat:fit", TrainedSettings),
    "langsplat_v2": Method("hilsplat.methods.langsplat_v2:fit", TrainedSettings, averages=True),
    "legaussians": Method("hilsplat.methods.legaussians:fit", TrainedSettings, averages=True),
    "lifted": Method("hilsplat.methods.lifted:fit", is_random=False, averages=True),
    "occam": Method("hilsplat.methods.occam:fit", is_random=False, averages=True),
    "omniseg3d": Method("hilsplat.methods.omniseg3d:fit", OmniSeg3DSettings, averages=True),
    "opengaussian": Method("hilsplat.methods.opengaussian:fit", OpenGaussianSettings, averages=True),
    "saga": Method("hilsplat.methods.saga:fit", TrainedSettings, averages=True),
    "vch": Method("hilsplat.methods.vch:fit", VchSettings, averages=True),
}


def installed() -> Plugins[Method]:
    """Return the methods of installed packages by name."""
    return entry_points(GROUP, Method, (OURS, *BASELINES))


def method_of(name: str) -> Method:
    """Return a baseline, without importing its code.

    Raises:
        SettingsError: there is no such baseline.
        HilsplatError: the package that has it cannot be imported.
    """
    if name in BASELINES:
        return BASELINES[name]
    if name == OURS:
        raise SettingsError(
            f"method.name: {OURS} is not a baseline",
            expected=f"one of {', '.join((*BASELINES, *installed()))}",
            fix="run the `field` stage, which computes its field",
        )
    if name not in installed():
        raise SettingsError(
            f"method.name: method {name!r} is unknown",
            expected=f"one of {', '.join((OURS, *BASELINES, *installed()))}",
            fix="correct the name, or implement the method (docs/extending.md)",
        )
    return installed()[name]


def settings_class(section: Any) -> type[MethodSettings]:
    """Return the class for the values of section `method`; raise `SettingsError` if its name is unknown."""
    name = section.get("name", OURS) if isinstance(section, Mapping) else OURS
    return MethodSettings if name == OURS or not isinstance(name, str) else method_of(name).settings


def own_settings() -> dict[str, dict[str, Any]]:
    """Return the settings that methods have besides `name`: method -> setting -> pydantic field."""
    methods = {name: method_of(name) for name in (*BASELINES, *installed())}
    return {
        name: {key: field for key, field in method.settings.model_fields.items() if key != "name"}
        for name, method in methods.items()
    }
