"""The report has all tables and panels, and no text of a configuration becomes a script in it."""

import json

from tests.workflow.conftest import Project

NAMES = ("hierarchy.html", "waymo.html", "panel.webp", "registration.webp", "fit.webp", "comparison.webp")
NAMES += ("views.webp", "features.webp", "sweep-theta.png")
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>--><!-- {{ alert(3) }}"


def test_the_report_holds_tables_and_panels_and_runs_no_text_of_a_configuration(
    copy_of_finished: Project,
) -> None:
    project = copy_of_finished
    project.snakemake("--report", "report.html")
    text = (project.root / "report.html").read_text()
    for name in NAMES:
        assert name in text, name

    config = {
        "labels": {"default": HOSTILE},
        "queries": {"synthetic/tiny": [HOSTILE]},
        "evaluate": {"template": f"{HOSTILE.replace('{', '').replace('}', '')} {{}}", "canonical": [HOSTILE]},
    }
    (project.root / "hostile.json").write_text(json.dumps(config))
    project.snakemake("--report", "report.html", "--configfile", "config/ci.yaml", "hostile.json")
    text = (project.root / "report.html").read_text()
    assert "alert(1)" in text  # as text, in the parameters of figures and tables
    assert "<script>alert" not in text and "<img src=x" not in text
