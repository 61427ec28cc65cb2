# Scores, tables, efficiency. Only here are label files read.
rule evaluate:
    input:
        scene="results/{dataset}/{scene}/scene",
        truth=truth_or_labels_of,
        gaussians="results/{dataset}/{scene}/gaussians.ply",
        semantic_tree=shared("semantic_tree", "semantic_tree"),
        field=shared("field", "field.safetensors"),
        autoencoder=shared("autoencoder", "autoencoder"),
        clip=shared("clip", "clip"),
        masks=shared("masks", "masks"),
    output:
        scores="results/{dataset}/{scene}/{variant}/scores.csv",
        times="results/{dataset}/{scene}/{variant}/times.csv",
    log:
        "results/{dataset}/{scene}/{variant}/logs/evaluate.log",
    benchmark:
        "results/{dataset}/{scene}/{variant}/benchmarks/evaluate.jsonl"
    conda:
        ENVIRONMENT
    threads: THREADS
    resources:
        mem_mb=4000,
    params:
        settings=settings_of("evaluate"),
        code=code("evaluate", readers_of),
        truth=truth_option_of,
    shell:
        "hilsplat evaluate --scene {input.scene} {params.truth} --gaussians {input.gaussians}"
        " --semantic-tree {input.semantic_tree} --field {input.field}"
        " --autoencoder {input.autoencoder} --clip {input.clip} --masks {input.masks}"
        " --dataset {wildcards.dataset} --name {wildcards.scene} --variant {wildcards.variant}"
        " --settings {params.settings:q} --threads {threads} --out {output.scores} --log {log}"


rule table:
    input:
        scores=lambda wildcards: scores_of(wildcards.table),
        published="config/published/{table}.csv",
    output:
        csv="results/tables/{table}.csv",
        md="results/tables/{table}.md",
        tex="results/tables/{table}.tex",
        html=report(
            "results/tables/{table}.html",
            caption="../workflow/report/table.rst",
            category="Tables",
            labels={"table": "{table}"},
        ),
    log:
        "results/logs/table-{table}.log",
    benchmark:
        "results/benchmarks/table-{table}.jsonl"
    wildcard_constraints:
        table="|".join(TABLES),
    conda:
        ENVIRONMENT
    resources:
        mem_mb=1000,
    params:
        labels=json.dumps(dict(RUN.labels)),
        absent=lambda wildcards: absent_of(wildcards.table),
        code=code("table"),
    shell:
        "hilsplat table {wildcards.table} --published {input.published} --labels {params.labels:q}"
        " {params.absent} --out {output.csv} --log {log} {input.scores}"


rule tables:
    input:
        targets_of_tables(),
