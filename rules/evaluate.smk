# Scores, tables, efficiency. Only here are label files read.
def labelled(rows):
    return [row for row in rows if is_world(row)]


def scores_of(variants):
    """Score files of all labelled scenes for some variants."""
    return [
        f"{RESULTS}/{row.dataset}/{row.scene}/{variant}/scores.csv"
        for row in labelled(SCENES)
        for variant in variants
    ]


TABLES = {
    "hierarchy": RUN.main_variants,
    "lerf": RUN.main_variants,
    "ablation": RUN.ablation_variants,
}
FORMATS = ("csv", "md", "tex", "html")


def targets_of_tables():
    """Tables that the configured scenes can fill; none where no scene has labels."""
    if not labelled(SCENES):
        return []
    return [f"{RESULTS}/tables/{name}.csv" for name, variants in TABLES.items() if variants]


rule evaluate:
    input:
        scene=SCENE + "/scene",
        truth=SCENE + "/world/truth",
        gaussians=SCENE + "/gaussians.ply",
        semantic_tree=shared("semantic_tree", "semantic_tree"),
        language=shared("language", "language.safetensors"),
        autoencoder=shared("autoencoder", "autoencoder"),
        clip=shared("clip", "clip"),
        masks=shared("masks", "masks"),
    output:
        scores=VARIANT + "/scores.csv",
    params:
        settings=settings_of("evaluate"),
        code=code("evaluate"),
    log:
        VARIANT + "/logs/evaluate.log",
    benchmark:
        VARIANT + "/benchmarks/evaluate.jsonl"
    threads: THREADS
    resources:
        mem_mb=4000,
    shell:
        "hilsplat evaluate --scene {input.scene} --truth {input.truth} --gaussians {input.gaussians}"
        " --semantic-tree {input.semantic_tree} --language {input.language}"
        " --autoencoder {input.autoencoder} --clip {input.clip} --masks {input.masks}"
        " --dataset {wildcards.dataset} --name {wildcards.scene} --variant {wildcards.variant}"
        " --settings {params.settings:q} --threads {threads} --out {output.scores} --log {log}"


rule table:
    input:
        scores=lambda wildcards: scores_of(TABLES[wildcards.table]),
        published="config/published/{table}.csv",
    output:
        csv=RESULTS + "/tables/{table}.csv",
        md=RESULTS + "/tables/{table}.md",
        tex=RESULTS + "/tables/{table}.tex",
        html=report(
            RESULTS + "/tables/{table}.html",
            caption="../workflow/report/{table}.rst",
            category="Tables",
            labels={"table": "{table}"},
        ),
    wildcard_constraints:
        table="|".join(TABLES),
    params:
        labels=json.dumps(dict(RUN.labels)),
        code=code("tables"),
    log:
        RESULTS + "/logs/table-{table}.log",
    benchmark:
        RESULTS + "/benchmarks/table-{table}.jsonl"
    resources:
        mem_mb=1000,
    shell:
        "hilsplat table {wildcards.table} --published {input.published} --labels {params.labels:q}"
        " --out {output.csv} --log {log} {input.scores}"


rule tables:
    input:
        targets_of_tables(),
