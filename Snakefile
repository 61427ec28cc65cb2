# hilsplat: photographs to 3D scenes that answer text queries at three levels, and the paper's tables.
#
#   snakemake --cores 2                                             everything that the configuration names
#   snakemake --cores 2 results/synthetic/table-1/gaussians.ply     one file and what it needs
#   snakemake --cores 2 tables                                      the tables
#   snakemake --report results/report.html                          the report of a finished run
#
# `hilsplat run` starts it with checks and all cores (docs/workflow.md). rules/common.smk reads config/config.yaml, also
# for a `module:`, whose `config:` takes the place of any configfile here.


report: "workflow/report/overview.rst"


include: "rules/common.smk"


pathvars:
    results=PLAN.run.results,


wildcard_constraints:
    dataset=any_of(row.dataset for row in PLAN.rows),
    scene=any_of(row.scene for row in PLAN.rows),
    variant=PLAN.variants(),


include: "rules/world.smk"


if (INSTALLED / "models/training").is_dir():  # of a checkout

    include: "rules/models.smk"


include: "rules/scene.smk"
include: "rules/splat.smk"
include: "rules/segment.smk"
include: "rules/embed.smk"
include: "rules/contributions.smk"
include: "rules/semantic_tree.smk"
include: "rules/field.smk"
include: "rules/methods.smk"
include: "rules/evaluate.smk"
include: "rules/report.smk"


rule all:
    default_target: True
    input:
        targets.default(PLAN),
        rules.efficiency.output,


onstart:
    mark_run()
    for line in PLAN.model_lines():
        logger.info(line)


onsuccess:
    for line in targets.summary(PLAN):
        logger.info(line)
    unmark_run()


onerror:
    unmark_run()
