# Base 3D Gaussian Splatting.
rule gaussians:
    input:
        scene="results/{dataset}/{scene}/scene",
    output:
        ply="results/{dataset}/{scene}/gaussians.ply",
        report=directory("results/{dataset}/{scene}/gaussians"),
    log:
        "results/{dataset}/{scene}/logs/gaussians.log",
    benchmark:
        "results/{dataset}/{scene}/benchmarks/gaussians.jsonl"
    conda:
        ENVIRONMENT
    threads: THREADS
    resources:
        mem_mb=3000,
    params:
        settings=settings_of("gaussians"),
        seed=RUN.seed,
        cache="results/.cache",
        code=code("gaussians"),
    shell:
        "hilsplat gaussians --scene {input.scene} --settings {params.settings:q} --seed {params.seed}"
        " --threads {threads} --cache {params.cache} --report {output.report} --out {output.ply} --log {log}"
