# Masks at three levels and the coverage tree of each view.
rule masks:
    input:
        scene=SCENE + "/scene",
    output:
        masks=directory(VARIANT + "/masks"),
    params:
        settings=settings_of("masks"),
        model=digest_of_model("masks"),
        cache=CACHE,
        code=code("masks"),
    log:
        VARIANT + "/logs/masks.log",
    benchmark:
        VARIANT + "/benchmarks/masks.jsonl"
    threads: THREADS
    resources:
        mem_mb=4000,
    shell:
        "hilsplat masks --scene {input.scene} --settings {params.settings:q} --threads {threads}"
        " --cache {params.cache} --out {output.masks} --log {log}"


rule tree:
    input:
        masks=shared("masks", "masks"),
    output:
        tree=directory(VARIANT + "/tree"),
    params:
        settings=settings_of("tree"),
        code=code("tree"),
    log:
        VARIANT + "/logs/tree.log",
    benchmark:
        VARIANT + "/benchmarks/tree.jsonl"
    threads: 1
    resources:
        mem_mb=2000,
    shell:
        "hilsplat tree --masks {input.masks} --settings {params.settings:q} --out {output.tree} --log {log}"
