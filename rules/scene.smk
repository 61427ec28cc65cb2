# Camera poses: structure from motion, or import.
use rule stage as source with:
    input:
        given(PLAN.data.source_files),
    output:
        out=directory("<results>/{dataset}/{scene}/source"),
    log:
        PLAN.log("source"),
    benchmark:
        PLAN.benchmark("source")
    priority: 10
    threads: 1
    resources:
        **RESOURCES.of("source"),
    params:
        **PLAN.params(
            "source",
            files=PLAN.data.source_files,
            plugins=lambda wildcards: readers_of([PLAN.data.source_name(wildcards)]),
            name=PLAN.data.source_name,
        ),


use rule stage as poses with:
    input:
        given(PLAN.data.image_files),
    output:
        out=directory("<results>/{dataset}/{scene}/scene"),
    log:
        PLAN.log("poses"),
    benchmark:
        PLAN.benchmark("poses")
    priority: 20
    resources:
        **RESOURCES.of("poses"),
    params:
        **PLAN.params("poses", files=PLAN.data.image_files, name=PLAN.data.name),
