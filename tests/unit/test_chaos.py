"""What `make chaos` compares."""

from pathlib import Path

from tests.chaos.__main__ import differences
from tests.workflow.conftest import Project


def test_every_other_byte_of_a_table_and_every_unfinished_file_is_reported(tmp_path: Path) -> None:
    projects = []
    for name in ("undisturbed", "disturbed"):
        tables = tmp_path / name / "results/tables"
        tables.mkdir(parents=True)
        (tables / "lerf.csv").write_text("1")
        (tables / "cost-seconds.csv").write_text(name)
        (tables / "lerf.csv.provenance.json").write_text(name)
        projects.append(Project(tmp_path / name))
    assert differences(*projects) == []
    (tables / "lerf.csv").write_text("2")
    (tables / "lerf.md").write_text("")
    (tables / ".writing-01234567-1-x").touch()
    told = differences(*projects)
    assert [line.partition(" ")[0] for line in told[:2]] == [
        "results/tables/lerf.csv",
        "results/tables/lerf.md",
    ]
    assert len(told) == 3 and "was left behind" in told[2]
