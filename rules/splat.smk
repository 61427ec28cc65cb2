# Base 3D Gaussian Splatting: a fit, or supplied Gaussians (column gaussians of the scene sheet).
rule gaussians:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        existing=given(PLAN.data.existing_gaussians),
    output:
        ply="<results>/{dataset}/{scene}/gaussians.ply",
        coordinates="<results>/{dataset}/{scene}/gaussians.json",
        report=directory("<results>/{dataset}/{scene}/gaussians"),
    log:
        "<results>/{dataset}/{scene}/logs/gaussians.log",
    benchmark:
        "<results>/{dataset}/{scene}/benchmarks/gaussians.jsonl"
    priority: 40
    conda:
        ENVIRONMENT
    threads: RESOURCES.threads
    resources:
        mem_mb=RESOURCES.memory_mb("gaussians"),
        runtime=RESOURCES.minutes("gaussians"),
        gpu=RESOURCES.gpus("gaussians"),
    params:
        files=PLAN.data.content(PLAN.data.existing_gaussians),
        settings=PLAN.settings("gaussians"),
        existing=PLAN.data.existing_gaussians_option,
        seed=PLAN.run.seed,
        cache=cache_folder,
        code=PLAN.code("gaussians"),
    shell:
        "python -m hilsplat --log {log:q} gaussians --scene {input.scene:q} --settings {params.settings:q} --seed {params.seed:q}"
        " {params.existing} --threads {threads} --cache {params.cache:q} --report {output.report:q}"
        " --out {output.ply:q}"
