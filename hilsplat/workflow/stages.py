"""Registry of stages and their functions."""

from hilsplat.base.code import code_digest
from hilsplat.base.errors import HilsplatError

STAGES: dict[str, str] = {
    "world": "hilsplat_world.stage:run_world",
    "source": "hilsplat.datasets.sources:export_images",
    "poses": "hilsplat.scene.poses:run_poses",
    "gaussians": "hilsplat.splat.fit:run_gaussians",
    "masks": "hilsplat.segment.stage:run_masks",
    "key_masks": "hilsplat.contributions.key_views:run_key_masks",
    "guided_masks": "hilsplat.semantic_tree.guided_masks:run_guided_masks",
    "truth_masks": "hilsplat_world.truth_masks:run_truth_masks",
    "coverage_tree": "hilsplat.segment.coverage:run_coverage_tree",
    "clip": "hilsplat.embed.stage:run_clip",
    "langsplat": "hilsplat.embed.langsplat_files",
    "names": "hilsplat.query.node_names:run_names",
    "contributions": "hilsplat.contributions.stage:run_contributions",
    "semantic_tree": "hilsplat.semantic_tree.build:run_semantic_tree",
    "feature_tree": "hilsplat.methods.feature_tree:run_feature_tree",
    "autoencoder": "hilsplat.field.autoencoder:run_autoencoder",
    "field": "hilsplat.field.field:run_field",
    "method": "hilsplat.methods.method:run_method",
    "evaluate": "hilsplat.evaluate.stage:run_evaluate",
    "evaluate_files": "hilsplat.evaluate.files_stage:run_evaluate_files",
    "table": "hilsplat.evaluate.tables.build:run_table",
    "efficiency": "hilsplat.evaluate.costs:run_efficiency",
    "figures": "hilsplat.evaluate.figures.panel:run_figures",
    "comparison": "hilsplat.evaluate.figures.comparison:run_comparison",
    "sweep": "hilsplat.evaluate.figures.sweep_plot:run_sweep_plot",
    "consistency": "hilsplat_world.diagnostics.world_consistency:run_consistency",
    "mask_truth": "hilsplat_world.diagnostics.mask_truth:run_mask_truth",
    "tree_truth": "hilsplat_world.diagnostics.tree_truth:run_tree_truth",
    "label_fits": "hilsplat.evaluate.label_fits:run_label_fits",
}
"""Stage -> the function that its command calls; a module stands for all of its functions."""


def stage_code(stage: str, plugins: tuple[str, ...] = ()) -> str:
    """Return the digest of a stage's code, including the readers or baselines that it uses in this run."""
    if stage not in STAGES:
        raise HilsplatError(f"unknown stage {stage!r}", expected=f"one of {', '.join(STAGES)}")
    return code_digest(STAGES[stage], *plugins)
