# Camera poses: structure from motion, or import.
rule source:
    input:
        checked(PLAN.data.source_files),
    output:
        directory(update("results/{dataset}/{scene}/source")),
    log:
        "results/{dataset}/{scene}/logs/source.log",
    benchmark:
        "results/{dataset}/{scene}/benchmarks/source.jsonl"
    priority: 10
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=RESOURCES.memory_mb("source"),
        runtime=RESOURCES.minutes("source"),
    params:
        name=PLAN.data.source_name,
        root=str(Path(PLAN.run.data_root)),
        code=PLAN.code("source", PLAN.data.source_reader),
    shell:
        "hilsplat datasets export {params.name:q} --data-root {params.root:q} --out {output:q} --log {log:q}"


rule poses:
    input:
        checked(PLAN.data.image_files),
    output:
        scene=directory(update("results/{dataset}/{scene}/scene")),
    log:
        "results/{dataset}/{scene}/logs/poses.log",
    benchmark:
        "results/{dataset}/{scene}/benchmarks/poses.jsonl"
    priority: 20
    conda:
        ENVIRONMENT
    threads: THREADS
    resources:
        mem_mb=RESOURCES.memory_mb("poses"),
        runtime=RESOURCES.minutes("poses"),
    params:
        images=PLAN.data.images,
        unit=lambda wildcards: PLAN.row(wildcards).unit,
        lens=PLAN.data.lens,
        settings=PLAN.settings("poses"),
        seed=PLAN.run.seed,
        code=PLAN.code("poses"),
    shell:
        "hilsplat poses --images {params.images:q} --name {wildcards.dataset:q}/{wildcards.scene:q}"
        " --unit {params.unit:q} {params.lens} --settings {params.settings:q} --seed {params.seed:q}"
        " --threads {threads} --out {output.scene:q} --log {log:q}"
