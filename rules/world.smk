# Synthetic scenes: images for the stages, truth for evaluate alone.
rule world:
    output:
        images=directory(SCENE + "/world/images"),
        truth=directory(SCENE + "/world/truth"),
    params:
        source=lambda wildcards: row_of(wildcards).source,
        settings=settings_of("world"),
        code=code("world"),
        out=SCENE + "/world",
    log:
        SCENE + "/logs/world.log",
    benchmark:
        SCENE + "/benchmarks/world.jsonl"
    threads: THREADS
    resources:
        mem_mb=2000,
    shell:
        "hilsplat world make --source {params.source:q} --settings {params.settings:q}"
        " --threads {threads} --out {params.out} --log {log}"
