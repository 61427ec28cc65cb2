"""Export of PyTorch weights to ONNX networks with optimum, in a separate process (the extra `export`)."""

import importlib.util
import logging
import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

from hilsplat.base.errors import ModelError
from hilsplat.models.onnx_graph import split_whole, whole_clip

logger = logging.getLogger(__name__)

NEEDED = ("optimum.exporters.onnx", "transformers", "PIL", "torch")
"""Modules that an export requires. Without Pillow, optimum silently writes no preprocessor_config.json."""
INSTALL = "pip install --constraint constraints.txt --editable '.[export]'"

LAST_LINES = 15  # of the exporter's output, shown in an error


def require_exporter(what: str) -> None:
    """Refuse to continue without the exporter's packages, before anything is downloaded."""
    if missing := [name for name in NEEDED if not _is_installed(name)]:
        raise ModelError(
            f"{what} has no ONNX networks, and the packages that export them are not installed",
            expected="the extra export: optimum-onnx, transformers, torch, pillow",
            found=f"no {', '.join(missing)}",
            fix=f"{INSTALL}, then run the command again",
        )


def _is_installed(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # the parent package is missing
        return False


def export_networks(weights: Path, out: Path) -> dict[str, str]:
    """Export the networks of a SAM or CLIP saved by transformers; return the exporter's package versions.

    If the exporter fails, its last lines are in the error.
    """
    logger.info("exporting to ONNX; this takes a few minutes and about three times the weights in memory")
    words = ("export", "onnx", "--model", str(weights), "--task", "feature-extraction", str(out))
    done = subprocess.run(
        [sys.executable, "-m", "optimum.commands.optimum_cli", *words],
        env={**os.environ, "HF_HUB_OFFLINE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        lines = (done.stdout + done.stderr).strip().splitlines()[-LAST_LINES:]
        raise ModelError(
            f"the weights in {weights} cannot be exported: the exporter ended with {done.returncode}",
            found="\n            ".join(lines) or "no output",
            fix=f"install the tested versions ({INSTALL}), then run the command again",
        )
    if whole_clip(out) is not None:
        split_whole(out)
    return {name: metadata.version(name) for name in ("optimum-onnx", "transformers", "torch")}
