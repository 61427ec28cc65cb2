"""The comparison of all methods: every row of the paper is accounted for, and every baseline runs."""

import csv

import yaml

from hilsplat.configuration import parse_run
from hilsplat.methods.registry import METHODS, OURS
from tests.conftest import PROJECT

ABLATIONS = ("ablation", "omega", "theta", "pruning")


def test_every_row_of_the_papers_tables_runs_here_or_the_page_says_why_not():
    page = (PROJECT / "docs" / "methods.md").read_text().partition("## Every method of the tables")[2]
    cells = [line.split("|")[1] for line in page.splitlines() if line.startswith("| ")]
    explained = {name.partition(" (")[0].strip() for cell in cells for name in cell.split(",")}
    rows = set()
    for path in sorted((PROJECT / "config" / "published").glob("*.csv")):
        if path.stem not in ABLATIONS and not path.stem.startswith("frames-"):
            with path.open(newline="") as file:
                rows |= {row["method"].rstrip("*").replace("Lseg", "LSeg") for row in csv.DictReader(file)}
    assert rows - {"Hi-LSplat"} - explained == set()


def test_every_method_is_a_variant_of_the_file_that_runs_them_all():
    read = lambda name: yaml.safe_load((PROJECT / "config" / name).read_text())  # noqa: E731
    own, laid_over = read("config.yaml"), read("methods.yaml")
    names = {**own["variants"], **laid_over["variants"]}
    variants = {name: own["variants"].get(name, {}) | laid_over["variants"].get(name, {}) for name in names}
    listed = {
        variants.get(name, {}).get("method", {}).get("name", OURS) for name in laid_over["main_variants"]
    }
    assert listed == {OURS, *METHODS}
    parse_run(own | laid_over | {"variants": variants, "labels": own["labels"] | laid_over["labels"]})
