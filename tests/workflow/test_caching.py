"""Stages that an edit reruns."""

from tests.workflow.conftest import Project

AFTER_FIELD = {"field", "evaluate", "score_means", "table", "figures", "comparison", "sweep_plot"}
FROM_CLIP = {"clip", "names", "autoencoder", "method"} | AFTER_FIELD


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
        ("hilsplat/datasets/images/lerf_ovs.py", set()),
    ):
        file = copy_of_finished.root / path
        text = file.read_text()
        file.write_text(text + "\nUNUSED = 1\n")
        assert copy_of_finished.planned() == expected, path
        file.write_text(text)


def test_settings_and_models_rerun_the_stages_that_read_them(copy_of_finished: Project) -> None:
    copy_of_finished.edit("config/config.yaml", "omega: 10", "omega: 5")
    assert copy_of_finished.planned() == AFTER_FIELD - {"sweep_plot"}  # sweeps are of the paper's method
    copy_of_finished.edit("config/config.yaml", "theta: 0.9", "theta: 0.8")
    by_head = ("--config", "theta_variants=[]", "omega_variants=[]")  # theta decides levels in the others
    rerun = {"coverage_tree", "method"} | AFTER_FIELD
    assert copy_of_finished.planned(*by_head) == rerun - {"sweep_plot"}
    copy_of_finished.edit("config/config.yaml", "theta: 0.8", "theta: 0.9")
    copy_of_finished.edit("config/config.yaml", "omega: 5", "omega: 10")
    card = copy_of_finished.root / "models/clip-tiny/config.json"
    card.write_text(card.read_text() + "\n")
    assert copy_of_finished.planned() == FROM_CLIP
