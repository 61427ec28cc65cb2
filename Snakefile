# hilsplat: photographs to 3D scenes that answer text queries at three levels, and the paper's tables.
#
#   snakemake --cores 2                                             everything the configuration names
#   snakemake --cores 2 results/synthetic/table-1/gaussians.ply     one file and what it needs
#   snakemake --cores 2 tables                                      the tables
#   snakemake --report results/report.html                          the report of a finished run


from pathlib import Path

from hilsplat.configuration import read_config

if Path("config/config.yaml").is_file():
    read_config(
        Path("config/config.yaml")
    )  # its message has the line, which Snakemake's has not


configfile: "config/config.yaml"


report: "workflow/report/overview.rst"


include: "rules/common.smk"
include: "rules/progress.smk"


wildcard_constraints:
    dataset=PLAN.datasets(),
    scene=PLAN.scene_names(),
    variant=PLAN.variants(),


include: "rules/world.smk"
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


onstart:
    refuse_infeasible()
    for line in PLAN.answering():
        logger.info(line)
    show_progress()


onsuccess:
    shell("hilsplat efficiency --results results --out results/efficiency.csv")
