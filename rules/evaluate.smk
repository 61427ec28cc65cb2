# Scores and tables. Only evaluation and figures read the labels of data sets.
rule evaluate:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        truth=given(PLAN.data.truth_or_labels),
        gaussians="<results>/{dataset}/{scene}/gaussians.ply",
        semantic_tree=PLAN.shared("semantic_tree", "semantic_tree"),
        field=PLAN.shared("field", "field.safetensors"),
        autoencoder=PLAN.shared("autoencoder", "autoencoder"),
        clip=PLAN.shared("clip", "clip"),
        masks=PLAN.shared("masks", "masks"),
    output:
        scores="<results>/{dataset}/{scene}/{variant}/scores.csv",
        times="<results>/{dataset}/{scene}/{variant}/times.csv",
        instances="<results>/{dataset}/{scene}/{variant}/instances.npz",
    log:
        "<results>/{dataset}/{scene}/{variant}/logs/evaluate.log",
    benchmark:
        "<results>/{dataset}/{scene}/{variant}/benchmarks/evaluate.jsonl"
    priority: 2
    conda:
        ENVIRONMENT
    threads: RESOURCES.variant_threads
    resources:
        mem_mb=RESOURCES.memory_mb("evaluate"),
        runtime=RESOURCES.minutes("evaluate"),
    params:
        files=PLAN.data.content(PLAN.data.label_files),
        settings=PLAN.settings("evaluate"),
        code=PLAN.code("evaluate", PLAN.data.label_readers),
        truth=PLAN.data.truth_option,
    shell:
        "python -m hilsplat --log {log:q} evaluate --scene {input.scene:q} {params.truth} --gaussians {input.gaussians:q}"
        " --semantic-tree {input.semantic_tree:q} --field {input.field:q}"
        " --autoencoder {input.autoencoder:q} --clip {input.clip:q} --masks {input.masks:q}"
        " --dataset {wildcards.dataset:q} --name {wildcards.scene:q} --variant {wildcards.variant:q}"
        " --settings {params.settings:q} --threads {threads} --out {output.scores:q}"


rule table:
    input:
        scores=lambda wildcards: targets.scores(PLAN, wildcards.table, "scores.csv"),
        times=lambda wildcards: targets.scores(PLAN, wildcards.table, "times.csv"),
        instances=lambda wildcards: targets.scores(
            PLAN, wildcards.table, "instances.npz"
        ),
        published=lambda wildcards: str(published_values(wildcards.table)),
    output:
        csv="<results>/tables/{table}.csv",
        md="<results>/tables/{table}.md",
        tex="<results>/tables/{table}.tex",
        html=report(
            "<results>/tables/{table}.html",
            caption="../workflow/report/table.rst",
            category="Tables",
            labels={"table": "{table}"},
        ),
    log:
        "<results>/logs/table-{table}.log",
    benchmark:
        "<results>/benchmarks/table-{table}.jsonl"
    wildcard_constraints:
        table=any_of(TABLES),
    conda:
        ENVIRONMENT
    resources:
        mem_mb=RESOURCES.memory_mb("table"),
        runtime=RESOURCES.minutes("table"),
    params:
        labels=PLAN.names,
        absent=lambda wildcards: targets.absent_options(PLAN, wildcards.table),
        code=PLAN.code("table"),
    shell:
        "python -m hilsplat --log {log:q} table {wildcards.table:q} --published {input.published:q} --labels {params.labels:q}"
        " {params.absent} --out {output.csv:q} {input.scores:q}"


rule tables:
    input:
        targets.tables(PLAN),


# Times and memory of the jobs of finished runs, from their benchmark files.
rule efficiency:
    input:
        targets.default(PLAN),
    output:
        csv="<results>/efficiency.csv",
        md="<results>/efficiency.md",
    log:
        "<results>/logs/efficiency.log",
    conda:
        ENVIRONMENT
    resources:
        mem_mb=RESOURCES.memory_mb("efficiency"),
        runtime=RESOURCES.minutes("efficiency"),
    params:
        results=lambda wildcards, output: str(Path(output.csv).parent),
        code=PLAN.code("efficiency"),
    shell:
        "python -m hilsplat --log {log:q} efficiency --results {params.results:q} --out {output.csv:q}"
