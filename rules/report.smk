# Pictures per scene and the report.
use rule stage as figures with:
    input:
        **PLAN.of_default(*PARTS),
        scene="<results>/{dataset}/{scene}/scene",
        fit="<results>/{dataset}/{scene}/gaussians",
        truth=PLAN.data.truth,
        labels=given(PLAN.data.label_files),
        gaussians="<results>/{dataset}/{scene}/gaussians.ply",
    output:
        out=scene_picture("panel"),
        registration=scene_picture("registration"),
        fit=scene_picture("fit"),
    log:
        PLAN.log("figures"),
    benchmark:
        PLAN.benchmark("figures")
    threads: RESOURCES.variant_threads
    resources:
        **RESOURCES.of("figures"),
    params:
        **PLAN.params("figures", **LABELS, labels=PLAN.data.figure_labels),


use rule stage as comparison with:
    input:
        **PLAN.compared(*PARTS),
        scene="<results>/{dataset}/{scene}/scene",
        truth=PLAN.data.truth,
        labels=given(PLAN.data.label_files),
        gaussians="<results>/{dataset}/{scene}/gaussians.ply",
        scores=PLAN.compared_scores,  # their provenance records the settings of the queries
    output:
        out=scene_picture("comparison"),
        views=scene_picture("views"),
        features=scene_picture("features"),
    log:
        PLAN.log("comparison"),
    benchmark:
        PLAN.benchmark("comparison")
    threads: RESOURCES.variant_threads
    resources:
        **RESOURCES.of("comparison"),
    params:
        **PLAN.params("comparison", **LABELS, labels=PLAN.data.figure_labels),


use rule stage as sweep_plot with:
    input:
        table="<results>/tables/{sweep}.csv",
    output:
        out=picture("<results>/figures/sweep-{sweep}.png", "Sweeps", "sweep"),
    log:
        PLAN.log("sweep_plot", "-{sweep}"),
    benchmark:
        PLAN.benchmark("sweep_plot", "-{sweep}")
    wildcard_constraints:
        sweep="theta|omega",
    threads: 1
    resources:
        **RESOURCES.of("sweep_plot"),
    params:
        **PLAN.params("sweep_plot", name=lambda wildcards: wildcards.sweep),
