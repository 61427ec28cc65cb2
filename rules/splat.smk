# Base 3D Gaussian Splatting: a fit, or supplied Gaussians (column gaussians of the scene sheet).
rule gaussians:
    input:
        scene="results/{dataset}/{scene}/scene",
        brought=PLAN.data.brought,
    output:
        ply=update("results/{dataset}/{scene}/gaussians.ply"),
        coordinates=update("results/{dataset}/{scene}/gaussians.json"),
        report=directory(update("results/{dataset}/{scene}/gaussians")),
    log:
        "results/{dataset}/{scene}/logs/gaussians.log",
    benchmark:
        "results/{dataset}/{scene}/benchmarks/gaussians.jsonl"
    priority: 40
    conda:
        ENVIRONMENT
    threads: THREADS
    resources:
        mem_mb=RESOURCES.memory_mb("gaussians"),
        runtime=RESOURCES.minutes("gaussians"),
        gpu=RESOURCES.gpus("gaussians"),
    params:
        settings=PLAN.settings("gaussians"),
        brought=PLAN.data.brought_option,
        seed=PLAN.run.seed,
        cache="results/.cache",
        code=PLAN.code("gaussians"),
    shell:
        "hilsplat gaussians --scene {input.scene:q} --settings {params.settings:q} --seed {params.seed:q}"
        " {params.brought} --threads {threads} --cache {params.cache:q} --report {output.report:q}"
        " --out {output.ply:q} --log {log:q}"
