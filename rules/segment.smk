# Masks at three levels and the coverage tree of each view.
rule masks:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        truth=PLAN.masks_truth,  # empty, except for the diagnostic segmenter
        gaussians=PLAN.key_gaussians,  # empty, except for key views and guided prompts
        key_masks=lambda wildcards: PLAN.key_parts(wildcards, "masks"),
        key_tree=lambda wildcards: PLAN.key_parts(wildcards, "semantic_tree"),
        features=given(PLAN.data.features),  # empty, except for LangSplat's masks
    output:
        masks=directory("<results>/{dataset}/{scene}/{variant}/masks"),
    log:
        "<results>/{dataset}/{scene}/{variant}/logs/masks.log",
    benchmark:
        "<results>/{dataset}/{scene}/{variant}/benchmarks/masks.jsonl"
    priority: PLAN.masks_priority
    conda:
        ENVIRONMENT
    threads: RESOURCES.threads
    resources:
        mem_mb=RESOURCES.memory_mb("masks"),
        runtime=RESOURCES.minutes("masks"),
        gpu=RESOURCES.gpus("masks"),
    params:
        files=PLAN.data.content(PLAN.data.features),
        settings=PLAN.settings("masks"),
        model=PLAN.model("masks"),
        option=PLAN.masks_option,
        cache=cache_folder,
        code=PLAN.code(PLAN.masks_stage),
    shell:
        "python -m hilsplat --log {log:q} masks --scene {input.scene:q} --settings {params.settings:q} {params.option}"
        " --threads {threads} --memory {resources.mem_mib} --cache {params.cache:q} --out {output.masks:q}"


rule coverage_tree:
    input:
        masks=PLAN.shared("masks", "masks"),
    output:
        coverage_tree=directory("<results>/{dataset}/{scene}/{variant}/coverage_tree"),
    log:
        "<results>/{dataset}/{scene}/{variant}/logs/coverage_tree.log",
    benchmark:
        "<results>/{dataset}/{scene}/{variant}/benchmarks/coverage_tree.jsonl"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=RESOURCES.memory_mb("coverage_tree"),
        runtime=RESOURCES.minutes("coverage_tree"),
    params:
        settings=PLAN.settings("coverage_tree"),
        code=PLAN.code("coverage_tree"),
    shell:
        "python -m hilsplat --log {log:q} coverage-tree --masks {input.masks:q} --settings {params.settings:q}"
        " --out {output.coverage_tree:q}"
