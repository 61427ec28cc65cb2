"""Digests of model folders, cached by the sizes and modification times of their files."""

import functools
import json
from pathlib import Path

from hilsplat.base.artifacts import parse_json, sha256_of_path, write_json


@functools.cache
def model_digest(folder: Path, cache: Path) -> str:
    """Return the digest of a model folder, cached because reading ViT-H takes seconds.

    Args:
        folder: model folder. If it is missing, the result is a text that says so; the stage reports the fix.
        cache: folder of the file with cached digests.
    """
    if not folder.is_dir():
        return f"{folder} is missing"
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    stamp = json.dumps([[str(file), file.stat().st_size, file.stat().st_mtime_ns] for file in files])
    memo = cache / "digests.json"
    try:
        known = parse_json(memo.read_text())
    except (OSError, ValueError):
        known = {}
    if stamp not in known:
        known[stamp] = sha256_of_path(folder)
        write_json(memo, known)
    return known[stamp]
