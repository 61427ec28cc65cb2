"""A command replaces its own earlier outputs and nothing else."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from hilsplat.base import ownership
from hilsplat.base.artifacts import provenance_path, write_index
from hilsplat.base.atomic import lock_path, output_lock
from hilsplat.base.errors import ArtifactError, HilsplatError
from hilsplat.base.images import write_png
from hilsplat.cli.common import require_new_folder
from hilsplat.stage import PathIn, PathOut, Registry
from tests.unit.artifact_changes import write_record

PIPELINE = Registry()


@PIPELINE.stage(scope="run")
def table(scores: PathIn, out: PathOut) -> None:
    """Write a table, and add a file to its input, as a user might meanwhile."""
    out.write_text("text")
    (scores / "added.jpg").write_text("a photograph")


@PIPELINE.stage(scope="run")
def sweep(out: PathOut) -> None:
    """Draw a picture."""
    out.write_text("a picture")


@pytest.fixture
def photographs(tmp_path) -> Path:
    folder = tmp_path / "photographs"
    folder.mkdir()
    for number in range(3):
        (folder / f"{number}.jpg").write_bytes(b"a photograph")
    return folder


def record(out: Path, stage: str, *names: str) -> None:
    written = {"sha256": "", "bytes": {}}
    write_record(out, stage=stage, outputs=dict.fromkeys((out.name, *names), written))


def test_missing_or_empty_outputs_may_be_written(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder/.snakemake_timestamp").touch()
    (tmp_path / "file").touch()
    ownership.require_replaceable([tmp_path / name for name in ("new", "folder", "file")], "masks", [])


def test_a_folder_of_hidden_files_is_not_empty(tmp_path):
    (tmp_path / ".todo").write_text("work")
    with pytest.raises(ArtifactError, match=r"did not write it(.|\n)*a folder of 1 entries: \.todo"):
        ownership.require_replaceable([tmp_path], "masks", [])


def test_only_outputs_in_the_record_of_the_same_stage_may_be_replaced(photographs, tmp_path):
    out = tmp_path / "gaussians.ply"
    out.write_text("ply")
    record(out, "gaussians", "report")
    (tmp_path / "report").mkdir()
    (tmp_path / "report/fit.png").write_text("png")
    ownership.require_replaceable([out, tmp_path / "report"], "gaussians", [])
    with pytest.raises(ArtifactError, match="clip did not write it"):
        ownership.require_replaceable([out], "clip", [])
    with pytest.raises(ArtifactError, match="photographs exists"):
        ownership.require_replaceable([out, photographs], "gaussians", [])


def test_outputs_of_a_killed_writer_may_be_replaced(photographs):
    lock_path(photographs).write_text("unfinished\n")
    ownership.require_replaceable([photographs], "masks", [])


@pytest.mark.parametrize("cut", [0, 5])
def test_of_the_files_beside_an_output_only_those_of_its_killed_writer_may_be_replaced(tmp_path, cut):
    out, beside, other = (tmp_path / name for name in ("table.csv", "more/table.md", "notes.md"))
    with pytest.raises(KeyboardInterrupt), output_lock(out, beside):
        for path in (out, beside, other):
            path.parent.mkdir(exist_ok=True)
            path.write_text("text")
        raise KeyboardInterrupt
    lock_path(out).write_text(lock_path(out).read_text()[cut:])  # the disk may have been full
    ownership.require_replaceable([out], "table", [])
    for path, is_replaceable in ((beside, not cut), (other, False)):
        with nullcontext() if is_replaceable else pytest.raises(ArtifactError, match="did not write it"):
            ownership.require_replaceable([out, path], "table", [])


@pytest.mark.parametrize("broken", ["", "{", "[]", '{"stage": "masks"}', '{"stage": "masks", "outputs": 3}'])
def test_a_broken_record_counts_as_missing(photographs, broken):
    provenance_path(photographs).write_text(broken)
    with pytest.raises(ArtifactError, match="did not write it"):
        ownership.require_replaceable([photographs], "masks", [])


def test_an_input_is_never_an_output(photographs, tmp_path):
    record(photographs, "poses")
    with pytest.raises(ArtifactError, match="is an input"):
        ownership.require_replaceable([photographs], "poses", [photographs])
    link = tmp_path / "link"
    link.symlink_to(photographs)
    with pytest.raises(ArtifactError, match="is an input"):
        ownership.require_replaceable([link], "poses", [photographs])
    record(tmp_path, "poses")
    with pytest.raises(ArtifactError, match="contains the input"):
        ownership.require_replaceable([tmp_path], "poses", [photographs])


@pytest.mark.parametrize("names", [("table.md", "table.md"), ("fit", "fit/gaussians.ply")])
def test_outputs_of_a_stage_do_not_replace_each_other(tmp_path, names):
    with pytest.raises(ArtifactError, match=f"table writes other outputs to .*{names[0]}, too"):
        ownership.require_replaceable([tmp_path / name for name in names], "table", [])


def test_the_working_and_the_home_folder_are_never_outputs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for out, name in ((Path(), "working"), (tmp_path.parent, "working"), (Path.home(), "home")):
        with pytest.raises(ArtifactError, match=f"is or contains the {name} folder"):
            ownership.require_replaceable([out], "masks", [])
    monkeypatch.setattr("os.path.expanduser", lambda path: path)  # as for a user without a name and a home
    ownership.require_replaceable([tmp_path / "new"], "masks", [])


def test_an_input_that_changes_during_a_stage_leaves_no_provenance(tmp_path, photographs):
    out = tmp_path / "table.csv"
    message = r"table: input scores changed while the stage ran: .*added\.jpg(.|\n)*a new file"
    with pytest.raises(HilsplatError, match=message):
        table(photographs, out)
    assert not provenance_path(out).exists()


def test_pictures_replace_only_pictures_of_this_package(tmp_path):
    pixels = np.zeros((8, 8, 3), np.uint8)
    picture, photograph, text = (tmp_path / name for name in ("picture.png", "photograph.png", "thesis.md"))
    ownership.require_own_picture(picture)
    write_png(picture, pixels, text=ownership.SOFTWARE)
    ownership.require_own_picture(picture)
    write_png(photograph, pixels)
    (tmp_path / "broken.png").write_text("text")
    for path in (photograph, tmp_path / "broken.png"):
        with pytest.raises(ArtifactError, match="hilsplat did not write it"):
            ownership.require_own_picture(path)
    with pytest.raises(ArtifactError, match="not a PNG file"):
        ownership.require_own_picture(text)


def test_files_of_a_writer_that_failed_may_be_replaced(tmp_path):
    """A query takes seconds, so that users interrupt it."""
    with pytest.raises(KeyboardInterrupt), ownership.replaced_files(tmp_path, ["panel.png", "selection.ply"]):
        (tmp_path / "panel.png").write_text("half a picture")
        raise KeyboardInterrupt
    for _ in range(2):
        with ownership.replaced_files(tmp_path, ["panel.png", "selection.ply"]):
            (tmp_path / "panel.png").write_text("a picture")
    (tmp_path / "selection.ply").symlink_to("nowhere")
    with pytest.raises(ArtifactError, match=r"did not write(.|\n)*selection\.ply"):
        ownership.replaced_files(tmp_path, ["panel.png", "selection.ply"]).__enter__()


def test_tables_replace_only_tables_with_the_same_header(tmp_path):
    table = tmp_path / "efficiency.csv"
    ownership.require_beginning(table, "stage,seconds")
    table.write_text("stage,seconds\nmasks,3\n")
    ownership.require_beginning(table, "stage,seconds")
    table.write_text("name,price\n")
    with pytest.raises(ArtifactError, match="did not write it"):
        ownership.require_beginning(table, "stage,seconds")


def test_a_pdf_beside_a_picture_is_the_users_only_before_the_first_run(tmp_path):
    """Snakemake deletes the pictures of killed and repeated jobs, but not the PDFs beside them."""
    out, pdf = tmp_path / "theta.png", tmp_path / "theta.pdf"
    pdf.write_text("a paper")
    with pytest.raises(ArtifactError, match=r"theta\.pdf exists, but sweep did not write it"):
        sweep(out)
    assert not out.exists()
    lock_path(out).write_text("unfinished\n")
    sweep(out)
    out.unlink()
    sweep(out)


@pytest.mark.parametrize(
    "check",
    [
        lambda out: ownership.require_replaceable([out], "masks", []),
        ownership.require_own_picture,
        lambda out: ownership.require_beginning(out, "a,b"),
        require_new_folder,
    ],
)
def test_no_output_is_in_an_artifact(tmp_path, check):
    """Its digest would change, and the next run would compute it again."""
    write_index(tmp_path / "masks", {})
    (tmp_path / "users").mkdir()
    (tmp_path / "users/index.json").write_text("{}")  # of another program
    check(tmp_path / "users/new.png")
    for out in (tmp_path / "masks/new.png", tmp_path / "masks/more/new.png"):
        with pytest.raises(ArtifactError, match=r"is in the artifact .*masks, which would"):
            check(out)
