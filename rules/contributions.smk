# Weights of each Gaussian in each mask, from one pass over the views.
rule contributions:
    input:
        scene="results/{dataset}/{scene}/scene",
        gaussians="results/{dataset}/{scene}/gaussians.ply",
        masks=PLAN.shared("masks", "masks"),
    output:
        contributions=directory("results/{dataset}/{scene}/{variant}/contributions"),
    log:
        "results/{dataset}/{scene}/{variant}/logs/contributions.log",
    benchmark:
        "results/{dataset}/{scene}/{variant}/benchmarks/contributions.jsonl"
    conda:
        ENVIRONMENT
    threads: THREADS
    resources:
        mem_mb=4000,
    params:
        settings=PLAN.settings("contributions"),
        cache="results/.cache",
        code=PLAN.code("contributions"),
    shell:
        "hilsplat contributions --scene {input.scene} --gaussians {input.gaussians} --masks {input.masks}"
        " --settings {params.settings:q} --threads {threads} --cache {params.cache}"
        " --out {output.contributions} --log {log}"
