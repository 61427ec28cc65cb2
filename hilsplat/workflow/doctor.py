"""`hilsplat doctor`: checks of this machine's installation, with a fix for each problem."""

import importlib.metadata
import os
import platform
import shlex
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from packaging.requirements import Requirement

from hilsplat.base.atomic import existing_folder
from hilsplat.base.errors import HilsplatError, MemoryLimitError, in_one_line
from hilsplat.base.lineage import version_of
from hilsplat.base.memory import machine_mib
from hilsplat.configuration import merged_config
from hilsplat.models.store import RECOMMENDED, broken_models, present_models, user_models
from hilsplat.stages import all_stages
from hilsplat.workflow.plan import Plan
from hilsplat.workflow.resources import COSTS, JobResources


@dataclass(frozen=True)
class Finding:
    """Result of a check: a note concerns something optional, a fault causes failed runs or wrong results."""

    check: str
    state: Literal["ok", "note", "fault"]
    found: str
    fix: str = ""


def verdict(check: str, problem: str | None, sound: str, fix: str) -> Finding:
    return Finding(check, "fault", problem, fix) if problem else Finding(check, "ok", sound)


def examine() -> Iterator[Finding]:
    """Run every check; an unexpected exception is reported as a fault and does not stop other checks."""
    for check in CHECKS:
        try:
            yield from check()
        except Exception as error:  # a broken installation can raise anything
            yield Finding(check.__name__, "fault", f"{type(error).__name__}: {error}", "report this output")


def python() -> Iterator[Finding]:
    yield Finding("python", "ok", f"{platform.python_version()} on {platform.system()} {platform.machine()}")


def libraries() -> Iterator[Finding]:
    wrong, number = [], 0
    for text in importlib.metadata.requires("hilsplat") or ():
        requirement = Requirement(text)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": ""}):
            continue
        number += 1
        installed = version_of(requirement.name)
        if installed is None:
            wrong.append(f"{requirement.name} is missing")
        elif not requirement.specifier.contains(installed, prereleases=True):
            wrong.append(f"{requirement.name} {installed} does not satisfy {requirement.specifier}")
    fix = "pip install --upgrade hilsplat, with the repository's constraints.txt"
    yield verdict("libraries", "; ".join(wrong), f"{number} libraries in the required versions", fix)


def cuda() -> Iterator[Finding]:
    """Check whether torch and gsplat can use CUDA, and whether their renders match the CPU's."""
    from hilsplat.models.card import card_problem
    from hilsplat.splat.rasterise.device import cuda_problem, forget_cuda, kernel_problem
    from hilsplat.splat.rasterise.parity import cuda_disagreement

    forget_cuda()
    if problem := cuda_problem() or kernel_problem():
        what = "everything runs" if card_problem() else "fits and contributions run"
        fix = "on a machine with an NVIDIA GPU: install the extra gpu and a CUDA toolkit (docs/gpu.md)"
        yield Finding("cuda", "note", f"{problem}: {what} on the CPU", fix)
        return
    sound = "gsplat and the CPU agree on a step of a fit and pixel weights"
    yield verdict("cuda", cuda_disagreement(), sound, "set device: cpu, and report this output")


def kernels() -> Iterator[Finding]:
    """Compile or load the rasteriser's loops, and render a small scene."""
    from hilsplat.splat.rasterise.parity import disagreement

    begin = time.monotonic()
    apart = disagreement("cpu", "cpu")
    sound = f"a small scene was rendered in {time.monotonic() - begin:.1f} s, including compilation"
    yield verdict("kernels", apart, sound, "reinstall numba and llvmlite")


def video() -> Iterator[Finding]:
    """Check whether PyAV reads H.264 and HEVC and writes H.264."""
    import av

    needed: tuple[tuple[str, Literal["r", "w"]], ...] = (("h264", "r"), ("hevc", "r"), ("libx264", "w"))
    missing = []
    for name, mode in needed:
        try:
            av.codec.Codec(name, mode)
        except (av.FFmpegError, ValueError):
            missing.append(f"{mode} {name}")
    problem = f"PyAV {av.__version__} lacks {', '.join(missing)}" if missing else ""
    sound = f"PyAV {av.__version__} reads H.264 and HEVC and writes H.264"
    yield verdict("video", problem, sound, "pip install --force-reinstall av")


def models() -> Iterator[Finding]:
    """Run each model for photographs on the CPU, and on a card if there is one."""
    from hilsplat.embed.model_check import card_disagreement, check_model
    from hilsplat.models.card import card_problem

    real = [model for model in present_models() if not model.embedded]
    missing = {"sam", "clip"} - {model.family for model in real}
    for folder in [*(model.folder for model in real or present_models()), *broken_models()]:
        try:
            check_model(folder)
            apart = None if card_problem() else card_disagreement(folder)
        except MemoryLimitError as error:
            problem = f"{folder} works on the CPU, but not on the GPU now: {in_one_line(error)}"
            yield Finding("models", "note", problem, "end other programs on the GPU, or use a smaller model")
            continue
        except HilsplatError as error:
            yield Finding("models", "fault", str(error), f"hilsplat models get {shlex.quote(folder.name)}")
            continue
        sound = f"{folder} works on the CPU{'' if card_problem() else ' and the GPU'}"
        fix = "set masks.device and clip.device: cpu, and report this output"
        yield verdict("models", f"{folder}: {apart}" if apart else "", sound, fix)
    if missing:
        names = " and no ".join(family.upper() for family in sorted(missing))
        problem = f"no {names} for photographs: answers about them are meaningless"
        yield Finding("models", "note", problem, f"hilsplat models get ({' and '.join(RECOMMENDED)})")


def space() -> Iterator[Finding]:
    """Compare free disk space and memory with the requirements of the configured scenes."""
    try:
        plan = Plan(merged_config([]))
    except HilsplatError as error:
        fix = "select groups of scenes, or name scenes: hilsplat run photos/desk"
        yield Finding("configuration", "note", str(error), fix)
        return
    resources, disk_mb, memory = JobResources(plan), 0.0, (0.0, "", "")
    names = [name for name, stage in all_stages().items() if stage.scope != "run" and stage.name in COSTS]
    for row in plan.scenes:
        disk_mb += sum(resources.disk_mb(rule, row) for rule in names)
        for rule in names:
            memory = max(memory, (resources.memory_mb(rule)(row, threads=1, attempt=1), rule, row.name))
    folder = existing_folder(plan.results)
    free, needed = shutil.disk_usage(folder).free / 2**30, disk_mb * 1e6 / 2**30
    text = f"{free:.1f} GiB free in {folder}; results of {len(plan.scenes)} scenes need about {needed:.1f}"
    fix = "free up space, or set results to a folder on another disk"
    yield verdict("disk", "" if free > needed else text, text, fix)
    (most, rule, scene), ram = memory, machine_mib()
    text = f"{ram / 1024:.1f} GiB; the largest job, {rule} of {scene}, needs about {most / 1024:.1f}"
    fix = "lower poses.max_side_px or gaussians.max_gaussians"
    yield verdict("memory", "" if ram > most else text, text, fix)


def writing() -> Iterator[Finding]:
    kernels_folder = Path(__file__).resolve().parents[1] / "__pycache__"
    folders = {"working folder": Path.cwd(), "models": user_models(), "compiled kernels": kernels_folder}
    for what, folder in folders.items():
        existing = existing_folder(folder)
        if os.access(existing, os.W_OK):
            yield Finding("writing", "ok", f"{what}: {folder}")
        else:
            state: Literal["note", "fault"] = "fault" if folder == Path.cwd() else "note"
            fix = f"make {existing} writable for this user"
            yield Finding("writing", state, f"{what}: {existing} is read-only", fix)


CHECKS = (python, libraries, cuda, kernels, video, models, space, writing)
