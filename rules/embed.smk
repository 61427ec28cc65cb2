# CLIP vectors of the crops that show each node best, or of every mask.
rule clip:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        masks=PLAN.shared("masks", "masks"),
        semantic_tree=PLAN.crops_tree,  # empty if every mask is embedded
        features=given(PLAN.data.features),  # empty, except for LangSplat's vectors
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
        files=PLAN.data.content(PLAN.data.features),
        settings=PLAN.settings("clip"),
        model=PLAN.model("clip"),
        option=PLAN.crops_tree_option,
        cache=cache_folder,
        code=PLAN.code(PLAN.clip_stage),
    shell:
        "python -m hilsplat --log {log:q} clip --scene {input.scene:q} --masks {input.masks:q} {params.option} --settings {params.settings:q}"
        " --threads {threads} --memory {resources.mem_mib} --cache {params.cache:q} --out {output.clip:q}"


# Names of the nodes from a vocabulary, and vectors of words for absent objects, to estimate chance scores.
rule names:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        semantic_tree=PLAN.shared("semantic_tree", "semantic_tree"),
        clip=PLAN.shared("clip", "clip"),
        vocabulary=given(PLAN.vocabulary),  # empty, unless you supply a file
    output:
        names=directory("<results>/{dataset}/{scene}/{variant}/names"),
    log:
        "<results>/{dataset}/{scene}/{variant}/logs/names.log",
    benchmark:
        "<results>/{dataset}/{scene}/{variant}/benchmarks/names.jsonl"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=RESOURCES.memory_mb("names"),
        runtime=RESOURCES.minutes("names"),
    params:
        files=PLAN.data.content(PLAN.vocabulary),
        settings=PLAN.settings("query"),
        evaluate=PLAN.settings("evaluate"),
        cache=cache_folder,
        code=PLAN.code("names"),
    shell:
        "python -m hilsplat --log {log:q} names --semantic-tree {input.semantic_tree:q} --clip {input.clip:q}"
        " --settings {params.settings:q} --evaluate {params.evaluate:q} --cache {params.cache:q} --out {output.names:q}"
