# The autoencoder of the scene's CLIP vectors, and the language field.
rule autoencoder:
    input:
        clip=PLAN.shared("clip", "clip"),
        semantic_tree=PLAN.shared("semantic_tree", "semantic_tree"),
        contributions=PLAN.shared("contributions", "contributions"),
    output:
        autoencoder=directory("<results>/{dataset}/{scene}/{variant}/autoencoder"),
    log:
        "<results>/{dataset}/{scene}/{variant}/logs/autoencoder.log",
    benchmark:
        "<results>/{dataset}/{scene}/{variant}/benchmarks/autoencoder.jsonl"
    priority: 8
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=RESOURCES.memory_mb("autoencoder"),
        runtime=RESOURCES.minutes("autoencoder"),
    params:
        settings=PLAN.settings("autoencoder"),
        seed=PLAN.seed,
        code=PLAN.code("autoencoder"),
    shell:
        "python -m hilsplat --log {log:q} autoencoder --clip {input.clip:q} --semantic-tree {input.semantic_tree:q}"
        " --contributions {input.contributions:q} --settings {params.settings:q} --seed {params.seed:q}"
        " --out {output.autoencoder:q}"


rule field:
    input:
        contributions=PLAN.shared("contributions", "contributions"),
        coverage_tree=PLAN.shared("coverage_tree", "coverage_tree"),
        autoencoder=PLAN.shared("autoencoder", "autoencoder"),
        rendered=PLAN.rendered,  # empty, except for trainer: literal
        start=PLAN.first_field,  # empty, except for start: langsplat
    output:
        field="<results>/{dataset}/{scene}/{variant}/field.safetensors",
    log:
        "<results>/{dataset}/{scene}/{variant}/logs/field.log",
    benchmark:
        "<results>/{dataset}/{scene}/{variant}/benchmarks/field.jsonl"
    wildcard_constraints:
        variant=PLAN.variants(by_baseline=False),
    priority: 4
    conda:
        ENVIRONMENT
    threads: RESOURCES.variant_threads
    resources:
        mem_mb=RESOURCES.memory_mb("field"),
        runtime=RESOURCES.minutes("field"),
    params:
        settings=PLAN.settings("field"),
        option=PLAN.field_option,
        seed=PLAN.field_seed,
        code=PLAN.code("field"),
    shell:
        "python -m hilsplat --log {log:q} field --contributions {input.contributions:q} --coverage-tree {input.coverage_tree:q}"
        " --autoencoder {input.autoencoder:q} --settings {params.settings:q} {params.option} --seed {params.seed:q}"
        " --threads {threads} --out {output.field:q}"
