"""A finished scene in half a minute: coloured plates, a CLIP of colours, and every stage by its own command.

The desk has a red mug with a green handle with a yellow rim, and a blue book with a green label. The CLIP
embeds an image as its mean colour and a text as the colours of its words; words that it does not know are
grey.
"""

import json
import logging
import os
import shutil
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import onnx.parser
from tokenizers import Tokenizer, models, pre_tokenizers

from hilsplat.base.artifacts import write_index, write_json
from hilsplat.base.images import write_png
from hilsplat.base.lineage import Inputs, write_provenance
from hilsplat.cli.main import app
from hilsplat.scene.scene import Scene
from hilsplat.segment.digests import index_entry
from hilsplat.splat.coordinates import write_coordinates
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import save_ply
from tests.conftest import PROJECT
from tests.unit.evaluate.builders import cameras_of, masks_of
from tests.unit.round_gaussians import round_gaussians

HEIGHT, WIDTH = 24, 36
NUM_VIEWS = 6
GENERIC = (1, 1, 1)
WORDS = {"mug": (1, 0, 0), "handle": (0, 1, 0), "book": (0, 0, 1), "rim": (1, 1, 0)}
REGIONS = (
    # name, level, rows, columns, colour; a region is painted over those before it
    ("mug", 1, (0, 24), (0, 16), (250, 0, 0)),
    ("book", 1, (0, 24), (16, 36), (0, 0, 250)),
    ("handle", 2, (4, 16), (2, 12), (40, 220, 0)),
    ("label", 2, (4, 14), (20, 28), (0, 250, 0)),
    ("rim", 3, (4, 8), (2, 12), (250, 250, 0)),
)
SCENE = Path("results/photos/desk")


def painted(regions: Sequence[tuple], size_hw: tuple[int, int]) -> np.ndarray:
    canvas = np.zeros((*size_hw, 3), np.uint8)
    for _, _, rows, columns, colour in regions:
        canvas[slice(*rows), slice(*columns)] = colour
    return canvas


def plate(canvas: np.ndarray) -> Gaussians:
    """A Gaussian at (column, row, 0) for each pixel, in its colour."""
    rows, columns = np.divmod(np.arange(canvas[..., 0].size), canvas.shape[1])
    colours = (canvas.reshape(-1, 3) / 255 - 0.5) / 0.28209479177387814
    means = np.stack([columns, rows, np.zeros(len(rows))], axis=1)
    plain = round_gaussians(means, log_scale=np.log(0.25), opacity_logit=5.0)
    return replace(plain, sh=colours.astype(np.float32)[:, None])


def run_stage(
    places: Mapping[str, Path],
    command: str,
    out: Path,
    *inputs: str,
    settings: object = None,
    more: tuple = (),
) -> None:
    """Run a stage by its command, with the paths of its inputs."""
    options = [word for name in inputs for word in (f"--{name.replace('_', '-')}", str(places[name]))]
    words = [command, *options, "--out", str(out), "--settings", json.dumps(settings or {}), *more]
    app(words, standalone_mode=False)


def region_mask(name: str, shift: int = 0) -> np.ndarray:
    """Pixels of a region in view number `shift`, (24, 42) bool."""
    _, _, rows, columns, _ = next(region for region in REGIONS if region[0] == name)
    mask = np.zeros((HEIGHT, WIDTH + NUM_VIEWS), bool)
    mask[slice(*rows), columns[0] + shift : columns[1] + shift] = True
    return mask


def write_colour_clip(folder: Path) -> None:
    """A CLIP of 4-px crops whose vectors are colours."""
    table = np.array([GENERIC, *WORDS.values()], np.float32)
    table /= np.linalg.norm(table, axis=1, keepdims=True)
    rows = ", ".join(map(str, table.ravel().tolist()))
    head = '<ir_version: 9, opset_import: ["": 17]> colours'
    vision = f"""{head} (float[batch, 3, 4, 4] pixel_values) => (float[batch, 3] image_embeds) {{
        image_embeds = ReduceMean <axes = [2, 3], keepdims = 0> (pixel_values) }}"""
    text = f"""{head} (int64[batch, words_of_text] input_ids) => (float[batch, 3] text_embeds)
        <float[{len(table)}, 3] table = {{{rows}}}, int64[1] one = {{1}}> {{
        words = Gather (table, input_ids)
        text_embeds = ReduceSum <keepdims = 0> (words, one) }}"""
    folder.mkdir(parents=True)
    for name, graph in (("vision_model", vision), ("text_model", text)):
        onnx.save(onnx.parser.parse_model(graph), folder / f"{name}.onnx")
    described = {"size": {"shortest_edge": 4}, "crop_size": {"height": 4, "width": 4}}
    described |= {"image_mean": [0, 0, 0], "image_std": [1, 1, 1]}
    (folder / "config.json").write_text(json.dumps({"model_type": "clip"}))
    (folder / "preprocessor_config.json").write_text(json.dumps(described))
    tokenizer = Tokenizer(models.WordLevel({"[UNK]": 0} | {w: 1 + n for n, w in enumerate(WORDS)}, "[UNK]"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.save(str(folder / "tokenizer.json"))


def build_finished_desk(project: Path) -> Path:
    """Write `models/colours` and `results/photos/desk` into a folder; returns the folder."""
    before, handlers = Path.cwd(), list(logging.getLogger().handlers)
    write_colour_clip(project / "models/colours")
    os.chdir(project)  # paths in provenance are relative, as the workflow writes them
    try:
        _write_scene()
        _run_stages()
    finally:
        os.chdir(before)
        logging.getLogger().handlers[:] = handlers
    return project


def pack_photographs(project: Path) -> None:
    """Write the photographs of the scene to `photos.zip`, and copy the shipped configuration."""
    shutil.copytree(PROJECT / "config", project / "config")
    with zipfile.ZipFile(project / "photos.zip", "w") as archive:
        for path in sorted((project / SCENE / "scene/images").iterdir()):
            archive.write(path, path.name)


def _write_scene() -> None:
    """Photographs, cameras and Gaussians; a Gaussian is a pixel of every view."""
    canvas = painted(REGIONS, (HEIGHT, WIDTH))
    names = tuple(f"{view:03d}.png" for view in range(NUM_VIEWS))
    distance = 30.0
    poses = np.tile(np.eye(4), (NUM_VIEWS, 1, 1))
    poses[:, 2, 3] = distance
    poses[:, 0, 3] = np.arange(NUM_VIEWS)  # one unit is one pixel
    K = np.array([[distance, 0, 0.5], [0, distance, 0.5], [0, 0, 1]])
    for shift, name in enumerate(names):
        photograph = np.zeros((HEIGHT, WIDTH + NUM_VIEWS, 3), np.uint8)
        photograph[:, shift : shift + WIDTH] = canvas
        write_png(SCENE / "scene/images" / name, photograph)
    cameras = cameras_of(poses, K, (HEIGHT, WIDTH + NUM_VIEWS))
    split = {name: "test" if name == names[-1] else "train" for name in names}
    points = np.zeros((0, 3), np.float32)
    colours = points.astype(np.uint8)
    scene = Scene(SCENE / "scene", "photos/desk", "arbitrary", cameras, split, points, colours, np.eye(4))
    scene.save()
    write_json(SCENE / "scene/registration.json", {"poses": "given", "views": {}})
    gaussians = plate(canvas)
    save_ply(SCENE / "gaussians.ply", gaussians)
    write_coordinates(SCENE / "gaussians.ply", scene, gaussians, {"kind": "fitted"})
    masks, entries = SCENE / "default/masks", {}
    for shift, name in enumerate(names[:-1]):
        dense = [region_mask(region[0], shift) for region in REGIONS]
        found = masks_of(dense, [region[1] for region in REGIONS])
        found.save(masks / f"{name}.npz")
        entries[name] = index_entry(found)
    identity = {"segmenter": "graph", "model": None, "model_sha256": None}
    write_index(masks, entries, scene="photos/desk", **identity)
    inputs = Inputs("masks", {"scene": SCENE / "scene"})
    record = {"code": "", "command": (), "settings": {}, "seed": None, "inputs": inputs}
    write_provenance(masks, stage="masks", **record)


def _run_stages() -> None:
    """From masks to scores, each stage by its command."""
    places = {
        name: SCENE / "default" / name
        for name in ("masks", "coverage_tree", "clip", "contributions", "semantic_tree", "autoencoder")
    }
    places |= {"scene": SCENE / "scene", "gaussians": SCENE / "gaussians.ply"}
    places |= {"field": SCENE / "default/field.safetensors"}

    run = partial(run_stage, places)
    cache = ("--cache", "results/.cache")
    model = {"model": "models/colours"}
    run("coverage-tree", places["coverage_tree"], "masks")
    run("clip", places["clip"], "scene", "masks", settings=model, more=cache)
    run("contributions", places["contributions"], "scene", "gaussians", "masks", more=cache)
    run("semantic-tree", places["semantic_tree"], "contributions", "masks")
    code = {"code": "pca", "latent": 2}
    inputs = ("clip", "semantic_tree", "contributions")
    run("autoencoder", places["autoencoder"], *inputs, settings=code)
    run("field", places["field"], "contributions", "coverage_tree", "autoencoder")
    parts = ("scene", "gaussians", "semantic_tree", "field", "autoencoder", "clip", "masks")
    rows = ("--dataset", "photos", "--name", "desk")
    run("evaluate", SCENE / "default/scores.csv", *parts, more=rows)
