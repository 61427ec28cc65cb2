# Camera poses: structure from motion, or import.
def images_of(wildcards):
    row = row_of(wildcards)
    return f"{RESULTS}/{row.dataset}/{row.scene}/world/images" if is_world(row) else row.source


rule poses:
    input:
        lambda wildcards: images_of(wildcards) if is_world(row_of(wildcards)) else photos_of(wildcards),
    output:
        scene=directory(SCENE + "/scene"),
    params:
        images=images_of,
        unit=lambda wildcards: row_of(wildcards).unit,
        lens=lambda wildcards: "--render" if is_world(row_of(wildcards)) else "--no-render",
        settings=settings_of("poses"),
        seed=RUN.seed,
        code=code("poses"),
    log:
        SCENE + "/logs/poses.log",
    benchmark:
        SCENE + "/benchmarks/poses.jsonl"
    threads: THREADS
    resources:
        mem_mb=2000,
    shell:
        "hilsplat poses --images {params.images:q} --name {wildcards.dataset}/{wildcards.scene}"
        " --unit {params.unit} {params.lens} --settings {params.settings:q} --seed {params.seed}"
        " --threads {threads} --out {output.scene} --log {log}"
