# CLIP per mask, frozen-geometry matrices, semantic tree, autoencoder, language field.
rule clip:
    input:
        scene=SCENE + "/scene",
        masks=shared("masks", "masks"),
    output:
        clip=directory(VARIANT + "/clip"),
    params:
        settings=settings_of("clip"),
        model=digest_of_model("clip"),
        cache=CACHE,
        code=code("clip"),
    log:
        VARIANT + "/logs/clip.log",
    benchmark:
        VARIANT + "/benchmarks/clip.jsonl"
    threads: THREADS
    resources:
        mem_mb=3000,
    shell:
        "hilsplat clip --scene {input.scene} --masks {input.masks} --settings {params.settings:q}"
        " --threads {threads} --cache {params.cache} --out {output.clip} --log {log}"


rule contributions:
    input:
        scene=SCENE + "/scene",
        gaussians=SCENE + "/gaussians.ply",
        masks=shared("masks", "masks"),
    output:
        contributions=directory(VARIANT + "/contributions"),
    params:
        settings=settings_of("contributions"),
        cache=CACHE,
        code=code("contributions"),
    log:
        VARIANT + "/logs/contributions.log",
    benchmark:
        VARIANT + "/benchmarks/contributions.jsonl"
    threads: THREADS
    resources:
        mem_mb=4000,
    shell:
        "hilsplat contributions --scene {input.scene} --gaussians {input.gaussians} --masks {input.masks}"
        " --settings {params.settings:q} --threads {threads} --cache {params.cache}"
        " --out {output.contributions} --log {log}"


rule semantic_tree:
    input:
        contributions=shared("contributions", "contributions"),
        masks=shared("masks", "masks"),
        clip=shared("clip", "clip"),
    output:
        semantic_tree=directory(VARIANT + "/semantic_tree"),
    params:
        settings=settings_of("semantic_tree"),
        code=code("semantic_tree"),
    log:
        VARIANT + "/logs/semantic_tree.log",
    benchmark:
        VARIANT + "/benchmarks/semantic_tree.jsonl"
    threads: 1
    resources:
        mem_mb=3000,
    shell:
        "hilsplat semantic-tree --contributions {input.contributions} --masks {input.masks}"
        " --clip {input.clip} --settings {params.settings:q} --out {output.semantic_tree} --log {log}"


rule autoencoder:
    input:
        clip=shared("clip", "clip"),
        semantic_tree=shared("semantic_tree", "semantic_tree"),
        contributions=shared("contributions", "contributions"),
    output:
        autoencoder=directory(VARIANT + "/autoencoder"),
    params:
        settings=settings_of("autoencoder"),
        seed=RUN.seed,
        code=code("autoencoder"),
    log:
        VARIANT + "/logs/autoencoder.log",
    benchmark:
        VARIANT + "/benchmarks/autoencoder.jsonl"
    threads: 1
    resources:
        mem_mb=2000,
    shell:
        "hilsplat autoencoder --clip {input.clip} --semantic-tree {input.semantic_tree}"
        " --contributions {input.contributions} --settings {params.settings:q} --seed {params.seed}"
        " --out {output.autoencoder} --log {log}"


rule language:
    input:
        contributions=shared("contributions", "contributions"),
        tree=shared("tree", "tree"),
        autoencoder=shared("autoencoder", "autoencoder"),
    output:
        language=VARIANT + "/language.safetensors",
    params:
        settings=settings_of("language"),
        seed=RUN.seed,
        code=code("language"),
    log:
        VARIANT + "/logs/language.log",
    benchmark:
        VARIANT + "/benchmarks/language.jsonl"
    threads: THREADS
    resources:
        mem_mb=4000,
    shell:
        "hilsplat language --contributions {input.contributions} --tree {input.tree}"
        " --autoencoder {input.autoencoder} --settings {params.settings:q} --seed {params.seed}"
        " --threads {threads} --out {output.language} --log {log}"
