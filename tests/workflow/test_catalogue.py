"""The Snakefile that the Snakemake workflow catalogue reads."""


def test_the_snakefile_under_workflow_plans_what_the_one_at_the_root_plans(plain):
    planned = plain.planned()
    assert "evaluate" in planned
    assert plain.planned("--snakefile", "workflow/Snakefile") == planned | {"everything"}
