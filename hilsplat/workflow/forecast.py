"""Forecast of the time until a scene of photographs accepts queries, from one timing of SAM and CLIP."""

from pathlib import Path

from hilsplat.configuration import StageSettings
from hilsplat.models.store import read_model
from hilsplat.scene.finished import KEY_VIEWS
from hilsplat.scene.sheet import PHOTOS, SceneRow
from hilsplat.workflow.plan import Plan
from hilsplat.workflow.progress import duration
from hilsplat.workflow.resources import GUIDED, NODES, PICTURE_S, JobResources
from hilsplat.workflow.scene_data import of_variant

KEPT_PROMPTS = 0.3
"""Share of the previewed prompts whose masks are decoded."""


def forecasts(plan: Plan, cores: int) -> list[str]:
    """Return a line per scene of photographs that a full-size SAM and CLIP have not yet processed."""
    resources = JobResources(plan)
    lines = []
    for row in plan.scenes:
        is_done = Path(plan.path(row, "default", "clip")).exists()
        if row.group == PHOTOS and _is_real(plan.stages(row)) and not is_done:
            lines.append(_forecast(plan, resources, row, cores))
    return lines


def _is_real(stages: StageSettings) -> bool:
    models = [read_model(Path(section.model)) for section in (stages.masks, stages.clip)]
    return stages.masks.segmenter == "sam" and all(model and not model.embedded for model in models)


def _forecast(plan: Plan, resources: JobResources, row: SceneRow, cores: int) -> str:
    from hilsplat.embed.model_check import seconds_of  # onnxruntime takes a while to import

    files, stages = plan.data.image_files(row), plan.stages(row)
    sam, clip, cache = stages.masks, stages.clip, plan.results / ".cache"
    view_s = seconds_of(Path(sam.model), sam.variant, sam.precision, cache)
    crop_s = seconds_of(Path(clip.model), clip.variant, clip.precision, cache)["crop"]
    prompt_s = view_s["masks"]
    if "preview" in view_s:
        prompt_s = view_s["preview"] + KEPT_PROMPTS * view_s["masks"]
    every = stages.poses.test_every
    views = len(files) - (len(files) // every if every else 0)
    prompts = stages.masks.points_per_side**2
    base_s = view_s["image"] + PICTURE_S
    full_s, guided_s = base_s + prompts * prompt_s, base_s + GUIDED * prompts * prompt_s
    before_s = sum(resources.core_seconds(rule, row) for rule in ("poses", "gaussians"))
    after_s = sum(resources.core_seconds(rule, row) for rule in ("contributions", "semantic_tree"))
    said, rest_s = "", views * full_s
    if plan.first_answer(of_variant(row, "default")):
        settings = plan.stages(of_variant(row, KEY_VIEWS))
        first = views * settings.masks.key_views
        key_s = base_s + settings.masks.points_per_side**2 * prompt_s
        before_s += first * key_s + after_s / 2 + NODES * settings.clip.crops_per_node * crop_s
        rest_s = (views - first) * (guided_s if stages.masks.prompts == "guided" else full_s)
        said = f"first answer in {duration(before_s / cores)}, "
    total_s = before_s + rest_s + after_s + NODES * stages.clip.crops_per_node * crop_s
    return (
        f"{row.name}: {said}all photographs in {duration(total_s / cores)}. "
        f"A photograph takes {full_s:.0f} s of SAM on one of {cores} cores, a crop {crop_s:.2f} s of CLIP."
    )
