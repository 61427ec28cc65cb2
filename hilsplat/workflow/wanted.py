"""Every artifact that a run may write, and how the plan wants it made."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

from hilsplat.configuration import SECTIONS
from hilsplat.datasets.sources import is_exported
from hilsplat.methods.registry import OURS
from hilsplat.scene.sheet import SceneRow
from hilsplat.workflow.jobs import Job, VariantJob, scene_path
from hilsplat.workflow.plan import Plan
from hilsplat.workflow.soundness import Wanted
from hilsplat.workflow.targets import tables

SHARED = ("masks", "coverage_tree", "clip", "contributions", "semantic_tree", "autoencoder", "field")
"""Stages whose outputs variants share."""


def wanted(plan: Plan) -> list[Wanted]:
    """Every artifact that the run may write, and how it is to be made."""
    found = [each for row in plan.scenes for each in _wanted_of(plan, row)]
    return [*found, *(Wanted(Path(table), table, "table") for table in tables(plan))]


def _wanted_of(plan: Plan, row: SceneRow) -> Iterator[Wanted]:
    """The artifacts of one scene; what variants share is listed once."""
    scene = SimpleNamespace(dataset=row.dataset, scene=row.scene)
    if row.world:
        world = _want(plan, scene, "world", "world")
        yield replace(world, output=scene_path(scene, "world/images"))
    if is_exported(row.source):
        yield _want(plan, scene, "source", "source", plugins=plan.data.source_reader(scene))
    yield _want(plan, scene, "poses", "scene", seed=plan.run.seed)
    yield _want(plan, scene, "gaussians", "gaussians.ply", seed=plan.run.seed)
    listed: set[tuple[str, str]] = set()
    for variant in plan.run.variant_names():
        for stage in SHARED:
            owner = plan.shared_variant(stage, SimpleNamespace(**vars(scene), variant=variant))
            if (stage, owner) not in listed:
                listed.add((stage, owner))
                yield _want_shared(plan, SimpleNamespace(**vars(scene), variant=owner), stage)
        job = SimpleNamespace(**vars(scene), variant=variant)
        yield _want(plan, job, "evaluate", "scores.csv", plugins=plan.data.label_readers(job))
    figures = {name: plan.values(name, scene) for name in ("figures", "evaluate")}
    for stage, picture in (("figures", "panel"), ("comparison", "comparison")):
        path = f"results/figures/{row.name}/{picture}.png"
        yield Wanted(Path(path), path, stage, figures, None, plan.data.label_readers(scene))
    path = f"results/figures/{row.name}/masks.png"
    yield Wanted(Path(path), path, "mask_truth")


def _want_shared(plan: Plan, job: VariantJob, stage: str) -> Wanted:
    """What a variant makes for itself and for those that share it."""
    stages, seed = plan.stages(job), plan.seed(job)
    if stage == "masks":
        stage = plan.masks_stage(job)
        return _want(plan, job, stage, "masks", stages.perturb.seed if stage == "truth_masks" else None)
    if stage == "field":
        if stages.method.name == OURS:
            return _want(plan, job, "field", "field.safetensors")
        return _want(plan, job, "method", "field.safetensors", seed, plan.baseline(job))
    return _want(plan, job, stage, stage, seed if stage == "autoencoder" else None)


def _want(
    plan: Plan, job: Job, stage: str, name: str, seed: int | None = None, plugins: tuple[str, ...] = ()
) -> Wanted:
    variant = getattr(job, "variant", None)
    path = scene_path(job, *([variant] if variant is not None else []), name)
    section = "perturb" if stage == "truth_masks" else stage
    settings = plan.values(section, job) if section in SECTIONS else {}
    return Wanted(Path(path), path, stage, settings, seed, plugins)
