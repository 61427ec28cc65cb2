# Weights of each Gaussian in each mask, from one pass over the views.
use rule stage as contributions with:
    input:
        **PLAN.inputs("contributions"),
        scene="<results>/{dataset}/{scene}/scene",
        gaussians="<results>/{dataset}/{scene}/gaussians.ply",
    output:
        out=directory("<results>/{dataset}/{scene}/{variant}/contributions"),
    log:
        PLAN.log("contributions"),
    benchmark:
        PLAN.benchmark("contributions")
    priority: 60
    resources:
        **RESOURCES.of("contributions"),
    params:
        **PLAN.params("contributions"),
