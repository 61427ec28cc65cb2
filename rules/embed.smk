# CLIP vectors of the crops that show each node best, or of every mask.
rule clip:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        masks=PLAN.shared("masks", "masks"),
        semantic_tree=PLAN.crops_tree,  # empty if every mask is embedded
        features=PLAN.data.features,  # empty, except for vectors of LangSplat
    output:
        clip=directory("<results>/{dataset}/{scene}/{variant}/clip"),
    log:
        "<results>/{dataset}/{scene}/{variant}/logs/clip.log",
    benchmark:
        "<results>/{dataset}/{scene}/{variant}/benchmarks/clip.jsonl"
    priority: 80
    conda:
        ENVIRONMENT
    threads: RESOURCES.threads
    resources:
        mem_mb=RESOURCES.memory_mb("clip"),
        runtime=RESOURCES.minutes("clip"),
        gpu=RESOURCES.gpus("clip"),
    params:
        settings=PLAN.settings("clip"),
        model=PLAN.model("clip"),
        option=PLAN.crops_tree_option,
        cache=cache_folder,
        code=PLAN.code(PLAN.clip_stage),
    shell:
        "python -m hilsplat --log {log:q} clip --scene {input.scene:q} --masks {input.masks:q} {params.option} --settings {params.settings:q}"
        " --threads {threads} --memory {resources.mem_mib} --cache {params.cache:q} --out {output.clip:q}"
