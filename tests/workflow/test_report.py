"""No text of a configuration becomes a script of `report.html`."""

import json
from collections.abc import Callable
from html.parser import HTMLParser

import numpy as np
from PIL import Image

from hilsplat.evaluate.tables.build import TABLES
from tests.workflow.conftest import Project

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


def test_no_text_of_a_configuration_runs_in_the_report(fresh: Callable[[], Project]) -> None:
    project = fresh()
    figures = project.root / "results/figures"
    names = ("panel", "registration", "fit", "masks", "comparison", "views", "features")
    pictures = [figures / "synthetic/tiny" / f"{name}.png" for name in names]
    for path in (*pictures, figures / "sweep-theta.png", figures / "sweep-omega.png"):
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.zeros((8, 8, 3), np.uint8)).save(path)
    (project.root / "results/tables").mkdir()
    for table in TABLES:
        (project.root / f"results/tables/{table}.html").write_text("<p>a table</p>")
    _, plain = report(project)

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
