# Masks at three levels and the coverage tree of each view.
rule masks:
    input:
        scene="results/{dataset}/{scene}/scene",
        truth=truth_of_masks,  # nothing, but for the diagnostic segmenter
    output:
        masks=directory("results/{dataset}/{scene}/{variant}/masks"),
    log:
        "results/{dataset}/{scene}/{variant}/logs/masks.log",
    benchmark:
        "results/{dataset}/{scene}/{variant}/benchmarks/masks.jsonl"
    conda:
        ENVIRONMENT
    threads: THREADS
    resources:
        mem_mb=4000,
    params:
        settings=settings_of("masks"),
        model=digest_of_model("masks"),
        truth=truth_option_of_masks,
        cache="results/.cache",
        code=code(stage_of_masks),
    shell:
        "hilsplat masks --scene {input.scene} --settings {params.settings:q} {params.truth}"
        " --threads {threads} --cache {params.cache} --out {output.masks} --log {log}"


rule tree:
    input:
        masks=shared("masks", "masks"),
    output:
        tree=directory("results/{dataset}/{scene}/{variant}/tree"),
    log:
        "results/{dataset}/{scene}/{variant}/logs/tree.log",
    benchmark:
        "results/{dataset}/{scene}/{variant}/benchmarks/tree.jsonl"
    conda:
        ENVIRONMENT
    threads: 1
    resources:
        mem_mb=2000,
    params:
        settings=settings_of("tree"),
        code=code("tree"),
    shell:
        "hilsplat tree --masks {input.masks} --settings {params.settings:q} --out {output.tree} --log {log}"
