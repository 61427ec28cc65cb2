"""Which module is which stage."""

STAGE_MODULES: dict[str, str] = {
    "world": "hilsplat.world.stage",
    "source": "hilsplat.datasets.sources",
    "poses": "hilsplat.scene.poses",
    "gaussians": "hilsplat.splat.fit",
    "masks": "hilsplat.segment.stage",
    "truth_masks": "hilsplat.datasets.truth_masks",
    "tree": "hilsplat.segment.tree_stage",
    "clip": "hilsplat.language.clip_stage",
    "langsplat": "hilsplat.language.langsplat_files",
    "contributions": "hilsplat.language.contributions",
    "semantic_tree": "hilsplat.language.semantic_tree",
    "autoencoder": "hilsplat.language.autoencoder",
    "language": "hilsplat.language.field",
    "reference": "hilsplat.language.reference",
    "method": "hilsplat.methods.stage",
    "evaluate": "hilsplat.evaluate.stage",
    "tables": "hilsplat.evaluate.tables.build",
    "efficiency": "hilsplat.evaluate.efficiency",
    "figures": "hilsplat.evaluate.figures",
    "comparison": "hilsplat.evaluate.comparison",
    "sweep": "hilsplat.evaluate.sweep_plot",
    "consistency": "hilsplat.evaluate.world_consistency",
    "tree_truth": "hilsplat.evaluate.tree_truth",
    "models": "hilsplat.world.tiny.train",
}
"""Module of each stage, whose import closure is the stage's code (see `base.code_hash`)."""
