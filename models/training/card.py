"""Model cards of the small models: recipe, quality and limitations."""

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from hilsplat.base.artifacts import sha256_of_file, write_json, write_text
from hilsplat.base.images import write_png
from hilsplat.base.levels import LEVELS
from models.training.clip import CROP_PX, DIMENSIONS
from models.training.data import HEAD_LEVELS, LabelledViews, nested_targets
from models.training.measure_clip import COMMON
from models.training.measure_sam import SIZES, predict_masks
from models.training.sam import FRAME_PX, MASK_STRIDE, SamDecoder, SamEncoder
from models.training.steps import Curve

RECORD = "training.json"
CARD = "README.md"
PICTURES = ("curve.png", "masks.png")
LEVEL_COLOURS = {"whole": "#1b6ca8", "part": "#d1791e", "subpart": "#3d8f4f"}


def digests(folder: Path) -> dict[str, str]:
    """Return the SHA-256 of each file of a model, except its card, record and pictures."""
    folder = Path(folder)
    about = {RECORD, CARD, *PICTURES}
    return {
        str(path.relative_to(folder)): sha256_of_file(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in about
    }


def draw_curve(path: Path, curve: Curve, series: Mapping[str, str], what: str) -> None:
    """Draw a learning curve.

    Args:
        path: PNG file to write.
        curve: learning curve.
        series: column name by level label.
        what: label of the value axis.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6, 2.8), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    steps = [row["step"] for row in curve.rows]
    for label, column in series.items():
        values = [row.get(column, np.nan) for row in curve.rows]
        axes.plot(steps, values, marker=".", color=LEVEL_COLOURS[label], label=label)
    axes.set(xlabel="step", ylabel=what, ylim=(0, 1))
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    write_png(path, np.asarray(Image.open(buffer).convert("RGB")))


def draw_masks(
    path: Path, encoder: SamEncoder, decoder: SamDecoder, views: LabelledViews, rows: int = 4, seed: int = 1
) -> None:
    """Draw the segmenter's masks for single points in some views.

    Columns: the view with the point in red, the predicted subpart, part and whole, then the true ones.
    """
    import cv2

    lines = []
    for row in range(rows):
        view = row * len(views) // rows
        rng = np.random.default_rng((seed, row))
        target = nested_targets(views.labels[view])
        fine = np.argwhere(views.labels[view][2] >= 0)
        if not len(fine):
            fine = np.argwhere(target[0] >= 0)
        y, x = fine[int(rng.integers(len(fine)))]
        image = views.images[view]
        _, logits = predict_masks(encoder, decoder, image, np.array([[x + 0.5, y + 0.5]]))
        shown = image.copy()
        cv2.circle(shown, (int(x), int(y)), 4, (255, 0, 0), -1)
        cells = [shown]
        for head in range(len(HEAD_LEVELS)):
            guess = cv2.resize(logits[0, head], image.shape[1::-1], interpolation=cv2.INTER_LINEAR) > 0
            cells.append(np.where(guess[..., None], image, image // 5))
        for head in range(len(HEAD_LEVELS)):
            truth = target[head] == target[head][y, x]
            cells.append(np.where(truth[..., None], image, image // 5))
        lines.append(
            np.hstack([cv2.resize(cell, (160, 160), interpolation=cv2.INTER_AREA) for cell in cells])
        )
    write_png(path, np.vstack(lines))


WARNING = (
    "This network knows one synthetic world (the scenes of `hilsplat.world`) and nothing else.\n"
    "It stands in for {real} so that the whole method runs, is tested and is measured without a download.\n"
    "Its results on photographs are meaningless, and its numbers say nothing about {real}."
)


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

    Args:
        folder: the model folder.
        encoder: encoder of the segmenter.
        decoder: decoder of the segmenter.
        unseen: views that were not trained on.
        recipe: training recipe.
        curve: learning curve.
        metrics: "points" from `measure_sam` and "automatic" from `measure_everything`, each by kind of scene
            ("all" first) and level.
    """
    folder = Path(folder)
    draw_curve(folder / "curve.png", curve, {level.label: level.label for level in LEVELS}, "mean IoU")
    draw_masks(folder / "masks.png", encoder, decoder, unseen)
    points, automatic = [], []
    for kind in metrics["points"]:
        for level in LEVELS:
            found = metrics["points"][kind][level.label]
            points.append(
                f"| {kind} | {level.label} | {found['iou']:.2f} | {found['best']:.2f} |"
                f" {100 * found['above_75']:.0f} % | {found['correlation']:.2f} | {found['n']:.0f} |"
                + "".join(f" {found[f'iou_{size}']:.2f} ({found[f'n_{size}']}) |" for size in SIZES)
            )
            found = metrics["automatic"][kind][level.label]
            automatic.append(
                f"| {kind} | {level.label} | {found['recall']:.2f} | {found['iou']:.2f} |"
                f" {found['masks']:.0f} | {found['precision']:.2f} | {found['n']:.0f} |"
            )
    parameters = sum(p.numel() for module in (encoder, decoder) for p in module.parameters())
    mask_px = FRAME_PX // MASK_STRIDE
    body = f"""# sam-tiny

{WARNING.format(real="SAM")}

A promptable segmenter of {parameters / 1e6:.1f} million parameters in the layout of the Hugging Face ONNX
exports of SAM: an image of {FRAME_PX} x {FRAME_PX} and points in, three masks (subpart, part, whole) of
{mask_px} x {mask_px} and their predicted IoU out. Where the world has no subpart at a point, the
first mask is the part; where it has no part, the whole. Weights are stored as float16 and computed in
float32.

## How good it is
On {recipe["validation_scenes"]} scenes of the training range on which nothing was trained; regions of at
least 100 px of views of {FRAME_PX} x {FRAME_PX}.

One point: a region is drawn first and a pixel in it second, and the mask of that level's head is compared
with the region. "Best head" takes the best of the three masks; the correlation is that of predicted and
true IoU. The last columns are mean IoU (and number) of regions below {SIZES["small"][1]} px, below
{SIZES["medium"][1]} px and above.

| scenes | level | mean IoU | best head | IoU above 0.75 | correlation | regions | small | medium | large |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{chr(10).join(points)}

No prompt: the masks of the pipeline's own stage with its default settings.

| scenes | level | recall at IoU 0.5 | mean best IoU | masks per view | precision | regions |
| --- | --- | --- | --- | --- | --- | --- |
{chr(10).join(automatic)}

![learning curve](curve.png)

Point, predicted subpart, part, whole, then the true ones:

![masks](masks.png)

{_recipe_text(recipe, curve, folder)}"""
    write_text(folder / CARD, body)
    _write_record(folder, recipe, curve, metrics)


def write_clip_card(
    folder: Path,
    recipe: Mapping[str, Any],
    curve: Curve,
    metrics: Mapping[str, Any],
) -> None:
    """Write card, record and learning curve beside an exported CLIP.

    Args:
        folder: the model folder.
        recipe: training recipe.
        curve: learning curve.
        metrics: "black" and "keep" from `measure_clip` by kind of mask and level, "queries" from
            `measure_queries`.
    """
    folder = Path(folder)
    draw_curve(
        folder / "curve.png", curve, {level.label: f"exact_{level.label}" for level in LEVELS}, "top-1, exact"
    )
    rows = [
        f"| {background} | {kind} | {level.label} | {100 * found['top1']:.0f} % |"
        f" {100 * found['top3']:.0f} % | {100 * found['top1_of_level']:.0f} % |"
        f" {100 * found['top1_of_common']:.0f} % | {100 * found['coloured']:.0f} % |"
        f" {100 * found['above_canonical']:.0f} % | {found['n']} |"
        for background in ("black", "keep")
        for kind in ("exact", "rough")
        for level in LEVELS
        if (found := metrics[background].get(kind, {}).get(level.label))
    ]
    together = [
        f"| {label} | {found['iou']:.2f} | {found['instance']:.2f} | {found['best']:.2f} | {found['n']} |"
        for label, found in metrics["queries"].items()
    ]
    body = f"""# clip-tiny

{WARNING.format(real="CLIP")}

Crops of {CROP_PX} x {CROP_PX} and short English phrases in one space of {DIMENSIONS} dimensions, in the
layout of the Hugging Face ONNX exports of CLIP. It knows the words of the world's texts and no others.
Pixels outside a mask are black in most of its training crops (settings `clip.background: black`), kept in
the others (`keep`). "object", "things", "stuff" and "texture" were captions of crops drawn without
looking, so they mean nothing in particular. Weights are stored as float16 and computed in float32.

## How good it is
Crops of scenes of the training range on which nothing was trained. "exact" are true masks of at least 24 px,
"rough" those that `sam-tiny` drew and whose IoU with a node is above 0.5. All
{recipe["texts_competing"]} texts of those scenes (all levels) compete, or those seen at the mask's own
level, or the {COMMON} commonest of each level (for masks that have one of them). "Colour": top-1 among all
texts of the form "red kettle lid". "Canonical": the right text beats all four canonical phrases.

| background | masks | level | top-1 | top-3 | of level | of {3 * COMMON} | colour | canonical | crops |
| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |
{chr(10).join(rows)}

Both models together, one view at a time: the automatic mask of the level whose similarity to a text is
highest, compared with the union of all regions that the text names, and with the one it fits best. "Best
mask" is what a perfect CLIP would reach with these masks and the second comparison.

| level | mean IoU, union | mean IoU, one region | best mask | texts |
| --- | --- | --- | --- | --- |
{chr(10).join(together)}

Trained on {recipe["masks"]} masks, {recipe["segmented_masks"]} of them drawn by `sam-tiny`, the
others true ones, of which most are roughened when they are drawn.

![learning curve](curve.png)

{_recipe_text(recipe, curve, folder)}"""
    write_text(folder / CARD, body)
    _write_record(folder, recipe, curve, metrics)


def _recipe_text(recipe: Mapping[str, Any], curve: Curve, folder: Path) -> str:
    kinds = ", ".join(f"{count} {kind}" for kind, count in recipe["kinds"].items())
    files = "\n".join(f"| `{name}` | `{digest}` |" for name, digest in digests(folder).items())
    columns = [name for name in curve.rows[-1] if not name.endswith("_loss")] if curve.rows else []
    table = "\n".join(
        f"| {' | '.join(f'{row[name]:.3g}' if name != 'step' else f'{row[name]:.0f}' for name in columns)} |"
        for row in curve.rows
    )
    first, last = recipe["training_seeds"]
    lowest, highest = recipe["validation_seeds"]
    return f"""## Recipe
`python -m models.training` repeats it: the same steps give the same weights on the same machine with the same
number of threads; elsewhere the last digits of sums differ, and so do the weights.

- generator of the world: version and digest of its output {recipe["generator"]}
- training scenes: seeds {first} to {last} ({kinds}), {recipe["views"]} views each, {FRAME_PX} x {FRAME_PX}
- measured on: seeds {lowest} to {highest}. Benchmark and development scenes come from other ranges of
  seeds, and the code refuses them here.
- {recipe["steps"]} steps of AdamW with averaged weights; the learning rate is constant and falls to nothing
  over the last quarter; seed {recipe["seed"]}, recipe {recipe["version"]}
- {recipe["minutes"]:.0f} minutes with {recipe["threads"]} threads of a shared machine ({recipe["device"]}),
  torch {recipe["torch"]}

| {" | ".join(columns)} |
|{" --- |" * len(columns)}
{table}

## Files

| file | sha256 |
| --- | --- |
{files}
"""


def _write_record(
    folder: Path,
    recipe: Mapping[str, Any],
    curve: Curve,
    metrics: Mapping[str, Any],
) -> None:
    write_json(
        folder / RECORD,
        {"recipe": dict(recipe), "metrics": metrics, "curve": curve.rows, "sha256": digests(folder)},
    )
