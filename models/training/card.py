"""Model cards of the small models: recipe, quality and limitations."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hilsplat.base.artifacts import write_json, write_text
from hilsplat.base.images import write_png
from hilsplat.base.levels import LEVELS
from hilsplat.base.lineage import sha256_of_file
from hilsplat.base.tables import markdown_table
from hilsplat_world.diagnostics.mask_truth import MIN_PX
from models.training.clip import CROP_PX, DIMENSIONS
from models.training.data import LabelledViews, nested_targets
from models.training.loop import Curve
from models.training.measure_clip import COMMON
from models.training.measure_sam import SIZES, predict_masks
from models.training.sam import FRAME_PX, MASK_STRIDE, SamDecoder, SamEncoder

RECORD = "training.json"
CARD = "README.md"
PICTURES = ("curve.png", "masks.png")
LEVEL_COLOURS = {"whole": "#1b6ca8", "part": "#d1791e", "subpart": "#3d8f4f"}


def digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file of a model, except its card, record and pictures."""
    about = {RECORD, CARD, *PICTURES}
    return {
        str(path.relative_to(folder)): sha256_of_file(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in about
    }


def draw_curve(folder: Path, curve: Curve, prefix: str, what: str) -> None:
    """Draw the column `<prefix><level>` of a learning curve for each level; `what` labels the value axis."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6, 2.8), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    steps = [row["step"] for row in curve]
    for label, colour in LEVEL_COLOURS.items():
        values = [row.get(f"{prefix}{label}", np.nan) for row in curve]
        axes.plot(steps, values, marker=".", color=colour, label=label)
    axes.set(xlabel="step", ylabel=what, ylim=(0, 1))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    figure.savefig(folder / "curve.png", metadata={"Software": None})


def draw_masks(folder: Path, encoder: SamEncoder, decoder: SamDecoder, views: LabelledViews) -> None:
    """Draw the segmenter's masks for single points in four views.

    Columns: the view with the point in red; the predicted subpart, part and whole; then the ground truth.
    """
    import cv2

    lines = []
    for row in range(4):
        view = row * len(views) // 4
        rng = np.random.default_rng((1, row))
        target = nested_targets(views.labels[view])
        fine = np.argwhere(views.labels[view][2] >= 0)
        if not len(fine):
            fine = np.argwhere(target[0] >= 0)
        y, x = fine[int(rng.integers(len(fine)))]
        image = views.images[view]
        _, logits = predict_masks(encoder, decoder, image, np.array([[x + 0.5, y + 0.5]]))
        marked = image.copy()
        cv2.circle(marked, (int(x), int(y)), 4, (255, 0, 0), -1)
        size = image.shape[1::-1]
        masks = [cv2.resize(mask, size, interpolation=cv2.INTER_LINEAR) > 0 for mask in logits[0]]
        masks += [mask == mask[y, x] for mask in target]
        cells = [marked, *(np.where(mask[..., None], image, image // 5) for mask in masks)]
        lines.append(
            np.hstack([cv2.resize(cell, (160, 160), interpolation=cv2.INTER_AREA) for cell in cells])
        )
    write_png(folder / "masks.png", np.vstack(lines))


WARNING = """This network was trained only on one synthetic world (the scenes of `hilsplat_world`).
It replaces {real} so that the complete method can be run, tested and measured without a download.
Its results on photographs are meaningless, and its scores don't apply to {real}."""


def write_sam_card(
    folder: Path,
    encoder: SamEncoder,
    decoder: SamDecoder,
    unseen: LabelledViews,
    recipe: Mapping[str, Any],
    curve: Curve,
    metrics: Mapping[str, Mapping[str, Mapping[str, Mapping[str, float]]]],
) -> None:
    """Write card, record, learning curve and a picture of masks beside an exported segmenter.

    `metrics` contains "points" from `measure_sam` and "automatic" from `measure_everything`, each by kind of
    scene ("all" first) and level. The masks are of `unseen` views.
    """
    draw_curve(folder, curve, "", "mean IoU")
    draw_masks(folder, encoder, decoder, unseen)
    points, automatic = [], []
    for kind in metrics["points"]:
        for level in LEVELS:
            score = metrics["points"][kind][level.label]
            scores = [f"{score['iou']:.2f}", f"{score['best']:.2f}", f"{100 * score['above_75']:.0f} %"]
            scores += [f"{score['correlation']:.2f}", f"{score['n']:.0f}"]
            scores += [f"{score[f'iou_{size}']:.2f} ({score[f'n_{size}']})" for size in SIZES]
            points.append((kind, level.label, *scores))
            score = metrics["automatic"][kind][level.label]
            scores = [f"{score['recall']:.2f}", f"{score['iou']:.2f}", f"{score['masks']:.0f}"]
            automatic.append((kind, level.label, *scores, f"{score['precision']:.2f}", f"{score['n']:.0f}"))
    parameters = sum(p.numel() for module in (encoder, decoder) for p in module.parameters())
    mask_px = FRAME_PX // MASK_STRIDE
    point_columns = ("scenes", "level", "mean IoU", "best head", "IoU above 0.75", "correlation", "regions")
    automatic_columns = ("scenes", "level", "recall at IoU 0.5", "mean best IoU", "masks per view")
    body = f"""# sam-tiny

{WARNING.format(real="SAM")}

A promptable segmenter of {parameters / 1e6:.1f} million parameters in the layout of the Hugging Face ONNX
exports of SAM. Its inputs are an image of {FRAME_PX} x {FRAME_PX} and points; its outputs are three masks
(subpart, part, whole) of {mask_px} x {mask_px} and their predicted IoU. Where the world has no subpart at a
point, the first mask is the part or, without a part, the whole. Weights are stored as float16 and computed
in float32.

## Quality
Measured on {recipe["validation_scenes"]} held-out scenes from the training range, for regions of at least
{MIN_PX} px in views of {FRAME_PX} x {FRAME_PX}.

One point: a region and then a pixel in it are sampled, and the mask from the head of the region's level is
compared with the region. "Best head" uses the best of the three masks; the correlation is between predicted
and actual IoU. The last columns are the mean IoU (and number) of regions below {SIZES["small"][1]} px,
below {SIZES["medium"][1]} px and larger.

{_table((*point_columns, *SIZES), points)}

Without prompts: the masks of the pipeline's `masks` stage with its default settings.

{_table((*automatic_columns, "precision", "regions"), automatic)}

![learning curve](curve.png)

Point; predicted subpart, part and whole; then the ground truth:

![masks](masks.png)
"""
    _write_card(folder, body, recipe, curve, metrics)


def write_clip_card(
    folder: Path, recipe: Mapping[str, Any], curve: Curve, metrics: Mapping[str, Any]
) -> None:
    """Write card, record and learning curve beside an exported CLIP.

    `metrics` contains "black" and "keep" from `measure_clip`, by kind of mask and level, and "queries" from
    `measure_queries`.
    """
    draw_curve(folder, curve, "exact_", "top-1, exact")
    shares = ("top1", "top3", "top1_of_level", "top1_of_common", "coloured", "above_canonical")
    rows = [
        (background, kind, level.label, *(f"{100 * score[name]:.0f} %" for name in shares), score["n"])
        for background in ("black", "keep")
        for kind in ("exact", "rough")
        for level in LEVELS
        if (score := metrics[background].get(kind, {}).get(level.label))
    ]
    columns = ("background", "masks", "level", "top-1", "top-3", "of level", f"of {3 * COMMON}")
    together = [
        (label, f"{score['iou']:.2f}", f"{score['instance']:.2f}", f"{score['best']:.2f}", score["n"])
        for label, score in metrics["queries"].items()
    ]
    body = f"""# clip-tiny

{WARNING.format(real="CLIP")}

It embeds crops of {CROP_PX} x {CROP_PX} pixels and short English phrases in a shared space of {DIMENSIONS}
dimensions, in the layout of the Hugging Face ONNX exports of CLIP. Its vocabulary is limited to the words of
the world's texts. Pixels outside a mask are black in most training crops (setting `clip.background: black`)
and kept in the others (`keep`). "object", "things", "stuff" and "texture" were captions of random crops, so
they have no specific meaning. Weights are stored as float16 and computed in float32.

## Quality
Measured on crops of held-out scenes from the training range. "Exact": ground-truth masks of at least 24 px;
"rough": masks from `sam-tiny` whose IoU with a node is above 0.5. The candidates are all
{recipe["texts_competing"]} texts of those scenes (all levels), the texts of the mask's own level, or the
{COMMON} most common of each level (for masks that have one of them). "Colour": top-1 among all texts of the
form "red kettle lid". "Canonical": the correct text beats all four canonical phrases.

{_table((*columns, "colour", "canonical", "crops"), rows)}

Both models together, one view at a time: for each text, the most similar automatic mask of the level is
compared with the union of all regions that the text names, and with the region that it fits best. "Best mask"
is the result of a perfect CLIP with these masks in the second comparison.

{_table(("level", "mean IoU, union", "mean IoU, one region", "best mask", "texts"), together)}

Trained on {recipe["masks"]} masks: {recipe["segmented_masks"]} from `sam-tiny`, the others ground truth, most
of which are roughened when sampled.

![learning curve](curve.png)
"""
    _write_card(folder, body, recipe, curve, metrics)


def _table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    return markdown_table(columns, rows, words=len(columns))


def _write_card(
    folder: Path, body: str, recipe: Mapping[str, Any], curve: Curve, metrics: Mapping[str, Any]
) -> None:
    """Write the card, with recipe and digests after `body`, and the record."""
    kinds = ", ".join(f"{count} {kind}" for kind, count in recipe["kinds"].items())
    columns = [name for name in curve[-1] if not name.endswith("_loss")]
    rows = [
        [f"{row[name]:.3g}" if name != "step" else f"{row[name]:.0f}" for name in columns] for row in curve
    ]
    first, last = recipe["training_seeds"]
    lowest, highest = recipe["validation_seeds"]
    files = digests(folder)
    ending = f"""
## Recipe
`python -m models.training` repeats this training: the same steps give the same weights on the same machine
with the same number of threads. On other machines, rounding differs, and so do the weights.

- world generator: version and digest of its output {recipe["generator"]}
- training scenes: seeds {first} to {last} ({kinds}), {recipe["views"]} views each, {FRAME_PX} x {FRAME_PX}
- measured on: seeds {lowest} to {highest}. Benchmark and development scenes use other seed ranges,
  which training rejects.
- {recipe["steps"]} steps of AdamW with averaged weights; the learning rate is constant, then decays to zero
  over the last quarter; seed {recipe["seed"]}, recipe {recipe["version"]}
- {recipe["minutes"]:.0f} minutes with {recipe["threads"]} threads on a shared machine ({recipe["device"]}),
  torch {recipe["torch"]}

{_table(columns, rows)}

## Files

{_table(("file", "sha256"), [(f"`{name}`", f"`{digest}`") for name, digest in files.items()])}
"""
    write_text(folder / CARD, body + ending)
    record = {"recipe": dict(recipe), "metrics": metrics, "curve": curve, "sha256": files}
    write_json(folder / RECORD, record)
