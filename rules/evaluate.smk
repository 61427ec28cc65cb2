# Scores and tables. Only evaluation and figures read the labels of data sets.
use rule stage as evaluate with:
    input:
        **PLAN.inputs("evaluate"),
        scene="<results>/{dataset}/{scene}/scene",
        gaussians="<results>/{dataset}/{scene}/gaussians.ply",
        truth=PLAN.data.truth,  # empty, except for a generated scene
        labels=given(PLAN.data.label_files),
    output:
        out="<results>/{dataset}/{scene}/{variant}/scores.csv",
        times="<results>/{dataset}/{scene}/{variant}/times.csv",
        instances="<results>/{dataset}/{scene}/{variant}/instances.npz",
    log:
        PLAN.log("evaluate"),
    benchmark:
        PLAN.benchmark("evaluate")
    priority: 2
    threads: RESOURCES.variant_threads
    resources:
        **RESOURCES.of("evaluate"),
    params:
        **PLAN.params("evaluate", **SCORED, name=lambda wildcards: wildcards.scene),


use rule stage as score_means with:
    input:
        scores=lambda wildcards: targets.compared_means(PLAN, wildcards),
    output:
        out="<results>/{dataset}/{scene}/scores.md",
        csv="<results>/{dataset}/{scene}/scores.csv",
    log:
        PLAN.log("score_means"),
    benchmark:
        PLAN.benchmark("score_means")
    priority: 2
    threads: 1
    resources:
        **RESOURCES.of("score_means"),
    params:
        **PLAN.params("score_means"),


use rule stage as table with:
    input:
        scores=lambda job: targets.scores(PLAN, job.table),
        times=lambda job: targets.scores(PLAN, job.table, "times.csv"),
        instances=lambda job: targets.scores(PLAN, job.table, "instances.npz"),
        published=lambda job: str(published_values(job.table)),
    output:
        out="<results>/tables/{table}.csv",
        md="<results>/tables/{table}.md",
        tex="<results>/tables/{table}.tex",
        html=picture("<results>/tables/{table}.html", "Tables", "table"),
    log:
        PLAN.log("table", "-{table}"),
    benchmark:
        PLAN.benchmark("table", "-{table}")
    wildcard_constraints:
        table=any_of(TABLES),
    threads: 1
    resources:
        **RESOURCES.of("table"),
    params:
        **PLAN.params(
            "table",
            plugins=lambda wildcards: READERS,
            name=lambda wildcards: wildcards.table,
            labels=PLAN.names,
            absent=lambda wildcards: targets.absent(PLAN, wildcards.table),
        ),


rule tables:
    input:
        targets.tables(PLAN),


use rule stage as efficiency with:
    input:
        targets.default(PLAN),
    output:
        out="<results>/efficiency.csv",
        md="<results>/efficiency.md",
    log:
        PLAN.log("efficiency"),
    benchmark:
        PLAN.benchmark("efficiency")
    threads: 1
    resources:
        **RESOURCES.of("efficiency"),
    params:
        **PLAN.params("efficiency"),
