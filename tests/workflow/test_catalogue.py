"""What the Snakemake workflow catalogue reads: its settings, the manual, and a Snakefile under workflow/."""

import yaml


def test_the_catalogue_finds_settings_and_manual(project):
    usage = yaml.safe_load((project / ".snakemake-workflow-catalog.yml").read_text())["usage"]
    assert set(usage) == {"mandatory-flags", "software-stack-deployment", "report"}
    assert (project / "config/README.md").is_file()


def test_the_snakefile_under_workflow_plans_what_the_one_at_the_root_plans(plain):
    planned = plain.planned()
    assert "evaluate" in planned
    assert plain.planned("--snakefile", "workflow/Snakefile") == planned | {"everything"}
