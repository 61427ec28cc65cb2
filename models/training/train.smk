from pathlib import Path

from hilsplat.base.lineage import sha256_of_bytes


# The small models of the synthetic world. A default run does not train them, because the repository contains them.
rule train_models:
    output:
        directory("<results>/models/sam-tiny"),
        directory("<results>/models/clip-tiny"),
    log:
        "<results>/models/train.log",
    conda:
        "../../workflow/envs/hilsplat.yaml"
    threads: 64  # Snakemake lowers this to the number of cores
    resources:
        mem_mb=8700,
    params:
        checkout=str(INSTALLED),
        seed=PLAN.run.seed,
        code=sha256_of_bytes(
            *(
                path.read_bytes()
                for path in sorted((INSTALLED / "models/training").glob("*.py"))
            )
        ),
        out=lambda wildcards, output: str(Path(output[0]).parent),
        cache=lambda wildcards, output: str(
            Path(output[0]).parents[1] / ".cache/models"
        ),
    shell:
        "PYTHONPATH={params.checkout:q} python -P -m models.training --out {params.out:q} --cache {params.cache:q}"
        " --seed {params.seed:q} --threads {threads} > {log:q} 2>&1"
