# Masks of all views, linked into a tree of 3D nodes.
rule semantic_tree:
    input:
        contributions=PLAN.shared("contributions", "contributions"),
        masks=PLAN.shared("masks", "masks"),
        coverage_tree=PLAN.tree_parents,  # empty, except for evidence: features
    output:
        semantic_tree=directory("<results>/{dataset}/{scene}/{variant}/semantic_tree"),
    log:
        "<results>/{dataset}/{scene}/{variant}/logs/semantic_tree.log",
    benchmark:
        "<results>/{dataset}/{scene}/{variant}/benchmarks/semantic_tree.jsonl"
    priority: 70
    conda:
        ENVIRONMENT
    threads: RESOURCES.threads
    resources:
        mem_mb=RESOURCES.memory_mb("semantic_tree"),
        runtime=RESOURCES.minutes("semantic_tree"),
    params:
        settings=PLAN.settings("semantic_tree"),
        option=PLAN.tree_option,
        code=PLAN.code(PLAN.tree_stage),
    shell:
        "python -m hilsplat --log {log:q} semantic-tree --contributions {input.contributions:q} --masks {input.masks:q}"
        " --settings {params.settings:q} {params.option} --threads {threads} --out {output.semantic_tree:q}"
