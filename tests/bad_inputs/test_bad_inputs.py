"""Bad inputs, one row each: the input, the command, and words that the message must contain.

No command may end with a traceback or change a file that was in the project before.
"""

import json
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from hilsplat.base.arrays import read_tensors, write_tensors
from hilsplat.base.artifacts import provenance_path
from hilsplat.base.lineage import sha256_of_file
from hilsplat.configuration import read_config
from hilsplat.query.answer import answer, file_name
from hilsplat.query.names import tree_digest
from hilsplat.splat.ply import load_ply
from tests.bad_inputs.conftest import snapshot
from tests.unit.artifact_changes import flip_bit, write_record
from tests.unit.finished_desk import SCENE

MASKS, TREE, CLIP = SCENE / "default/masks", SCENE / "default/coverage_tree", SCENE / "default/clip"
CONTRIBUTIONS, CODE = SCENE / "default/contributions", SCENE / "default/autoencoder"
FIELD, GAUSSIANS = SCENE / "default/field.safetensors", SCENE / "gaussians.ply"
INDEX = CONTRIBUTIONS / "index.json"
DEEP = "[" * 100_000
HUGE_PLY = "ply\nformat ascii 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n1\n"
NAN_PLY = "ply\nformat ascii 1.0\nelement vertex 1\n"
NAN_PLY += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\nnan 0 1\n"
OUT = ("--out", "results/new")

OWN_CONFIG = partial(read_config, Path("config/config.yaml"))
COVERAGE = ("coverage-tree", "--masks", str(MASKS), *OUT)
CONTRIBUTE = (*f"contributions --scene {SCENE}/scene --gaussians {GAUSSIANS} --masks {MASKS}".split(), *OUT)
SOLVE = (*f"field --contributions {CONTRIBUTIONS} --coverage-tree {TREE} --autoencoder {CODE}".split(), *OUT)
ASK = ("query", "photos/desk", "mug")
POSES = ("poses", "--images", "photos", *OUT)
NEW = ("new", "chair", "photos")
CHECK = ("run", "--config")
CHECK_MODEL = ("models", "check", "models/copy")


Command = tuple[str, ...] | Callable[[], object]  # Words after `hilsplat`, or a function that refuses


def row(lay: Callable[[], object], command: Command, *words: str) -> tuple:
    """Return a function that puts the bad input into the project, the command, and parts of its message."""
    return lay, command, words


def nothing() -> None:
    """Do nothing, because the command itself is the bad input."""


def write(path: Path | str, content: str | bytes) -> Callable[[], object]:
    def lay() -> None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_bytes(content if isinstance(content, bytes) else content.encode())

    return lay


def changed(artifact: Path) -> tuple[str, str]:
    """Return parts of the message about an artifact that differs from its provenance."""
    return f"{artifact} was changed after it was written", f"hilsplat run --verify {artifact}"


def without_provenance(folder: Path, index: str) -> Callable[[], object]:
    return lambda: [provenance_path(folder).unlink(), write(folder / "index.json", index)()]


def as_pipe(path: Path) -> Callable[[], object]:
    return lambda: [path.unlink(), os.mkfifo(path)]


def field_of_nan() -> None:
    arrays, about = read_tensors(FIELD)
    write_tensors(FIELD, {"features": arrays["features"] * np.nan}, **about)


def as_folder(path: Path) -> Callable[[], object]:
    def lay() -> None:
        path.unlink()
        path.mkdir()

    return lay


def photographs(*names: str, folder: str = "photos") -> Callable[[], object]:
    def lay() -> None:
        Path(folder).mkdir(parents=True, exist_ok=True)
        rng = np.random.default_rng(0)
        for name in ("a.png", "b.png", "c.png", *names):
            Image.fromarray(rng.integers(0, 255, (48, 64, 3), dtype=np.uint8)).save(Path(folder) / name)

    return lay


def with_photographs(name: str, content: str | bytes) -> Callable[[], object]:
    return lambda: [photographs()(), write(f"photos/{name}", content)()]


def write_names_of(name: str) -> None:
    """Write names.json with JSON of the first node's name."""
    digest = tree_digest(SCENE / "default/semantic_tree")
    content = f'{{"format": "hilsplat-names-1", "trees": {{"{digest}": {{"0": {name}}}}}}}'
    (SCENE / "names.json").write_text(content)


def colmap_without_rotation() -> None:
    """Write photographs and a COLMAP model in which the quaternion of the second view is 0."""
    photographs()()
    rotations = {"a": "1 0 0 0", "b": "0 0 0 0", "c": "1 0 0 0"}
    views = [f"{n} {rotations[each]} {n} 0 5 1 {each}.png\n\n" for n, each in enumerate(rotations, 1)]
    for name, text in {
        "cameras": "1 PINHOLE 64 48 50 50 32 24\n",
        "images": "".join(views),
        "points3D": "1 0 0 1 9 9 9 0.5\n",
    }.items():
        write(f"photos/sparse/0/{name}.txt", text)()


def without_rotation() -> None:
    GAUSSIANS.write_bytes(GAUSSIANS.read_bytes()[:-16] + bytes(16))
    json_file = GAUSSIANS.with_suffix(".json")
    content = json.loads(json_file.read_text()) | {"ply_sha256": sha256_of_file(GAUSSIANS)}
    json_file.write_text(json.dumps(content))


def with_model(file: str, content: str) -> Callable[[], object]:
    """Copy the tiny CLIP to models/copy, and replace one of its files."""
    return lambda: [
        shutil.copytree("models/clip-tiny", "models/copy"),
        write(f"models/copy/{file}", content)(),
    ]


def png_of(width: int, height: int) -> bytes:
    """Return the beginning of a PNG with the given size in its header."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    checked = struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    return b"\x89PNG\r\n\x1a\n" + checked + b"\0\0\0\0IDAT"


ROWS = {
    # ---- damaged artifacts: the message has the command that rebuilds them
    "an index of a copy without provenance": row(
        without_provenance(MASKS, "[]"), COVERAGE, "index.json is not an artifact index"
    ),
    "a deep index of a copy without provenance": row(
        without_provenance(MASKS, DEEP), COVERAGE, "nested too deeply"
    ),
    "a pipe instead of an index": row(as_pipe(INDEX), SOLVE, *changed(CONTRIBUTIONS)),
    "a pipe instead of the configuration": row(
        as_pipe(Path("config/config.yaml")), CHECK[:1], "config.yaml is a pipe or device", "save its content"
    ),
    "a pipe instead of the scene sheet": row(
        as_pipe(Path("config/scenes.tsv")), NEW, "scenes.tsv is a pipe or device"
    ),
    "a PLY that states 10^12 Gaussians": row(
        write("huge.ply", HUGE_PLY), lambda: load_ply(Path("huge.ply")), "huge.ply cannot be read"
    ),
    "a field that is a folder": row(as_folder(FIELD), ASK, "field.safetensors cannot be read", "--verify"),
    "a code that is a folder": row(as_folder(CODE / "autoencoder.safetensors"), SOLVE, *changed(CODE)),
    "one bit of a field": row(
        lambda: flip_bit(FIELD, 0.7), ASK, "field.safetensors cannot be read", "changed after"
    ),
    "a field of nan": row(field_of_nan, ASK, "array features contains an impossible value", "finite"),
    "Gaussians of another scene beside a tree": row(
        lambda: GAUSSIANS.write_bytes(GAUSSIANS.read_bytes()[:-4] + b"\0\0\x80?"),
        ASK,
        "default/semantic_tree was not made from results/photos/desk/gaussians.ply",
    ),
    "Gaussians without a rotation": row(
        without_rotation, ("export", "photos/desk", "--as", "ply"), "gaussians.ply", "1 of", "no rotation"
    ),
    "provenance whose outputs are a list": row(
        lambda: write_record(FIELD, outputs=[]), ASK, "field.safetensors.provenance.json is damaged: outputs"
    ),
    # ---- queries
    "a scene that does not exist": row(
        nothing, ("query", "photos/none", "mug"), "results/photos/none is missing"
    ),
    "a folder at the root of the file system": row(nothing, ("query", "/none", "mug"), "/none is missing"),
    "a results folder in place of a scene": row(
        nothing, ("query", "results", "mug"), "results is a folder of scenes, not a scene", "photos/desk"
    ),
    "a data set in place of a scene": row(
        nothing, ("query", "photos", "mug"), "results/photos is a folder of scenes", "photos/desk"
    ),
    "a scene that is not finished": row(
        lambda: Path("results/photos/later/default").mkdir(parents=True),
        ("query", "photos/later", "mug"),
        "photos/later is not finished",
        "hilsplat run",
    ),
    "a query that is not UTF-8": row(nothing, ("query", "photos/desk", "mug \udcff"), "is not UTF-8"),
    "a query of a separator alone": row(
        nothing, ("query", "photos/desk", ">"), "contains an empty text", "up to 500 characters", "fix"
    ),
    "a query of 10,000 letters": row(
        nothing, ("query", "photos/desk", "a" * 10_000), "the query is too long", "10000 characters"
    ),
    "an unknown view": row(nothing, (*ASK, "--view", "x"), "x"),
    "a name with an escape sequence": row(
        lambda: write_names_of(r'"\u001b]0;x\u0007"'), ASK, "names.json is damaged", "is not a valid name"
    ),
    "a name with a lone surrogate": row(
        lambda: write_names_of(r'"a\ud800"'), ("export", "photos/desk"), "names.json is damaged"
    ),
    "names with a duplicate key": row(
        lambda: write_names_of('"a", "0": "b"'), ASK, "names.json is not valid JSON", "key '0' is duplicated"
    ),
    # ---- photographs and imports
    "a photograph with a brace": row(photographs("a{1}.png"), NEW, "a{1}.png", "brace", "rename"),
    "a scene name that is an option": row(photographs(), ("new", "--", "-n", "photos"), "name", "'-'"),
    "a name of 243 bytes": row(photographs("n" * 239 + ".png"), NEW, "too long", "at most 200 bytes", "243"),
    "an image of 400 megapixels": row(
        lambda: [with_photographs(name, png_of(20_000, 20_000))() for name in ("big.png", "other.png")],
        NEW,
        "big.png",
        "400000000 pixels",
    ),
    "poses that are a list": row(
        with_photographs("transforms.json", "[]"), POSES, "transforms.json is not a JSON object"
    ),
    "frames that are numbers": row(
        with_photographs("transforms.json", '{"frames": [1, 2, 3]}'), POSES, "`frames` is missing"
    ),
    "poses with a duplicate key": row(
        with_photographs("transforms.json", '{"w": 4, "frames": [], "w": 5}'), POSES, "key 'w' is duplicated"
    ),
    "COLMAP poses with a quaternion of 0": row(
        colmap_without_rotation, POSES, "camera rotation of view b.png", "sparse/0"
    ),
    "points that are damaged": row(
        lambda: [
            with_photographs("transforms.json", '{"frames": [], "ply_file_path": "points.ply"}')(),
            write("photos/points.ply", NAN_PLY[:-4])(),
        ],
        POSES,
        "points.ply, with the points, cannot be read",
    ),
    "LLFF poses that are text": row(
        lambda: [photographs()(), np.save("photos/poses_bounds.npy", np.array([["a"] * 17] * 3))],
        POSES,
        "poses_bounds.npy cannot be read: it does not contain LLFF poses",
        "<U1",
    ),
    # ---- output paths
    "an output below a file": row(
        nothing,
        ("coverage-tree", "--masks", str(MASKS), "--out", "config/scenes.tsv/new"),
        "scenes.tsv already exists",
    ),
    "a log below a file": row(
        nothing, ("--log", "config/scenes.tsv/log", *COVERAGE), "scenes.tsv already exists"
    ),
    "an output on a disk without room": row(
        nothing,
        ("coverage-tree", "--masks", str(MASKS), "--out", "/proc/none/new"),
        "not enough space on the disk of /proc",
    ),
    "an output below a link to a disk that is not mounted": row(
        lambda: Path("link").symlink_to("gone/results"),
        ("export", "photos/desk", "--out", "link/new"),
        "link is a link to gone/results, which is missing",
    ),
    "a name that no disk takes": row(
        nothing, ("coverage-tree", "--masks", str(MASKS), "--out", "n" * 260), "too long for this file system"
    ),
    # ---- numbers and JSON on the command line
    "names that are no JSON": row(
        nothing,
        ("table", "lerf", "--published", "config/published/lerf.csv", "--labels", "[1", *OUT),
        "--labels is not JSON",
    ),
    # ---- models
    "a tokenizer of nothing": row(
        with_model("tokenizer.json", "{}"), CHECK_MODEL, "models/copy/tokenizer.json cannot be read"
    ),
    "a tokenizer without words": row(
        with_model("tokenizer.json", '{"model": {"type": "WordLevel", "vocab": {}, "unk_token": "x"}}'),
        CHECK_MODEL,
        "models/copy/tokenizer.json",
        "no word",
    ),
    # ---- configuration, refused while the workflow is parsed
    "YAML with a bracket left open": row(
        write("config/config.yaml", "seed: 0\nonly: [a\nseeds: 1\n"),
        OWN_CONFIG,
        "config/config.yaml, line 3",
        "is not YAML",
    ),
    "YAML for --configfile in Latin-1": row(
        write("my.yaml", b"labels: {a: \xff}\n"), (*CHECK, "my.yaml"), "my.yaml cannot be read", "UTF-8"
    ),
    "YAML that is a list": row(
        write("config/config.yaml", "- a\n"), OWN_CONFIG, "does not contain settings", "list"
    ),
}


@pytest.mark.parametrize("what", ROWS)
def test_bad_input_is_reported_and_nothing_is_lost(
    what: str, project: Path, told: Callable[..., str]
) -> None:
    lay, command, words = ROWS[what]
    lay()
    before = snapshot(project)
    text = told(command)
    assert "Traceback" not in text
    assert "delete it" not in text
    for each in words:
        assert each in text
    after = snapshot(project)
    assert {path: after.get(path) for path in before} == before
    assert not list(project.rglob(".writing-*"))


@pytest.mark.parametrize("text", ["mug " * 100, r"$\frac{$", "mug/../../x", "ü" * 90, "--"])
def test_any_text_is_a_valid_query_with_its_own_folder(text: str, project: Path, capsys) -> None:
    lines = list(answer(SCENE, text, views=1))
    assert lines[-1].startswith("wrote")
    (folder,) = [path for path in (SCENE / "queries").iterdir() if not path.name.startswith(".")]
    assert folder.name == file_name(text) and (folder / "panel.png").is_file()


def test_similar_texts_have_different_folders() -> None:
    texts = ["a b", "a-b", "a > b", "a--b", "a/b", "$$", "%%", "query", "x" * 300, "x" * 301]
    assert len({file_name(text) for text in texts}) == len(texts)
    assert all(len(file_name(text)) < 120 for text in texts)
