"""What the Snakemake workflow catalogue reads: its settings, the manual, and a Snakefile under workflow/."""

import yaml


def test_the_catalogue_finds_settings_and_manual(project):
    usage = yaml.safe_load((project / ".snakemake-workflow-catalog.yml").read_text())["usage"]
    assert set(usage) == {"mandatory-flags", "software-stack-deployment", "report"}
    assert (project / "config/README.md").is_file()


def test_the_snakefile_under_workflow_plans_what_the_one_at_the_root_plans(fresh):
    copy = fresh()
    planned = copy.planned()
    assert "evaluate" in planned
    assert copy.planned("--snakefile", "workflow/Snakefile") == planned | {"everything"}
