# Pictures per scene and the report.
rule figures:
    input:
        scene="results/{dataset}/{scene}/scene",
        fit="results/{dataset}/{scene}/gaussians",
        truth=truth_of,
        gaussians="results/{dataset}/{scene}/gaussians.ply",
        masks="results/{dataset}/{scene}/default/masks",
        clip="results/{dataset}/{scene}/default/clip",
        semantic_tree="results/{dataset}/{scene}/default/semantic_tree",
        language="results/{dataset}/{scene}/default/language.safetensors",
        autoencoder="results/{dataset}/{scene}/default/autoencoder",
    output:
        panel=report(
            "results/figures/{dataset}/{scene}/panel.png",
            caption="../workflow/report/panel.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "queries"},
        ),
        registration=report(
            "results/figures/{dataset}/{scene}/registration.png",
            caption="../workflow/report/registration.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "camera poses"},
        ),
        fit=report(
            "results/figures/{dataset}/{scene}/fit.png",
            caption="../workflow/report/fit.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "3D Gaussians"},
        ),
    log:
        "results/figures/{dataset}/{scene}/figures.log",
    benchmark:
        "results/{dataset}/{scene}/benchmarks/figures.jsonl"
    conda:
        ENVIRONMENT
    threads: THREADS
    resources:
        mem_mb=4000,
    params:
        settings=settings_of("figures"),
        evaluate=settings_of("evaluate"),
        queries=queries_of,
        truth=lambda wildcards, input: f"--truth {input.truth}" if input.truth else "",
        code=code("figures"),
    shell:
        "hilsplat figures --scene {input.scene} {params.truth} --gaussians {input.gaussians}"
        " --fit {input.fit} --masks {input.masks} --clip {input.clip}"
        " --semantic-tree {input.semantic_tree} --language {input.language}"
        " --autoencoder {input.autoencoder} --queries {params.queries:q}"
        " --settings {params.settings:q} --evaluate {params.evaluate:q}"
        " --threads {threads} --out {output.panel} --log {log}"
