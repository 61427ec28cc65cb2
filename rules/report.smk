# Pictures per scene and the report.
rule figures:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        fit="<results>/{dataset}/{scene}/gaussians",
        truth=given(PLAN.data.truth_or_labels),
        gaussians="<results>/{dataset}/{scene}/gaussians.ply",
        masks="<results>/{dataset}/{scene}/default/masks",
        clip="<results>/{dataset}/{scene}/default/clip",
        semantic_tree="<results>/{dataset}/{scene}/default/semantic_tree",
        field="<results>/{dataset}/{scene}/default/field.safetensors",
        autoencoder="<results>/{dataset}/{scene}/default/autoencoder",
    output:
        panel=report(
            "<results>/figures/{dataset}/{scene}/panel.png",
            caption="../workflow/report/panel.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "queries"},
        ),
        registration=report(
            "<results>/figures/{dataset}/{scene}/registration.png",
            caption="../workflow/report/registration.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "camera poses"},
        ),
        fit=report(
            "<results>/figures/{dataset}/{scene}/fit.png",
            caption="../workflow/report/fit.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "3D Gaussians"},
        ),
    log:
        "<results>/figures/{dataset}/{scene}/figures.log",
    benchmark:
        "<results>/{dataset}/{scene}/benchmarks/figures.jsonl"
    conda:
        ENVIRONMENT
    threads: RESOURCES.variant_threads
    resources:
        mem_mb=RESOURCES.memory_mb("figures"),
        runtime=RESOURCES.minutes("figures"),
    params:
        files=PLAN.data.content(PLAN.data.label_files),
        settings=PLAN.settings("figures"),
        evaluate=PLAN.settings("evaluate"),
        queries=PLAN.queries,
        truth=PLAN.data.figure_truth_option,
        code=PLAN.code("figures", PLAN.data.label_readers),
    shell:
        "python -m hilsplat --log {log:q} figures --scene {input.scene:q} {params.truth} --gaussians {input.gaussians:q}"
        " --fit {input.fit:q} --masks {input.masks:q} --clip {input.clip:q}"
        " --semantic-tree {input.semantic_tree:q} --field {input.field:q}"
        " --autoencoder {input.autoencoder:q} --queries {params.queries:q}"
        " --settings {params.settings:q} --evaluate {params.evaluate:q}"
        " --threads {threads} --out {output.panel:q}"


rule mask_truth:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        truth=PLAN.data.truth,
        masks="<results>/{dataset}/{scene}/default/masks",
    output:
        picture=report(
            "<results>/figures/{dataset}/{scene}/masks.png",
            caption="../workflow/report/masks.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "masks against the truth"},
        ),
        table="<results>/figures/{dataset}/{scene}/masks.csv",
    log:
        "<results>/figures/{dataset}/{scene}/masks.log",
    benchmark:
        "<results>/{dataset}/{scene}/benchmarks/mask_truth.jsonl"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=RESOURCES.memory_mb("mask_truth"),
        runtime=RESOURCES.minutes("mask_truth"),
    params:
        results=lambda wildcards, input: str(Path(input.scene).parents[2]),
        code=PLAN.code("mask_truth"),
    shell:
        "python -m hilsplat --log {log:q} world masks {wildcards.dataset:q}/{wildcards.scene:q} --results {params.results:q} --out {output.picture:q}"


rule comparison:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        truth=given(PLAN.data.truth_or_labels),
        gaussians="<results>/{dataset}/{scene}/gaussians.ply",
        masks=PLAN.compared("masks", "masks"),
        clip=PLAN.compared("clip", "clip"),
        semantic_tree=PLAN.compared("semantic_tree", "semantic_tree"),
        field=PLAN.compared("field", "field.safetensors"),
        autoencoder=PLAN.compared("autoencoder", "autoencoder"),
        scores=PLAN.compared_scores,  # their provenance records the settings of the queries
    output:
        methods=report(
            "<results>/figures/{dataset}/{scene}/comparison.png",
            caption="../workflow/report/comparison.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "queries by method"},
        ),
        views=report(
            "<results>/figures/{dataset}/{scene}/views.png",
            caption="../workflow/report/views.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "one query in several views"},
        ),
        features=report(
            "<results>/figures/{dataset}/{scene}/features.png",
            caption="../workflow/report/features.rst",
            category="Scenes",
            subcategory="{dataset}/{scene}",
            labels={"figure": "features at three levels"},
        ),
    log:
        "<results>/figures/{dataset}/{scene}/comparison.log",
    benchmark:
        "<results>/{dataset}/{scene}/benchmarks/comparison.jsonl"
    conda:
        ENVIRONMENT
    threads: RESOURCES.variant_threads
    resources:
        mem_mb=RESOURCES.memory_mb("comparison"),
        runtime=RESOURCES.minutes("comparison"),
    params:
        files=PLAN.data.content(PLAN.data.label_files),
        folder=lambda wildcards, input: str(Path(input.gaussians).parent),
        variants=json.dumps(PLAN.run.main_variants),
        names=PLAN.names,
        settings=PLAN.settings("figures"),
        evaluate=PLAN.settings("evaluate"),
        queries=PLAN.queries,
        truth=PLAN.data.figure_truth_option,
        code=PLAN.code("comparison", PLAN.data.label_readers),
    shell:
        "python -m hilsplat --log {log:q} comparison --folder {params.folder:q} --variants {params.variants:q}"
        " --names {params.names:q} {params.truth} --queries {params.queries:q}"
        " --settings {params.settings:q} --evaluate {params.evaluate:q}"
        " --threads {threads} --out {output.methods:q}"


rule sweep_plot:
    input:
        table="<results>/tables/{sweep}.csv",
    output:
        plot=report(
            "<results>/figures/sweep-{sweep}.png",
            caption="../workflow/report/sweep.rst",
            category="Sweeps",
            labels={"figure": "{sweep}"},
        ),
    log:
        "<results>/logs/sweep-{sweep}.log",
    benchmark:
        "<results>/benchmarks/sweep-{sweep}.jsonl"
    wildcard_constraints:
        sweep="theta|omega",
    conda:
        ENVIRONMENT
    resources:
        mem_mb=RESOURCES.memory_mb("sweep_plot"),
        runtime=RESOURCES.minutes("sweep_plot"),
    params:
        code=PLAN.code("sweep"),
    shell:
        "python -m hilsplat --log {log:q} sweep {wildcards.sweep:q} --table {input.table:q} --out {output.plot:q}"
