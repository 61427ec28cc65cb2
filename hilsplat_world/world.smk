# Synthetic scenes: images for the stages, ground truth for evaluation, figures and the diagnostic segmenter.
use rule stage as world with:
    output:
        out=directory("<results>/{dataset}/{scene}/world/images"),
        truth=directory("<results>/{dataset}/{scene}/world/truth"),
    log:
        PLAN.log("world"),
    benchmark:
        PLAN.benchmark("world")
    priority: 10
    resources:
        **RESOURCES.of("world"),
    params:
        **PLAN.params("world"),


use rule masks as truth_masks with:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        truth=PLAN.data.required_truth,
    wildcard_constraints:
        dataset=PLAN.jobs_of("truth_masks"),
    params:
        **PLAN.params("truth_masks"),


use rule stage as mask_truth with:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        truth=PLAN.data.truth,
        masks="<results>/{dataset}/{scene}/default/masks",
    output:
        out=scene_picture("masks"),
        table="<results>/figures/{dataset}/{scene}/masks.csv",
    log:
        PLAN.log("mask_truth"),
    benchmark:
        PLAN.benchmark("mask_truth")
    threads: 1
    resources:
        **RESOURCES.of("mask_truth"),
    params:
        **PLAN.params("mask_truth"),
