"""Measure the data that a browser loads for a scene, and the time to the first view, a drag and a query.

    python -m benchmarks.viewer results/synthetic/table-1 1 5 17      # the scene, and 5 and 17 times as large

In a larger scene, each Gaussian is split into several smaller ones around it, in the same nodes. First,
Chromium renders with WebGL in software (Mesa's llvmpipe); then the server renders.
"""

import argparse
import shutil
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from hilsplat.base.artifacts import read_index, write_index
from hilsplat.base.lineage import sha256_of_file
from hilsplat.base.tables import markdown_table
from hilsplat.splat.gaussians import Gaussians
from hilsplat.splat.ply import load_ply, save_ply
from tests.browser.conftest import ARGUMENTS, serving

ROUNDS = 3
TEXT = "car"
COLUMNS = (
    *("Gaussians", "renderer", "MB sent", "bytes per Gaussian", "first image, s", "all loaded, s"),
    *("drag, s", "answer, s", "heap, MB", "server, MiB"),
)


def enlarged(folder: Path, times: int, out: Path) -> Path:
    """Copy a scene's tree, without names and field, and its Gaussians, each split into `times`."""
    gaussians = load_ply(folder / "gaussians.ply")
    rng = np.random.default_rng(0)
    rows = np.repeat(np.arange(len(gaussians)), times)
    scales = np.exp(gaussians.log_scales[rows])
    split = Gaussians(
        means=(gaussians.means[rows] + rng.normal(0, 0.5, scales.shape) * scales).astype(np.float32),
        log_scales=(gaussians.log_scales[rows] - np.log(times) / 2).astype(np.float32),
        quats=gaussians.quats[rows],
        opacity_logits=gaussians.opacity_logits[rows],
        sh=gaussians.sh[rows],
    )
    save_ply(out / "gaussians.ply", split)
    shutil.copytree(folder / "scene", out / "scene")
    variant = out / "default"
    for part in ("clip", "masks", "semantic_tree"):
        shutil.copytree(folder / "default" / part, variant / part)
    tree = variant / "semantic_tree"
    with np.load(tree / "tree.npz") as held:
        arrays = dict(held)
    arrays["node_of_gaussian"] = arrays["node_of_gaussian"][rows]
    np.savez(tree / "tree.npz", **arrays)
    index = read_index(tree)
    index["gaussians_sha256"] = sha256_of_file(out / "gaussians.ply")
    write_index(tree, index.pop("views"), **index)
    return out


def opened(browser: Any, folder: Path, painter: str) -> dict[str, float]:
    """Open the page of a scene once, drag the view and run a query; return the measurements."""
    with serving(folder) as address:
        server = next(
            child for child in psutil.Process().children() if "hilsplat" in " ".join(child.cmdline())
        )
        page = browser.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(300_000)
        counter = page.context.new_cdp_session(page)
        counter.send("Network.enable")
        sent = []
        counter.on("Network.loadingFinished", lambda event: sent.append(event["encodedDataLength"]))
        begin = time.perf_counter()
        page.goto(f"{address}&painter={painter}")
        page.locator("body[data-ready]").wait_for()
        first = time.perf_counter() - begin
        page.evaluate("hilsplat.begun")
        whole = time.perf_counter() - begin
        drag = timed_redraw(page, lambda: dragged(page))
        page.locator("#text").fill(TEXT)
        answer = timed_redraw(page, lambda: page.keyboard.press("Enter"))
        heap = counter.send("Runtime.getHeapUsage")
        scenes = {
            "sent": sum(sent) / 1e6,
            "first": first,
            "whole": whole,
            "drag": drag,
            "answer": answer,
            "heap": (heap["usedSize"] + heap.get("backingStorageSize", 0)) / 1e6,
            "server": server.memory_info().rss / 2**20,
        }
        page.close()
    return scenes


def dragged(page: Any) -> None:
    """Drag the view by a few pixels."""
    page.mouse.move(800, 300)
    page.mouse.down()
    page.mouse.move(820, 310)
    page.mouse.move(840, 320)
    page.mouse.up()


def timed_redraw(page: Any, act: Any) -> float:
    """Return the seconds until the result of an action is drawn."""
    view = page.locator("#view")
    before, begin = int(view.get_attribute("data-drawn")), time.perf_counter()
    act()
    while int(view.get_attribute("data-drawn")) == before:
        page.wait_for_timeout(10)
    return time.perf_counter() - begin


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path, help="results/<dataset>/<scene> of a finished run")
    parser.add_argument("times", type=int, nargs="*", default=[1, 5, 17])
    given = parser.parse_args()
    from playwright.sync_api import sync_playwright

    rows = []
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        for times in given.times:
            folder = enlarged(given.folder, times, Path(scratch) / f"benchmark/x{times}")
            count = len(load_ply(folder / "gaussians.ply"))
            for painter in ("gl", "server"):
                print(f"{count} Gaussians, {painter}", file=sys.stderr)
                runs = [opened(browser, folder, painter) for _ in range(ROUNDS)]
                median = {key: statistics.median(run[key] for run in runs) for key in runs[0]}
                rows.append(
                    (
                        f"{count:,}",
                        painter,
                        f"{median['sent']:.1f}",
                        f"{1e6 * median['sent'] / count:.1f}",
                        *(f"{median[key]:.1f}" for key in ("first", "whole", "drag", "answer")),
                        f"{median['heap']:.0f}",
                        f"{median['server']:.0f}",
                    )
                )
        browser.close()
    print(markdown_table(COLUMNS, rows, words=2))


if __name__ == "__main__":
    main()
