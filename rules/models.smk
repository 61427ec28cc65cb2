# The small models of the synthetic world. A default run does not train them: trained ones are committed.
rule train_models:
    output:
        directory("<results>/models/sam-tiny"),
        directory("<results>/models/clip-tiny"),
    log:
        "<results>/models/train.log",
    conda:
        ENVIRONMENT
    threads: 64  # Snakemake lowers it to the cores
    resources:
        mem_mb=RESOURCES.memory_mb("train_models"),
        runtime=RESOURCES.minutes("train_models"),
    params:
        settings=PLAN.run.training.model_dump_json(),
        seed=PLAN.run.seed,
        code=PLAN.code("models"),
        out=lambda wildcards, output: str(Path(output[0]).parent),
        cache=lambda wildcards, output: str(
            Path(output[0]).parents[1] / ".cache/models"
        ),
    shell:
        "python -m hilsplat --log {log:q} models train --out {params.out:q} --cache {params.cache:q}"
        " --settings {params.settings:q} --seed {params.seed:q} --threads {threads}"
