# CLIP vectors of the crops that show each node best, or of every mask; names of nodes from a vocabulary.
use rule stage as clip with:
    input:
        **PLAN.inputs("clip"),
        scene="<results>/{dataset}/{scene}/scene",
        semantic_tree=PLAN.crops_tree,  # empty if every mask is embedded
    output:
        out=directory("<results>/{dataset}/{scene}/{variant}/clip"),
    log:
        PLAN.log("clip"),
    benchmark:
        PLAN.benchmark("clip")
    wildcard_constraints:
        dataset=PLAN.jobs_of("clip"),
    priority: 80
    resources:
        **RESOURCES.of("clip"),
    params:
        **PLAN.params("clip"),


use rule clip as imported_clip with:
    input:
        **PLAN.inputs("imported_clip"),
        scene="<results>/{dataset}/{scene}/scene",
        files=given(PLAN.data.features),
    wildcard_constraints:
        dataset=PLAN.jobs_of("imported_clip"),
    params:
        **PLAN.params("imported_clip", **FEATURES),


use rule stage as names with:
    input:
        **PLAN.inputs("names"),
        vocabulary=given(PLAN.vocabulary),  # empty, unless you supply a file
    output:
        out=directory("<results>/{dataset}/{scene}/{variant}/names"),
    log:
        PLAN.log("names"),
    benchmark:
        PLAN.benchmark("names")
    threads: 1
    resources:
        **RESOURCES.of("names"),
    params:
        **PLAN.params("names", files=PLAN.vocabulary),
