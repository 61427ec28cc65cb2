"""The report has all tables and panels, and no text of a configuration becomes a script in it."""

import json
from html.parser import HTMLParser

from tests.workflow.conftest import Project

NAMES = ("hierarchy.html", "waymo.html", "panel.png", "registration.png", "fit.png", "comparison.png")
NAMES += ("views.png", "features.png", "sweep-theta.png")
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(2)>--><!-- {{ alert(3) }}"


class Elements(HTMLParser):
    """What a browser would run: scripts, pictures, and attributes that are scripts."""

    def __init__(self) -> None:
        super().__init__()
        self.scripts: list[str] = []
        self.handlers: list[str] = []
        self._inside = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handlers += [f"{name}={value}" for name, value in attrs if name.startswith("on")]
        self._inside = tag == "script"
        if self._inside:
            self.scripts.append("")

    def handle_endtag(self, tag: str) -> None:
        self._inside = False

    def handle_data(self, data: str) -> None:
        if self._inside:
            self.scripts[-1] += data


def report(project: Project, *words: str) -> tuple[str, Elements]:
    project.snakemake("--report", "report.html", *words)
    text, found = (project.root / "report.html").read_text(), Elements()
    found.feed(text)
    return text, found


def test_the_report_holds_tables_and_panels_and_runs_no_text_of_a_configuration(
    copy_of_finished: Project,
) -> None:
    project = copy_of_finished
    text, plain = report(project)
    for name in NAMES:
        assert name in text, name

    config = {
        "labels": {"default": HOSTILE},
        "queries": {"synthetic/tiny": [HOSTILE]},
        "evaluate": {"template": f"{HOSTILE.replace('{', '').replace('}', '')} {{}}", "canonical": [HOSTILE]},
    }
    (project.root / "hostile.json").write_text(json.dumps(config))
    text, found = report(project, "--configfile", "config/ci.yaml", "hostile.json")
    assert "alert(1)" in text  # as text, in the parameters of figures and tables
    assert len(found.scripts) == len(plain.scripts)
    assert found.handlers == plain.handlers
    assert not any(script.strip().startswith("alert") for script in found.scripts)
