# Baselines: for variants with method.name, a different method computes the field (hilsplat/methods).
rule method:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        gaussians="<results>/{dataset}/{scene}/gaussians.ply",
        masks=PLAN.shared("masks", "masks"),
        contributions=PLAN.shared("contributions", "contributions"),
        autoencoder=PLAN.shared("autoencoder", "autoencoder"),
    output:
        field="<results>/{dataset}/{scene}/{variant}/field.safetensors",
    log:
        "<results>/{dataset}/{scene}/{variant}/logs/field.log",
    benchmark:
        "<results>/{dataset}/{scene}/{variant}/benchmarks/field.jsonl"
    wildcard_constraints:
        variant=PLAN.variants(by_baseline=True),
    priority: 6
    conda:
        ENVIRONMENT
    threads: RESOURCES.variant_threads
    resources:
        mem_mb=RESOURCES.memory_mb("method"),
        runtime=RESOURCES.minutes("method"),
    params:
        settings=PLAN.settings("method"),
        seed=PLAN.seed,
        code=PLAN.code("method", PLAN.baseline),
    shell:
        "python -m hilsplat --log {log:q} method --scene {input.scene:q} --gaussians {input.gaussians:q} --masks {input.masks:q}"
        " --contributions {input.contributions:q} --autoencoder {input.autoencoder:q}"
        " --settings {params.settings:q} --seed {params.seed:q} --threads {threads}"
        " --out {output.field:q}"
