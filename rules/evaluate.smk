# Scores and tables. Only evaluation and figures read the labels of data sets.
rule evaluate:
    input:
        scene="results/{dataset}/{scene}/scene",
        truth=PLAN.data.truth_or_labels,
        gaussians="results/{dataset}/{scene}/gaussians.ply",
        semantic_tree=PLAN.shared("semantic_tree", "semantic_tree"),
        field=PLAN.shared("field", "field.safetensors"),
        autoencoder=PLAN.shared("autoencoder", "autoencoder"),
        clip=PLAN.shared("clip", "clip"),
        masks=PLAN.shared("masks", "masks"),
    output:
        scores=update("results/{dataset}/{scene}/{variant}/scores.csv"),
        times=update("results/{dataset}/{scene}/{variant}/times.csv"),
    log:
        "results/{dataset}/{scene}/{variant}/logs/evaluate.log",
    benchmark:
        "results/{dataset}/{scene}/{variant}/benchmarks/evaluate.jsonl"
    priority: 2
    conda:
        ENVIRONMENT
    threads: VARIANT_THREADS
    resources:
        mem_mb=RESOURCES.memory_mb("evaluate"),
        runtime=RESOURCES.minutes("evaluate"),
    params:
        settings=PLAN.settings("evaluate"),
        code=PLAN.code("evaluate", PLAN.data.label_readers),
        truth=PLAN.data.truth_option,
    shell:
        "hilsplat evaluate --scene {input.scene:q} {params.truth} --gaussians {input.gaussians:q}"
        " --semantic-tree {input.semantic_tree:q} --field {input.field:q}"
        " --autoencoder {input.autoencoder:q} --clip {input.clip:q} --masks {input.masks:q}"
        " --dataset {wildcards.dataset:q} --name {wildcards.scene:q} --variant {wildcards.variant:q}"
        " --settings {params.settings:q} --threads {threads} --out {output.scores:q} --log {log:q}"


rule table:
    input:
        scores=lambda wildcards: targets.scores(PLAN, wildcards.table),
        published=lambda wildcards: str(published_values(wildcards.table)),
    output:
        csv=update("results/tables/{table}.csv"),
        md=update("results/tables/{table}.md"),
        tex=update("results/tables/{table}.tex"),
        html=report(
            update("results/tables/{table}.html"),
            caption="../workflow/report/table.rst",
            category="Tables",
            labels={"table": "{table}"},
        ),
    log:
        "results/logs/table-{table}.log",
    benchmark:
        "results/benchmarks/table-{table}.jsonl"
    wildcard_constraints:
        table=any_of(TABLES),
    conda:
        ENVIRONMENT
    resources:
        mem_mb=RESOURCES.memory_mb("table"),
        runtime=RESOURCES.minutes("table"),
    params:
        labels=PLAN.names(),
        absent=lambda wildcards: targets.absent_options(PLAN, wildcards.table),
        code=PLAN.code("table"),
    shell:
        "hilsplat table {wildcards.table:q} --published {input.published:q} --labels {params.labels:q}"
        " {params.absent} --out {output.csv:q} --log {log:q} {input.scores:q}"


rule tables:
    input:
        targets.tables(PLAN),
