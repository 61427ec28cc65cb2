"""Stages that an edit reruns."""

import json
from collections import defaultdict
from pathlib import Path

from hilsplat.base.code import modules_of
from hilsplat.stages import all_stages
from tests.workflow.conftest import Project, recorded

AFTER_FIELD = {"field", "evaluate", "score_means", "table", "figures", "comparison", "sweep_plot"}
FROM_CLIP = {"clip", "names", "autoencoder", "method"} | AFTER_FIELD
FROM_SCORES = {"evaluate", "score_means", "table", "comparison", "sweep_plot"}


def test_the_code_of_a_stage_covers_the_modules_and_data_that_its_jobs_load(finished: Project) -> None:
    """Modules that every job loads belong to the commands; a few others read inputs for provenance."""
    commands = {stage.command: stage for stage in all_stages().values() if stage.command}
    plugins: dict[str, set[str]] = defaultdict(set)
    for path in (finished.root / "results").rglob("*.provenance.json"):
        record = json.loads(path.read_text())
        plugins[record["stage"]].update(record["plugins"])
    jobs = []
    for path in recorded(finished).glob("*.json"):
        record = json.loads(path.read_text())
        words = record["words"][2:] if record["words"][:1] == ["--log"] else []
        if stage := commands.get(" ".join(words[:1]), commands.get(" ".join(words[:2]))):
            jobs.append((stage, {*record["modules"]}, {*record["data"]}))
    assert {stage.name for stage, *_ in jobs} >= AFTER_FIELD | FROM_CLIP | {"world", "gaussians", "masks"}
    of_commands = set.intersection(*(modules for _, modules, _ in jobs))
    for stage, modules, data in jobs:
        covered = {*stage.modules(), *modules_of(*plugins[stage.name])}
        assert modules - of_commands - covered <= {"hilsplat.datasets.sources"}, stage.name
        files = {
            ".".join(Path(file).with_suffix("").parts) for file in data if not file.endswith((".py", ".pyc"))
        }
        assert files - covered <= {"hilsplat.models.releases"}, stage.name


def test_edits_of_prose_and_descriptions_rerun_nothing(copy_of_finished: Project) -> None:
    for path in ("hilsplat/segment/coverage.py", "hilsplat/field/field.py", "hilsplat/base/images.py"):
        file = copy_of_finished.root / path
        file.write_text(file.read_text() + "\n# a comment\n")
    copy_of_finished.edit("hilsplat/base/images.py", '"""Reading and', '"""Edited. Reading and')
    copy_of_finished.edit("hilsplat/settings.py", '"mask A is a child', '"mask A becomes a child')
    assert copy_of_finished.planned() == set()


def test_an_edit_reruns_the_stages_that_import_the_module_and_what_follows(copy_of_finished: Project) -> None:
    for path, expected in (
        ("hilsplat/embed/stage.py", FROM_CLIP),
        ("hilsplat/methods/lifted.py", {"method", "evaluate", "table", "comparison"}),
        ("hilsplat/datasets/images/lerf_ovs.py", {"table", "sweep_plot"}),
        ("hilsplat/query/node_names.txt", {"names", "figures"} | FROM_SCORES),  # data of an imported module
        ("hilsplat_world/diagnostics/world_consistency.py", {"mask_truth"} | FROM_SCORES),
    ):
        file = copy_of_finished.root / path
        text = file.read_text()
        file.write_text(text + "\nUNUSED = 1\n")
        assert copy_of_finished.planned() == expected, path
        file.write_text(text)


def test_settings_and_models_rerun_the_stages_that_read_them(copy_of_finished: Project) -> None:
    copy_of_finished.edit("config/config.yaml", "omega: 10 #", "omega: 5 #")
    assert copy_of_finished.planned() == AFTER_FIELD - {"sweep_plot"}  # sweeps are of the paper's method
    copy_of_finished.edit("config/config.yaml", "\n  theta: 0.9\n", "\n  theta: 0.8\n")
    by_head = ("--config", "theta_variants=[]", "omega_variants=[]")  # theta decides levels in the others
    rerun = {"coverage_tree", "method"} | AFTER_FIELD
    assert copy_of_finished.planned(*by_head) == rerun - {"sweep_plot"}
    copy_of_finished.edit("config/config.yaml", "\n  theta: 0.8\n", "\n  theta: 0.9\n")
    copy_of_finished.edit("config/config.yaml", "omega: 5 #", "omega: 10 #")
    card = copy_of_finished.root / "models/clip-tiny/config.json"
    card.write_text(card.read_text() + "\n")
    assert copy_of_finished.planned() == FROM_CLIP
