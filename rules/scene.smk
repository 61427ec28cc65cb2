# Camera poses: structure from motion, or import.
rule source:
    input:
        source_files_of,
    output:
        directory("results/{dataset}/{scene}/source"),
    log:
        "results/{dataset}/{scene}/logs/source.log",
    benchmark:
        "results/{dataset}/{scene}/benchmarks/source.jsonl"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=4000,
    params:
        name=lambda wildcards: "/".join(published(row_of(wildcards).source)),
        root=str(Path(RUN.data_root)),
        code=code("source", reader_of_source),
    shell:
        "hilsplat datasets export {params.name:q} --data-root {params.root:q} --out {output} --log {log}"


rule poses:
    input:
        image_files_of,
    output:
        scene=directory("results/{dataset}/{scene}/scene"),
    log:
        "results/{dataset}/{scene}/logs/poses.log",
    benchmark:
        "results/{dataset}/{scene}/benchmarks/poses.jsonl"
    conda:
        ENVIRONMENT
    threads: THREADS
    resources:
        mem_mb=2000,
    params:
        images=images_of,
        unit=lambda wildcards: row_of(wildcards).unit,
        lens=lambda wildcards: (
            "--render" if row_of(wildcards).world else "--no-render"
        ),
        settings=settings_of("poses"),
        seed=RUN.seed,
        code=code("poses"),
    shell:
        "hilsplat poses --images {params.images:q} --name {wildcards.dataset}/{wildcards.scene}"
        " --unit {params.unit} {params.lens} --settings {params.settings:q} --seed {params.seed}"
        " --threads {threads} --out {output.scene} --log {log}"
