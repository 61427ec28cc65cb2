# Masks at three levels by one of several stages, and the coverage tree of each view.
use rule stage as masks with:
    input:
        scene="<results>/{dataset}/{scene}/scene",
    output:
        out=directory("<results>/{dataset}/{scene}/{variant}/masks"),
    log:
        PLAN.log("masks"),
    benchmark:
        PLAN.benchmark("masks")
    wildcard_constraints:
        dataset=PLAN.jobs_of("masks"),
    priority: PLAN.masks_priority
    resources:
        **RESOURCES.of("masks"),
    params:
        **PLAN.params("masks"),


use rule masks as key_masks with:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        gaussians="<results>/{dataset}/{scene}/gaussians.ply",
    wildcard_constraints:
        dataset=PLAN.jobs_of("key_masks"),
    params:
        **PLAN.params("key_masks"),


use rule masks as guided_masks with:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        gaussians="<results>/{dataset}/{scene}/gaussians.ply",
        key_masks=PLAN.of_key_views("masks"),
        key_tree=PLAN.of_key_views("semantic_tree"),
    wildcard_constraints:
        dataset=PLAN.jobs_of("guided_masks"),
    params:
        **PLAN.params("guided_masks"),


use rule masks as imported_masks with:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        files=given(PLAN.data.features),
    wildcard_constraints:
        dataset=PLAN.jobs_of("imported_masks"),
    params:
        **PLAN.params("imported_masks", **FEATURES),


use rule stage as coverage_tree with:
    input:
        **PLAN.inputs("coverage_tree"),
    output:
        out=directory("<results>/{dataset}/{scene}/{variant}/coverage_tree"),
    log:
        PLAN.log("coverage_tree"),
    benchmark:
        PLAN.benchmark("coverage_tree")
    threads: 1
    resources:
        **RESOURCES.of("coverage_tree"),
    params:
        **PLAN.params("coverage_tree"),
