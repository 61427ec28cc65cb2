"""`hilsplat models get` in its own process, killed at five places of a transfer."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import onnx

from hilsplat.base.lineage import sha256_of_file
from tests.conftest import PROJECT
from tests.unit.hub.conftest import SAM

MIB, NAME = 2**20, Path("onnx/vision_encoder.onnx")
PLACES = [
    ("/api/models/", 10),  # within the listing
    ("config.json", 0),  # before the first file
    ("/lfs/some/large/resolve/", 12 * MIB),  # within the encoder
    ("/lfs/some/large/resolve/", 12 * MIB),  # within its second part
    ("prompt_encoder_mask_decoder.onnx", 200),  # within another file
]


def test_a_killed_download_resumes_and_ends_with_the_right_digests(hub, repositories, tmp_path):
    large = shutil.copytree(repositories[SAM], tmp_path / "large")
    encoder = onnx.load(large / NAME)
    encoder.doc_string = "padding" * (5 * MIB)
    onnx.save(encoder, large / NAME)
    hub.repositories["some/large"] = large
    environment = {
        **os.environ,
        "HF_ENDPOINT": hub.endpoint,
        "HILSPLAT_MODELS": str(tmp_path / "models"),
        "HF_HOME": str(tmp_path / "cache"),
        "PYTHONPATH": str(PROJECT),
    }
    environment.pop("HF_HUB_OFFLINE", None)
    words = [sys.executable, "-m", "hilsplat", "models", "get", "some/large"]
    for place, num_bytes in PLACES:
        hub.held = {place: num_bytes}
        hub.reached.clear()
        hub.released.clear()
        with subprocess.Popen(words, env=environment, stderr=subprocess.DEVNULL) as process:
            assert hub.reached.wait(60), place
            process.send_signal(signal.SIGKILL)
        hub.released.set()
        assert not (tmp_path / "models/large").exists()
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert sha256_of_file(tmp_path / "models/large" / NAME) == sha256_of_file(large / NAME)
    starts = [int(each.strip("bytes=-")) for each in hub.ranges(NAME.name) if each]
    assert len(starts) == 2 and 0 < starts[0] <= starts[1], "a transfer did not resume"
    assert [path.name for path in (tmp_path / "models").glob("[!.]*")] == ["large"]
