# Weights of each Gaussian in each mask, from one pass over the views.
rule contributions:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        gaussians="<results>/{dataset}/{scene}/gaussians.ply",
        masks=PLAN.shared("masks", "masks"),
    output:
        contributions=directory("<results>/{dataset}/{scene}/{variant}/contributions"),
    log:
        "<results>/{dataset}/{scene}/{variant}/logs/contributions.log",
    benchmark:
        "<results>/{dataset}/{scene}/{variant}/benchmarks/contributions.jsonl"
    priority: 60
    conda:
        ENVIRONMENT
    threads: RESOURCES.threads
    resources:
        mem_mb=RESOURCES.memory_mb("contributions"),
        runtime=RESOURCES.minutes("contributions"),
        gpu=RESOURCES.gpus("contributions"),
    params:
        settings=PLAN.settings("contributions"),
        cache=cache_folder,
        code=PLAN.code("contributions"),
    shell:
        "python -m hilsplat --log {log:q} contributions --scene {input.scene:q} --gaussians {input.gaussians:q} --masks {input.masks:q}"
        " --settings {params.settings:q} --threads {threads} --cache {params.cache:q}"
        " --out {output.contributions:q}"
