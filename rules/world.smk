# Synthetic scenes: images for the stages, ground truth for evaluation, figures and the diagnostic segmenter.
rule world:
    output:
        images=directory("<results>/{dataset}/{scene}/world/images"),
        truth=directory("<results>/{dataset}/{scene}/world/truth"),
    log:
        "<results>/{dataset}/{scene}/logs/world.log",
    benchmark:
        "<results>/{dataset}/{scene}/benchmarks/world.jsonl"
    priority: 10
    conda:
        ENVIRONMENT
    threads: RESOURCES.threads
    resources:
        mem_mb=RESOURCES.memory_mb("world"),
        runtime=RESOURCES.minutes("world"),
    params:
        source=lambda wildcards: PLAN.row(wildcards).source,
        settings=PLAN.settings("world"),
        code=PLAN.code("world"),
        out=lambda wildcards, output: str(Path(output.images).parent),
    shell:
        "python -m hilsplat --log {log:q} world make --source {params.source:q} --settings {params.settings:q}"
        " --threads {threads} --out {params.out:q}"
