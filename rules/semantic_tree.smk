# Masks of all views, linked into a tree of 3D nodes.
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
