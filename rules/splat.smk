# Base 3D Gaussian Splatting.
rule gaussians:
    input:
        scene=SCENE + "/scene",
    output:
        ply=SCENE + "/gaussians.ply",
        report=directory(SCENE + "/gaussians"),
    params:
        settings=settings_of("gaussians"),
        seed=RUN.seed,
        cache=CACHE,
        code=code("gaussians"),
    log:
        SCENE + "/logs/gaussians.log",
    benchmark:
        SCENE + "/benchmarks/gaussians.jsonl"
    threads: THREADS
    resources:
        mem_mb=3000,
    shell:
        "hilsplat gaussians --scene {input.scene} --settings {params.settings:q} --seed {params.seed}"
        " --threads {threads} --cache {params.cache} --report {output.report} --out {output.ply} --log {log}"
