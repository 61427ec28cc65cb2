"""Time and memory per photograph of a released SAM and CLIP, measured on full-size networks.

    python -m benchmarks.real_size                              # SAM ViT-B and CLIP B/16 on three photographs
    python -m benchmarks.real_size --sam sam2.1-small PHOTOS    # another SAM; your own folder

Random weights take as long as trained ones. Networks are exported once into --models (extra `export`; ViT-B
needs 8 GB for that, ViT-H more). A random SAM predicts no confident mask, so the work on masks outside the
network is excluded (`make bench` measures it), and CLIP embeds masks of the graph segmenter. Each step runs
in its own process, on one core, and prints processor seconds and peak memory.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.memory import status_mib

PHOTOGRAPHS = Path(__file__).resolve().parents[1].parent / "shared/data/plush_bedroom/images"
KEPT = 0.3  # share of the prompts whose masks are decoded after the preview (docs/experiments.md, "Masks")
MAX_SIDE_PX = 800  # maximum image side in the configuration group `photos`

# settings of a SAM's vision encoder that differ from ViT-B
SIZES = {
    "base": {},
    "huge": {
        "hidden_size": 1280,
        "num_hidden_layers": 32,
        "num_attention_heads": 16,
        "global_attn_indexes": [7, 15, 23, 31],
        "mlp_dim": 5120,
    },
}


def export_sam(size: str, out: Path) -> None:
    """Export a SAM with random weights and the signature of the published files."""
    import torch
    import transformers

    from tests.published_models.exports import DECODER, export_sam, slim

    torch.manual_seed(0)
    config = transformers.SamConfig(transformers.SamVisionConfig(**SIZES[size]).to_dict())
    model = transformers.SamModel._from_config(config, attn_implementation="eager").eval()
    # Zero-initialised positions and biases would give denormal numbers in the padding of an image. Arithmetic
    # on denormal numbers takes several times as long.
    with torch.no_grad():
        for parameter in model.parameters():
            if (parameter == parameter.flatten()[0]).all():
                parameter.add_(torch.randn_like(parameter), alpha=0.02)
    export_sam(model, out)
    slim(out / DECODER)
    transformers.SamImageProcessor().save_pretrained(out)


def export_sam2(out: Path) -> None:
    """Export a SAM 2.1 small with random weights and the signature of the published files."""
    import torch

    from tests.published_models.exports import export_sam2, full_sam2

    model = full_sam2()
    with torch.no_grad():
        for parameter in model.parameters():
            if (parameter == parameter.flatten()[0]).all():  # onnxslim would merge equal weights
                parameter.add_(torch.randn_like(parameter), alpha=0.02)
    export_sam2(model, out)


def export_clip(out: Path) -> None:
    """Export a CLIP B/16 with random weights in the layout of the Hugging Face ONNX exports.

    Its tokenizer has only letters, but the token table has full size.
    """
    import torch
    import transformers
    from optimum.exporters.onnx import main_export
    from transformers.models.clip.tokenization_clip import bytes_to_unicode

    from hilsplat.models.onnx_graph import split_clip

    torch.manual_seed(0)
    torch_folder = out / "torch"
    torch_folder.mkdir(parents=True)
    letters = list(bytes_to_unicode().values())
    words = [*letters, *(f"{letter}</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    files = [torch_folder / name for name in ("vocab.json", "merges.txt")]
    files[0].write_text(json.dumps({word: number for number, word in enumerate(words)}))
    files[1].write_text("#version: 0.2\n")
    tokenizer = transformers.CLIPTokenizerFast(*map(str, files), model_max_length=77)
    first, last = len(words) - 2, len(words) - 1
    tokens = {"bos_token_id": first, "eos_token_id": last, "pad_token_id": last}
    text = transformers.CLIPTextConfig(**tokens)
    vision = transformers.CLIPVisionConfig(
        hidden_size=768, intermediate_size=3072, num_hidden_layers=12, num_attention_heads=12, patch_size=16
    )
    model = transformers.CLIPModel(transformers.CLIPConfig(text.to_dict(), vision.to_dict())).eval()
    model.save_pretrained(torch_folder)
    transformers.CLIPProcessor(transformers.CLIPImageProcessor(), tokenizer).save_pretrained(torch_folder)
    main_export(str(torch_folder), output=out, task="feature-extraction", do_validation=False)
    split_clip(out)
    (out / "model.onnx").unlink()


def export(name: str, out: Path) -> None:
    """Export one model."""
    if name == "clip":
        export_clip(out)
    elif name == "sam2.1-small":
        export_sam2(out)
    else:
        export_sam(name, out)


def export_missing(store: Path, sam: str) -> dict[str, Path]:
    """Export missing networks, each in its own process, because exporters do not free gigabytes of memory."""
    places = {"sam": store / f"sam-{sam}", "clip": store / "clip"}
    for kind, name, done in (("sam", sam, "vision_encoder.onnx"), ("clip", "clip", "vision_model.onnx")):
        if not (places[kind] / done).is_file():
            _run(f"export-{name}", places[kind], PHOTOGRAPHS)
    return places


def measure(step: str, models: Path, photograph: Path, points: int) -> dict[str, float]:
    """Measure processor seconds and peak memory of one step on one photograph in this process."""
    from hilsplat.base.images import read_image, resize_to_fit
    from hilsplat.models.layouts import LAYOUTS
    from hilsplat.models.network import Network
    from hilsplat.segment.generate import decode_candidates
    from hilsplat.segment.graph import segment_graph
    from hilsplat.segment.sam import Encoded, SamModel
    from hilsplat.settings import ClipSettings, MasksSettings

    image = resize_to_fit(read_image(photograph), MAX_SIDE_PX)
    figures: dict[str, float] = {}

    def clocked(name: str, work):
        start = time.process_time()
        result = work()
        figures[f"{name}_s"] = time.process_time() - start
        return result

    if step == "clip":
        masks = segment_graph(image, MasksSettings().graph_scales, MasksSettings().min_area_px)
        clip = _picture_half(Network(models / "vision_model.onnx", LAYOUTS["clip"].networks["vision_model"]))
        clocked("clip", lambda: clip.embed_masks(image, masks, ClipSettings()))
        figures["masks"] = len(masks)
    else:
        model, settings = SamModel.load(models), MasksSettings(points_per_side=points)
        encode = model.encode

        def clocked_encode(image: np.ndarray, encoder: Network | None = None) -> Encoded:
            return clocked("encode", lambda: encode(image, encoder))

        model.encode = clocked_encode  # type: ignore[method-assign]
        clocked("view", lambda: decode_candidates(image, model, settings))
    return figures | {"peak_mib": status_mib("VmHWM")}


def compare_decoders(models: Path, photograph: Path, points: int) -> dict[str, float]:
    """Measure processor milliseconds per prompt of the plain and the factored decoder, in alternating rounds.

    The plain network decodes 64 prompts in calls of 8, or of 1 if each prompt needs its own copy of the image
    features. The factored decoder previews and decodes all of them;
    `mean_ms` includes only the share `KEPT` of the decoding. A random SAM predicts no confident mask, so the
    preview rule itself is not run. The masks of both are compared by pixel: `unequal_px` of `mask_px` differ,
    and no absolute logit there exceeds `tie`. Random logits are close to 0; those of a trained SAM are steep.
    """
    from hilsplat.base.images import read_image, resize_to_fit
    from hilsplat.segment.sam import SamModel, in_input, point_grid

    model, rounds, many = SamModel.load(models), 8, 64
    image = resize_to_fit(read_image(photograph), MAX_SIDE_PX)
    encoded = model.encode(image)
    assert model.factored is not None and encoded.terms is not None
    at = in_input(point_grid(points) * (image.shape[1], image.shape[0]), encoded.frame)
    at = at[np.random.default_rng(0).permutation(len(at))[:many]]
    step = model.decoder.prompts_per_call or 8
    times: dict[str, list[float]] = {"plain_ms": [], "preview_ms": [], "masks_ms": []}
    apart = {"iou": 0.0, "logits": 0.0}
    for _ in range(rounds):
        clock = time.process_time()
        plain = [model.decoder(encoded.features, at[k : k + step, None]) for k in range(0, many, step)]
        times["plain_ms"].append(time.process_time() - clock)
        clock = time.process_time()
        calls = [model.factored.decode(encoded.terms, at[k : k + 16], fine=False) for k in range(0, many, 16)]
        times["preview_ms"].append(time.process_time() - clock)
        clock = time.process_time()
        logits = np.concatenate([model.factored.logits(encoded.terms, kept) for _, _, kept in calls])
        times["masks_ms"].append(time.process_time() - clock)
        iou = np.concatenate([call[0] for call in calls])
        plain_logits = np.concatenate([each[1] for each in plain])
        apart["iou"] = float(np.abs(iou - np.concatenate([each[0] for each in plain])).max())
        apart["logits"] = float(np.abs(logits - plain_logits).max())
    unequal = (logits > 0) != (plain_logits > 0)
    apart |= {"mask_px": unequal.size, "unequal_px": int(unequal.sum())}
    apart["tie"] = float(np.abs(plain_logits[unequal]).max(initial=0))
    apart["spread"] = float(plain_logits.std())
    medians = {name: 1e3 * float(np.median(each)) / many for name, each in times.items()}
    mean = medians["preview_ms"] + KEPT * medians["masks_ms"]
    return {**medians, "mean_ms": mean, "ratio": medians["plain_ms"] / mean, **apart}


def _picture_half(network):
    """Return a `ClipModel` with only the image encoder."""
    from hilsplat.embed.clip import ClipModel

    model = object.__new__(ClipModel)
    model.vision, model.side_px = network, 224
    model.mean, model.std = np.zeros(3, np.float32), np.ones(3, np.float32)
    model.rescale = np.float32(1 / 255)
    return model


def main() -> None:
    """Export missing models, then measure every photograph, each step in its own process."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("photographs", type=Path, nargs="?", default=PHOTOGRAPHS)
    parser.add_argument("--sam", choices=[*SIZES, "sam2.1-small"], default="base", help="SAM's encoder")
    parser.add_argument("--views", type=int, default=3, help="number of photographs")
    parser.add_argument("--points", type=int, default=32, help="prompts per image side")
    parser.add_argument("--models", type=Path, default=Path("results/.cache/real-size"))
    parser.add_argument("--step", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.step and given.step.startswith("export-"):
        export(given.step.removeprefix("export-"), given.models)
        return
    if given.step == "decoders":
        print(json.dumps(compare_decoders(given.models, given.photographs, given.points)))
        return
    if given.step:
        print(json.dumps(measure(given.step, given.models, given.photographs, given.points)))
        return
    if not given.photographs.is_dir():
        sys.exit(f"skipped: {given.photographs} does not exist; pass a folder of photographs")
    places = export_missing(given.models, given.sam)
    photographs = sorted(given.photographs.iterdir())[: given.views]
    steps = [(photograph, "sam", "decoders") for photograph in photographs]
    steps += [(photograph, kind, kind) for photograph in photographs for kind in ("sam", "clip")]
    for photograph, kind, step in steps:
        line = json.loads(_run(step, places[kind], photograph, given.points).splitlines()[-1])
        figures = ", ".join(f"{name} {value:.3g}" for name, value in line.items())
        print(f"{photograph.name} {step}: {figures}", flush=True)


def _run(step: str, models: Path, photograph: Path, points: int = 32) -> str:
    """Run one step in its own process, without the model hub, and return its output."""
    command = [sys.executable, "-m", "benchmarks.real_size", "--step", step, "--models", str(models)]
    command += ["--points", str(points)]
    environment = {**os.environ, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    return subprocess.run(
        [*command, str(photograph)], env=environment, stdout=subprocess.PIPE, text=True, check=True
    ).stdout


if __name__ == "__main__":
    main()
