# Camera poses: structure from motion, or import.
rule source:
    input:
        given(PLAN.data.source_files),
    output:
        directory("<results>/{dataset}/{scene}/source"),
    log:
        "<results>/{dataset}/{scene}/logs/source.log",
    benchmark:
        "<results>/{dataset}/{scene}/benchmarks/source.jsonl"
    priority: 10
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=RESOURCES.memory_mb("source"),
        runtime=RESOURCES.minutes("source"),
    params:
        files=PLAN.data.content(PLAN.data.source_files),
        name=PLAN.data.source_name,
        root=str(Path(PLAN.run.data_root)),
        code=PLAN.code("source", PLAN.data.source_reader),
    shell:
        "python -m hilsplat --log {log:q} datasets export {params.name:q} --data-root {params.root:q} --out {output:q}"


rule poses:
    input:
        given(PLAN.data.image_files),
    output:
        scene=directory("<results>/{dataset}/{scene}/scene"),
    log:
        "<results>/{dataset}/{scene}/logs/poses.log",
    benchmark:
        "<results>/{dataset}/{scene}/benchmarks/poses.jsonl"
    priority: 20
    conda:
        ENVIRONMENT
    threads: RESOURCES.threads
    resources:
        mem_mb=RESOURCES.memory_mb("poses"),
        runtime=RESOURCES.minutes("poses"),
    params:
        files=PLAN.data.content(PLAN.data.image_files),
        images=PLAN.data.images,
        unit=lambda wildcards: PLAN.row(wildcards).unit,
        poses=PLAN.data.poses_option,
        settings=PLAN.settings("poses"),
        seed=PLAN.run.seed,
        code=PLAN.code("poses"),
    shell:
        "python -m hilsplat --log {log:q} poses --images {params.images:q} --name {wildcards.dataset:q}/{wildcards.scene:q}"
        " --unit {params.unit:q} {params.poses} --settings {params.settings:q} --seed {params.seed:q}"
        " --threads {threads} --out {output.scene:q}"
