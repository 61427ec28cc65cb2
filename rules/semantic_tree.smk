# A tree of nodes in 3D: masks linked across views, or Gaussians clustered by features.
use rule stage as semantic_tree with:
    input:
        **PLAN.inputs("semantic_tree"),
    output:
        out=directory("<results>/{dataset}/{scene}/{variant}/semantic_tree"),
    log:
        PLAN.log("semantic_tree"),
    benchmark:
        PLAN.benchmark("semantic_tree")
    wildcard_constraints:
        dataset=PLAN.jobs_of("semantic_tree"),
    priority: 70
    resources:
        **RESOURCES.of("semantic_tree"),
    params:
        **PLAN.params("semantic_tree"),


use rule semantic_tree as feature_tree with:
    input:
        **PLAN.inputs("feature_tree"),
    wildcard_constraints:
        dataset=PLAN.jobs_of("feature_tree"),
    params:
        **PLAN.params("feature_tree"),
