# hilsplat: 3D scenes with text queries at three levels, from photographs, and the paper's tables.
#
#   snakemake --cores 2                                             everything in the configuration
#   snakemake --cores 2 results/synthetic/table-1/gaussians.ply     one file and what it needs
#   snakemake --cores 2 tables                                      the tables
#   snakemake --report results/report.html                          the report of a finished run
#
# `hilsplat run` starts Snakemake with checks and all cores (docs/workflow.md). rules/common.smk reads
# config/config.yaml, because the `config:` of a `module:` would replace a configfile here.


report: "workflow/report/overview.rst"


include: "rules/common.smk"


pathvars:
    results=PLAN.run.results,


wildcard_constraints:
    dataset=any_of(row.dataset for row in PLAN.rows),
    scene=any_of(row.scene for row in PLAN.rows),
    variant=PLAN.variants(),


include: "rules/world.smk"


if (INSTALLED / "models/training").is_dir():  # only in a checkout

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
    mark_or_refuse()
    record_run(
        PLAN.results,
        workflow.config_settings.configfiles,
        workflow.config_settings.config,
    )
    for line in PLAN.ignored:
        logger.warning(line)
    for line in PLAN.model_lines():
        logger.info(line)


onsuccess:
    for line in targets.summary(PLAN):
        logger.info(line)
    unmark_run()


onerror:
    unmark_run()
