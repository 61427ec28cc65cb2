# CLIP per mask, frozen-geometry matrices, semantic tree, autoencoder, language field.
rule clip:
    input:
        scene="results/{dataset}/{scene}/scene",
        masks=shared("masks", "masks"),
    output:
        clip=directory("results/{dataset}/{scene}/{variant}/clip"),
    log:
        "results/{dataset}/{scene}/{variant}/logs/clip.log",
    benchmark:
        "results/{dataset}/{scene}/{variant}/benchmarks/clip.jsonl"
    conda:
        ENVIRONMENT
    threads: THREADS
    resources:
        mem_mb=3000,
    params:
        settings=settings_of("clip"),
        model=digest_of_model("clip"),
        cache="results/.cache",
        code=code("clip"),
    shell:
        "hilsplat clip --scene {input.scene} --masks {input.masks} --settings {params.settings:q}"
        " --threads {threads} --cache {params.cache} --out {output.clip} --log {log}"


rule contributions:
    input:
        scene="results/{dataset}/{scene}/scene",
        gaussians="results/{dataset}/{scene}/gaussians.ply",
        masks=shared("masks", "masks"),
    output:
        contributions=directory("results/{dataset}/{scene}/{variant}/contributions"),
    log:
        "results/{dataset}/{scene}/{variant}/logs/contributions.log",
    benchmark:
        "results/{dataset}/{scene}/{variant}/benchmarks/contributions.jsonl"
    conda:
        ENVIRONMENT
    threads: THREADS
    resources:
        mem_mb=4000,
    params:
        settings=settings_of("contributions"),
        cache="results/.cache",
        code=code("contributions"),
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
        semantic_tree=directory("results/{dataset}/{scene}/{variant}/semantic_tree"),
    log:
        "results/{dataset}/{scene}/{variant}/logs/semantic_tree.log",
    benchmark:
        "results/{dataset}/{scene}/{variant}/benchmarks/semantic_tree.jsonl"
    conda:
        ENVIRONMENT
    threads: THREADS
    resources:
        mem_mb=3000,
    params:
        settings=settings_of("semantic_tree"),
        code=code("semantic_tree"),
    shell:
        "hilsplat semantic-tree --contributions {input.contributions} --masks {input.masks}"
        " --clip {input.clip} --settings {params.settings:q} --threads {threads}"
        " --out {output.semantic_tree} --log {log}"


rule autoencoder:
    input:
        clip=shared("clip", "clip"),
        semantic_tree=shared("semantic_tree", "semantic_tree"),
        contributions=shared("contributions", "contributions"),
    output:
        autoencoder=directory("results/{dataset}/{scene}/{variant}/autoencoder"),
    log:
        "results/{dataset}/{scene}/{variant}/logs/autoencoder.log",
    benchmark:
        "results/{dataset}/{scene}/{variant}/benchmarks/autoencoder.jsonl"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=2000,
    params:
        settings=settings_of("autoencoder"),
        seed=lambda wildcards: RUN.seed_of(wildcards.variant),
        code=code("autoencoder"),
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
        language="results/{dataset}/{scene}/{variant}/language.safetensors",
    log:
        "results/{dataset}/{scene}/{variant}/logs/language.log",
    benchmark:
        "results/{dataset}/{scene}/{variant}/benchmarks/language.jsonl"
    wildcard_constraints:
        variant=any_of(variants_by_method(baselines=False)),
    conda:
        ENVIRONMENT
    threads: THREADS
    resources:
        mem_mb=4000,
    params:
        settings=settings_of("language"),
        code=code("language"),
    shell:
        "hilsplat language --contributions {input.contributions} --tree {input.tree}"
        " --autoencoder {input.autoencoder} --settings {params.settings:q}"
        " --threads {threads} --out {output.language} --log {log}"
