"""Bad inputs, one row each: the input, the command, and words that the message must contain.

No command may end with a traceback or change a file that was in the project before.
"""

import json
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from PIL import Image

from hilsplat.base.arrays import read_tensors, write_tensors
from hilsplat.base.artifacts import ViewCache, write_npz
from hilsplat.configuration import read_config
from hilsplat.datasets.images.isat import read_isat
from hilsplat.scene.scene import Scene
from hilsplat.splat.ply import load_ply
from hilsplat.splat.rasterise.device import cuda_problem
from hilsplat.workflow.plan import Plan
from tests.bad_inputs.conftest import snapshot
from tests.unit.artifact_changes import change_index, write_record
from tests.unit.finished_desk import SCENE

MASKS, TREE, CLIP = SCENE / "default/masks", SCENE / "default/coverage_tree", SCENE / "default/clip"
CONTRIBUTIONS, CODE = SCENE / "default/contributions", SCENE / "default/autoencoder"
FIELD, GAUSSIANS = SCENE / "default/field.safetensors", SCENE / "gaussians.ply"
DEEP = "[" * 100_000
HUGE = "ply\nformat ascii 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n1\n"
OUT = ("--out", "results/new")

COVERAGE = ("coverage-tree", "--masks", str(MASKS), *OUT)
CONTRIBUTE = ("contributions", "--scene", str(SCENE / "scene"), "--gaussians", str(GAUSSIANS))
CONTRIBUTE = (*CONTRIBUTE, "--masks", str(MASKS), *OUT)
SOLVE = ("field", "--contributions", str(CONTRIBUTIONS), "--coverage-tree", str(TREE))
SOLVE = (*SOLVE, "--autoencoder", str(CODE), *OUT)
LINK = ("semantic-tree", "--contributions", str(CONTRIBUTIONS), "--masks", str(MASKS))
LINK = (*LINK, *OUT)
ASK = ("query", "photos/desk", "mug")
POSES = ("poses", "--images", "photos", *OUT)
NEW = ("new", "chair", "photos")
CHECK = ("run", "--config")


@dataclass(frozen=True)
class Row:
    """One bad input.

    Attributes:
        what: description of the input.
        lay: puts it into the project, which is the working directory.
        command: words after `hilsplat`, or a function that refuses.
        words: texts that the message must contain.
    """

    what: str
    lay: Callable[[], object]
    command: tuple[str, ...] | Callable[[], object]
    words: tuple[str, ...]


def nothing() -> None:
    """Do nothing, because the command itself is the bad input."""


def write(path: Path | str, content: str | bytes) -> Callable[[], object]:
    def lay() -> None:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        Path(path).write_bytes(content if isinstance(content, bytes) else content.encode())

    return lay


def change(path: Path, offset: float | bytes, new: bytes) -> Callable[[], object]:
    """Overwrite bytes at a share of a file's length, or after every occurrence of a mark."""

    def lay() -> None:
        content = bytearray(path.read_bytes())
        if isinstance(offset, bytes):
            at = content.find(offset)
            while at >= 0:
                place = at + (8 if offset == b"PK\x03\x04" else 10)  # offset of the compression method
                content[place : place + len(new)] = new
                at = content.find(offset, at + 1)
        else:
            place = int(len(content) * offset)
            content[place : place + len(new)] = new
        path.write_bytes(bytes(content))

    return lay


def flip(path: Path, share: float) -> Callable[[], object]:
    """Flip one bit at a share of a file's length."""

    def lay() -> None:
        content = bytearray(path.read_bytes())
        content[int(share * len(content))] ^= 4
        path.write_bytes(content)

    return lay


def edit(path: Path, old: bytes, new: bytes) -> Callable[[], object]:
    def lay() -> None:
        content = path.read_bytes()
        assert content.count(old) == 1
        path.write_bytes(content.replace(old, new))

    return lay


def resave_field(change: Callable[[np.ndarray], np.ndarray]) -> None:
    arrays, about = read_tensors(FIELD)
    write_tensors(FIELD, {"features": change(arrays["features"])}, **about)


def move_cameras(folder: Path) -> None:
    scene = Scene.load(folder)
    poses = scene.cameras.cam_from_world.copy()
    poses[:, 0, 3] += 1
    replace(scene.cameras, cam_from_world=poses).save(folder / "cameras.npz")
    change_index(folder)


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


def both(*lays: Callable[[], object]) -> Callable[[], object]:
    return lambda: [lay() for lay in lays]


def png_of(width: int, height: int) -> bytes:
    """Return the beginning of a PNG with the given size in its header."""
    header = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + struct.pack(">I", 13)
        + header
        + struct.pack(">I", zlib.crc32(header))
        + b"\0\0\0\0IDAT"
    )


def transforms(**frame: object) -> Callable[[], object]:
    pose = np.eye(4).tolist()
    content = {"fl_x": 50, "w": 64, "h": 48, "frames": [{"transform_matrix": pose, **frame}] * 3}
    return both(photographs(), write("photos/transforms.json", json.dumps(content)))


def plan(**config: object) -> Callable[[], object]:
    """Return a function that parses the configuration with these settings, as `snakemake` does first."""

    def parse() -> None:
        shipped = yaml.safe_load(Path("config/config.yaml").read_text())
        Plan({**shipped, "groups": ["ci"], **config}).require_usable(devices=True)

    return parse


def isat(**info: object) -> str:
    return json.dumps({"info": info, "objects": []})


ROWS = [
    # ---- damaged artifacts: the message has the command that rebuilds them
    Row(
        "masks with bytes that do not unpack",
        change(MASKS / "000.png.npz", 0.5, b"\xff" * 40),
        COVERAGE,
        ("000.png.npz cannot be read", f"snakemake --cores 2 --forcerun {MASKS}"),
    ),
    Row(
        "masks packed by an unknown method",
        both(
            change(MASKS / "000.png.npz", b"PK\x03\x04", struct.pack("<H", 99)),
            change(MASKS / "000.png.npz", b"PK\x01\x02", struct.pack("<H", 99)),
        ),
        COVERAGE,
        ("000.png.npz cannot be read", f"--forcerun {MASKS}"),
    ),
    Row(
        "masks without their arrays",
        lambda: write_npz(MASKS / "000.png.npz", other=np.zeros(1)),
        COVERAGE,
        ("000.png.npz lacks", "runs", f"--forcerun {MASKS}"),
    ),
    Row(
        "masks that are a single array",
        write(MASKS / "000.png.npz", b"\x93NUMPY\x01\x00"),
        COVERAGE,
        ("000.png.npz cannot be read",),
    ),
    Row(
        "trees without their array",
        lambda: write_npz(TREE / "000.png.npz", other=np.zeros(1)),
        SOLVE,
        ("000.png.npz was changed after it was written", f"--forcerun {TREE}"),
    ),
    Row(
        "latents without their array",
        lambda: write_npz(CODE / "latents.npz", other=np.zeros(1)),
        SOLVE,
        ("latents.npz was changed after it was written", f"--forcerun {CODE}"),
    ),
    Row(
        "cameras without their arrays",
        lambda: write_npz(SCENE / "scene/cameras.npz", names=np.zeros(1)),
        CONTRIBUTE,
        ("cameras.npz was changed after it was written",),
    ),
    Row(
        "an index that is a list",
        write(MASKS / "index.json", "[]"),
        COVERAGE,
        ("index.json is not the index",),
    ),
    Row("an index 100,000 deep", write(MASKS / "index.json", DEEP), COVERAGE, ("nested too deeply",)),
    Row(
        "an index whose views are a list",
        write(MASKS / "index.json", '{"views": []}'),
        COVERAGE,
        ("index.json",),
    ),
    Row(
        "a scene's index of the wrong shape",
        write(SCENE / "scene/index.json", '{"views": {}}'),
        CONTRIBUTE,
        ("index.json is not the index of an artifact, or is of another version",),
    ),
    Row(
        "Gaussians that are a folder",
        as_folder(GAUSSIANS),
        CONTRIBUTE,
        ("gaussians.ply is not a readable PLY",),
    ),
    Row(
        "a PLY that states 10^12 Gaussians",
        write(
            "huge.ply",
            "ply\nformat ascii 1.0\nelement vertex 1000000000000\nproperty float x\nend_header\n1\n",
        ),
        lambda: load_ply(Path("huge.ply")),
        ("huge.ply is not a readable PLY",),
    ),
    Row(
        "a field that is a folder", as_folder(FIELD), ASK, ("field.safetensors cannot be read", "--forcerun")
    ),
    Row(
        "a code that is a folder",
        as_folder(CODE / "autoencoder.safetensors"),
        SOLVE,
        ("autoencoder.safetensors is a folder",),
    ),
    Row("a damaged field", change(FIELD, 0.0, b"\xff" * 8), ASK, ("field.safetensors cannot be read",)),
    Row(
        "vectors that are text",
        lambda: np.save(CLIP / "000.png.npy", np.array(["a"] * 5)),
        (
            "autoencoder",
            "--contributions",
            str(CONTRIBUTIONS),
            "--semantic-tree",
            str(SCENE / "default/semantic_tree"),
            "--clip",
            str(CLIP),
            *OUT,
        ),
        ("000.png.npy was changed after it was written", f"--forcerun {CLIP}"),
    ),
    Row("one bit of a field", flip(FIELD, 0.7), ASK, ("field.safetensors cannot be read", "changed after")),
    Row(
        "a field of another type",
        lambda: resave_field(lambda features: features.astype(np.float64)),
        ASK,
        ("array features cannot be used", "Float32", "float64"),
    ),
    Row(
        "a field of nan",
        lambda: resave_field(lambda features: features * np.nan),
        ASK,
        ("array features cannot be right", "finite"),
    ),
    Row(
        "a number in an index as text",
        edit(SCENE / "default/semantic_tree/index.json", b'"min_weight": 0', b'"min_weight": "'),
        ASK,
        ("index.json is not valid JSON", "--forcerun"),
    ),
    Row(
        "an index with another number",
        edit(CONTRIBUTIONS / "index.json", b'"num_gaussians": 8', b'"num_gaussians": 9'),
        SOLVE,
        ("index.json was changed after it was written", f"--forcerun {CONTRIBUTIONS}"),
    ),
    Row("vectors of nothing", write(CLIP / "index.json", "[]"), ASK, ("is not the index of an artifact",)),
    Row(
        "one number of G",
        flip(CONTRIBUTIONS / "G/values.npy", 0.5),
        SOLVE,
        ("G/values.npy was changed after it was written", f"--forcerun {CONTRIBUTIONS}"),
    ),
    Row(
        "cameras of another scene beside a tree",
        lambda: move_cameras(SCENE / "scene"),
        ASK,
        ("the semantic tree of photos/desk was made for another cameras.npz",),
    ),
    Row(
        "provenance whose outputs are a list",
        lambda: write_record(FIELD, outputs=[]),
        ASK,
        ("field.safetensors.provenance.json is damaged: outputs",),
    ),
    # ---- queries
    Row(
        "a scene that does not exist",
        nothing,
        ("query", "photos/none", "mug"),
        ("results/photos/none is missing",),
    ),
    Row(
        "a scene that is not finished",
        lambda: Path("results/photos/later/default").mkdir(parents=True),
        ("query", "photos/later", "mug"),
        ("photos/later is not finished", "hilsplat run"),
    ),
    Row(
        "a scene with no stage",
        lambda: Path("results/photos/later").mkdir(parents=True),
        ("query", "photos/later", "mug"),
        ("photos/later is not finished",),
    ),
    Row("a query that is not UTF-8", nothing, ("query", "photos/desk", "mug \udcff"), ("is not UTF-8",)),
    Row("a query of nothing", nothing, ("query", "photos/desk", " > "), ("is empty",)),
    Row("an unknown view", nothing, (*ASK, "--view", "x"), ("x",)),
    Row("an unknown variant", nothing, (*ASK, "--variant", "x"), ("no variant 'x'", "default")),
    # ---- photographs and imports
    Row("a photograph with a brace", photographs("a{1}.png"), NEW, ("a{1}.png", "brace", "rename")),
    Row(
        "a name of 243 bytes", photographs("n" * 239 + ".png"), NEW, ("too long", "at most 200 bytes", "243")
    ),
    Row("a name of 243 bytes, past `new`", photographs("n" * 239 + ".png"), POSES, ("too long", "243")),
    Row("a scene's name of 243 letters", photographs(), ("new", "n" * 243, "photos"), ("longer than 100",)),
    Row(
        "an image of 400 megapixels",
        both(photographs(), write("photos/big.png", png_of(20_000, 20_000))),
        NEW,
        ("big.png", "400000000 pixels"),
    ),
    Row(
        "an image of 400 megapixels, past `new`",
        both(photographs(), write("photos/big.png", png_of(20_000, 20_000))),
        POSES,
        ("big.png", "too large", "shrink it"),
    ),
    Row(
        "poses 100,000 deep",
        both(photographs(), write("photos/transforms.json", DEEP)),
        POSES,
        ("too deeply",),
    ),
    Row(
        "poses that are a list",
        both(photographs(), write("photos/transforms.json", "[]")),
        POSES,
        ("transforms.json has no list `frames`",),
    ),
    Row(
        "frames that are numbers",
        both(photographs(), write("photos/transforms.json", '{"frames": [1, 2, 3]}')),
        POSES,
        ("transforms.json, frame 0",),
    ),
    Row("an import that leaves its folder", transforms(file_path="../secret.png"), POSES, ("outside it",)),
    Row("an import with an absolute path", transforms(file_path="/etc/secret.png"), POSES, ("outside it",)),
    Row(
        "an import that leaves it later",
        transforms(file_path="images/../../secret.png"),
        POSES,
        ("outside it",),
    ),
    Row(
        "LLFF poses that are text",
        both(photographs(), lambda: np.save("photos/poses_bounds.npy", np.array([["a"] * 17] * 3))),
        POSES,
        ("poses_bounds.npy cannot be read", "not numbers"),
    ),
    Row(
        "LangSplat's maps as text",
        lambda: [
            Path("theirs").mkdir(),
            *(
                np.save(f"theirs/{view:03d}_{kind}.npy", np.array(["a"]))
                for view in range(6)
                for kind in "sf"
            ),
        ],
        (*("masks", "--scene", str(SCENE / "scene"), "--features", "theirs", "--out", "results/m"),),
        ("_s.npy cannot be read", "not numbers"),
    ),
    # ---- labels
    Row(
        "labels of 10^9 px",
        write("label.json", isat(height=10**9, width=10**9)),
        lambda: read_isat(Path("label.json")),
        ("label.json does not give the size", "at most 20000", "1000000000"),
    ),
    Row(
        "labels 100,000 deep",
        write("l.json", DEEP),
        lambda: read_isat(Path("l.json")),
        ("nested too deeply",),
    ),
    # ---- output paths
    Row(
        "an output below a file",
        nothing,
        ("coverage-tree", "--masks", str(MASKS), "--out", "config/scenes.tsv/new"),
        ("scenes.tsv is in the way",),
    ),
    Row(
        "a log below a file",
        nothing,
        ("--log", "config/scenes.tsv/log", *COVERAGE),
        ("scenes.tsv is in the way",),
    ),
    Row(
        "an output on a disk without room",
        nothing,
        ("coverage-tree", "--masks", str(MASKS), "--out", "/proc/none/new"),
        ("too little space on the disk of /proc",),
    ),
    Row(
        "a name that no disk takes",
        nothing,
        ("coverage-tree", "--masks", str(MASKS), "--out", "n" * 260),
        ("longer than this disk takes",),
    ),
    # ---- numbers and JSON on the command line
    Row("a seed beyond 64 bits", nothing, (*POSES, "--seed", str(10**30)), ("--seed",)),
    Row(
        "iterations beyond 64 bits",
        nothing,
        (
            *("gaussians", "--scene", str(SCENE / "scene"), "--report", "r", *OUT),
            *("--settings", f'{{"iterations": {10**30}}}'),
        ),
        ("gaussians.iterations", "less than or equal to 2000000000"),
    ),
    Row("settings that are no JSON", nothing, (*COVERAGE, "--settings", "{"), ("coverage_tree", "JSON")),
    Row(
        "names that are no JSON",
        nothing,
        ("table", "lerf", "--published", "config/published/lerf.csv", "--labels", "[1", *OUT),
        ("--labels is not JSON",),
    ),
    # ---- models
    Row(
        "a tokenizer of nothing",
        lambda: [
            shutil.copytree("models/clip-tiny", "models/copy"),
            Path("models/copy/tokenizer.json").write_text("{}"),
        ],
        ("models", "check", "models/copy"),
        ("models/copy/tokenizer.json cannot be read",),
    ),
    Row(
        "a tokenizer without words",
        lambda: [
            shutil.copytree("models/clip-tiny", "models/copy"),
            Path("models/copy/tokenizer.json").write_text(
                json.dumps({"model": {"type": "WordLevel", "vocab": {}, "unk_token": "x"}})
            ),
        ],
        ("models", "check", "models/copy"),
        ("models/copy/tokenizer.json", "no word"),
    ),
    Row(
        "a model's configuration 100,000 deep",
        lambda: [
            shutil.copytree("models/clip-tiny", "models/copy"),
            Path("models/copy/config.json").write_text(DEEP),
        ],
        ("models", "check", "models/copy"),
        ("models/copy has no readable config.json",),
    ),
    # ---- configuration, refused while the workflow is parsed
    Row(
        "a missing model",
        nothing,
        plan(clip={"model": "models/nope"}),
        ("clip.model", "models/nope is missing"),
    ),
    Row(
        "a CLIP as SAM",
        nothing,
        plan(masks={"segmenter": "sam", "model": "models/clip-tiny"}),
        ("masks.model", "another kind of model"),
    ),
    Row(
        "an infinite weight",
        nothing,
        plan(field={"weight_part": float("inf")}),
        ("field.weight_part", "finite"),
    ),
    Row(
        "a misspelt group in overrides",
        nothing,
        plan(overrides={"photo": {}}),
        ("overrides.photo", "'photos'"),
    ),
    Row(
        "a misspelt scene in overrides",
        nothing,
        plan(overrides={"synthetic/tabel-1": {}}),
        ("synthetic/tabel-1", "did you mean 'synthetic/table-1'"),
    ),
    Row(
        "a misspelt data set in overrides",
        nothing,
        plan(overrides={"sinthetic/table-1": {}}),
        ("did you mean",),
    ),
    Row(
        "a misspelt scene in sweep_scenes",
        nothing,
        plan(sweep_scenes=["table-1", "tabel-2"]),
        ("sweep_scenes", "tabel-2", "did you mean 'table-2'"),
    ),
    Row("a null byte in a label", nothing, plan(labels={"default": "a\0b"}), ("null byte",)),
    Row("a variant whose name is a command", nothing, plan(variants={"$(touch x)": {}}), ("'$(touch x)'",)),
    Row("a misspelt data set in queries", nothing, plan(queries={"foto": ["a"]}), ("queries.foto", "photos")),
    Row(
        "a misspelt variant in labels", nothing, plan(labels={"lifeted": "x"}), ("labels.lifeted", "'lifted'")
    ),
    Row(
        "YAML with a bracket left open",
        write("config/config.yaml", "seed: 0\nonly: [a\nseeds: 1\n"),
        lambda: read_config(Path("config/config.yaml")),
        ("config/config.yaml, line 3", "is not YAML"),
    ),
    Row(
        "YAML with tabs",
        write("config/config.yaml", "masks:\n\tmodel: x\n"),
        lambda: read_config(Path("config/config.yaml")),
        ("config/config.yaml, line 2, column 1",),
    ),
    Row(
        "YAML for --configfile with a bracket left open",
        write("my.yaml", "seed: 0\nonly: [a\nseeds: 1\n"),
        (*CHECK, "my.yaml"),
        ("my.yaml, line 3", "is not YAML"),
    ),
    Row(
        "YAML for --configfile in Latin-1",
        write("my.yaml", b"labels: {a: \xff}\n"),
        (*CHECK, "my.yaml"),
        ("my.yaml cannot be read", "UTF-8"),
    ),
    Row("a missing configuration file", nothing, (*CHECK, "my.yaml"), ("my.yaml is missing",)),
    Row(
        "a misspelt key for --configfile",
        write("my.yaml", "field: {weight_prt: 1}\n"),
        (*CHECK, "my.yaml"),
        ("field.weight_prt: unknown key", "did you mean 'weight_part'"),
    ),
    Row(
        "YAML that is a list",
        write("config/config.yaml", "- a\n"),
        lambda: read_config(Path("config/config.yaml")),
        ("does not hold settings", "list"),
    ),
]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.what)
def test_bad_input_is_reported_and_nothing_is_lost(row: Row, project: Path, told: Callable[..., str]) -> None:
    row.lay()
    before = snapshot(project)
    text = told(row.command)
    assert "Traceback" not in text
    assert "delete it" not in text
    for words in row.words:
        assert words in text
    after = snapshot(project)
    assert {path: after.get(path) for path in before} == before
    assert not list(project.rglob(".writing-*"))


@pytest.mark.skipif(cuda_problem() is None, reason="this machine has CUDA")
@pytest.mark.parametrize("section", ["gaussians", "contributions"])
def test_a_device_that_is_not_here_is_reported(section: str, project: Path, told: Callable[..., str]) -> None:
    assert f"{section}.device" in told(plan(**{section: {"device": "cuda"}}))


@pytest.mark.parametrize("damage", [b"", b"\xff" * 200])
def test_a_damaged_entry_of_a_cache_is_computed_again(project: Path, damage: bytes) -> None:
    cache = ViewCache(project / "cache")
    cache.get("ab", lambda: {"x": np.arange(1000)})
    content = cache.path("ab").read_bytes()
    half = len(content) // 2
    rest = content[half + len(damage) :] if damage else b""
    cache.path("ab").write_bytes(content[:half] + damage + rest)
    np.testing.assert_array_equal(cache.get("ab", lambda: {"x": np.arange(1000)})["x"], np.arange(1000))
    assert (cache.hits, cache.misses) == (0, 2)


@pytest.mark.parametrize("text", ["mug " * 100, r"$\frac{$", "mug/../../x", "ü" * 90, "--"])
def test_any_text_can_be_asked_and_has_a_folder_of_its_own(text: str, project: Path, capsys) -> None:
    from hilsplat.query.answer import answer, file_name

    lines = list(answer(SCENE, text, views=1))
    assert lines[-1].startswith("wrote")
    (folder,) = [path for path in (SCENE / "queries").iterdir() if not path.name.startswith(".")]
    assert folder.name == file_name(text) and (folder / "panel.png").is_file()


def test_texts_that_look_alike_as_folders_have_different_ones() -> None:
    from hilsplat.query.answer import file_name

    texts = ["a b", "a-b", "a > b", "a--b", "a/b", "$$", "%%", "query", "x" * 300, "x" * 301]
    assert len({file_name(text) for text in texts}) == len(texts)
    assert all(len(file_name(text)) < 120 for text in texts)
