"""Networks in onnxruntime."""

import os
import subprocess
import sys

import pytest

from tests.conftest import PROJECT


@pytest.mark.parametrize("content", ["", "raise ImportError('libonnxruntime.so.1: cannot open')"])
def test_an_onnxruntime_that_lost_its_files_is_named(tmp_path, content):
    (tmp_path / "onnxruntime").mkdir()
    (tmp_path / "onnxruntime/__init__.py").write_text(content)
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{PROJECT}"}
    words = [sys.executable, "-c", "import hilsplat.models.network"]
    done = subprocess.run(words, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert "ModelError: onnxruntime cannot be imported" in done.stderr
    assert "--force-reinstall onnxruntime" in done.stderr
