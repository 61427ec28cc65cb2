# Pictures per scene and the report.
def targets_of_figures():
    return [
        path
        for row in SCENES
        for path in (
            f"{RESULTS}/figures/{row.dataset}/{row.scene}/panel.png",
        )
    ]


def queries_of(wildcards):
    return json.dumps(RUN.queries.get(f"{wildcards.dataset}/{wildcards.scene}", ()))


rule figures:
    input:
        scene=SCENE + "/scene",
        fit=SCENE + "/gaussians",
        truth=lambda wildcards: (
            [f"{RESULTS}/{wildcards.dataset}/{wildcards.scene}/world/truth"]
            if is_world(row_of(wildcards))
            else []
        ),
        gaussians=SCENE + "/gaussians.ply",
        masks=SCENE + "/default/masks",
        clip=SCENE + "/default/clip",
        semantic_tree=SCENE + "/default/semantic_tree",
        language=SCENE + "/default/language.safetensors",
        autoencoder=SCENE + "/default/autoencoder",
    output:
        panel=report(
            RESULTS + "/figures/{dataset}/{scene}/panel.png",
            caption="../workflow/report/panel.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "queries"},
        ),
        registration=report(
            RESULTS + "/figures/{dataset}/{scene}/registration.png",
            caption="../workflow/report/registration.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "camera poses"},
        ),
        fit=report(
            RESULTS + "/figures/{dataset}/{scene}/fit.png",
            caption="../workflow/report/fit.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "3D Gaussians"},
        ),
    params:
        settings=settings_of("figures"),
        evaluate=settings_of("evaluate"),
        queries=queries_of,
        truth=lambda wildcards, input: f"--truth {input.truth}" if input.truth else "",
        code=code("figures"),
    log:
        RESULTS + "/figures/{dataset}/{scene}/figures.log",
    benchmark:
        SCENE + "/benchmarks/figures.jsonl"
    threads: THREADS
    resources:
        mem_mb=4000,
    shell:
        "hilsplat figures --scene {input.scene} {params.truth} --gaussians {input.gaussians}"
        " --fit {input.fit} --masks {input.masks} --clip {input.clip}"
        " --semantic-tree {input.semantic_tree} --language {input.language}"
        " --autoencoder {input.autoencoder} --queries {params.queries:q}"
        " --settings {params.settings:q} --evaluate {params.evaluate:q}"
        " --threads {threads} --out {output.panel} --log {log}"
