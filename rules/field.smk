# The autoencoder of the scene's CLIP vectors, and the language field: ours, or that of a baseline.
use rule stage as autoencoder with:
    input:
        **PLAN.inputs("autoencoder"),
        code=PLAN.first_code,  # empty, except for levels by the coverage tree
    output:
        out=directory("<results>/{dataset}/{scene}/{variant}/autoencoder"),
    log:
        PLAN.log("autoencoder"),
    benchmark:
        PLAN.benchmark("autoencoder")
    priority: 8
    threads: 1
    resources:
        **RESOURCES.of("autoencoder"),
    params:
        **PLAN.params("autoencoder"),


use rule stage as field with:
    input:
        **PLAN.inputs("field"),
        start=PLAN.first_field,  # empty, except for start: langsplat
    output:
        out="<results>/{dataset}/{scene}/{variant}/field.safetensors",
    log:
        PLAN.log("field"),
    benchmark:
        PLAN.benchmark("field")
    wildcard_constraints:
        dataset=PLAN.jobs_of("field"),
    priority: 4
    threads: RESOURCES.variant_threads
    resources:
        **RESOURCES.of("field"),
    params:
        **PLAN.params("field"),


use rule stage as method with:
    input:
        **PLAN.inputs("method"),
        scene="<results>/{dataset}/{scene}/scene",
        gaussians="<results>/{dataset}/{scene}/gaussians.ply",
    output:
        out="<results>/{dataset}/{scene}/{variant}/field.safetensors",
    log:
        PLAN.log("method"),
    benchmark:
        PLAN.benchmark("method")
    wildcard_constraints:
        dataset=PLAN.jobs_of("method"),
    priority: 6
    threads: RESOURCES.variant_threads
    resources:
        **RESOURCES.of("method"),
    params:
        **PLAN.params("method", plugins=PLAN.baseline),
