"""The package imports where modules of Linux and macOS do not exist."""

import subprocess
import sys

from tests.conftest import PROJECT

PROGRAM = """
import ctypes, importlib, os, pkgutil, sys

class Windows(ctypes.CDLL):
    def __init__(self, name, *given, **named):
        if name is None:
            raise TypeError("LoadLibrary() argument 1 must be str, not None")
        super().__init__(name, *given, **named)

for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None
import {libraries}
ctypes.CDLL = Windows
sys.platform = "win32"
for name in ("sched_getaffinity", "sysconf", "getuid", "geteuid", "fork", "killpg", "getpgid"):
    if hasattr(os, name):
        delattr(os, name)
import hilsplat
for module in pkgutil.walk_packages(hilsplat.__path__, "hilsplat."):
    if module.name != "hilsplat.__main__":
        importlib.import_module(module.name)
from hilsplat.base.errors import HilsplatError, system_error
from hilsplat.base.processes import lock
assert system_error(MemoryError("x")) is not None
try:
    lock(open(os.devnull, "a"))
except HilsplatError as error:
    assert "WSL" in str(error)
else:
    raise AssertionError("locked")
print("imported", len(sys.modules))
"""
LIBRARIES = (
    "av, cv2, embreex.rtcore_scene, filelock, huggingface_hub.utils, matplotlib.pyplot, numba, onnxruntime, "
    "pandas, pillow_heif, pyarrow.parquet, pycolmap, safetensors, scipy.sparse, starlette, torch, typer, "
    "uvicorn"
)
"""Libraries, which have their own code for Windows, are imported before Windows is simulated."""


def test_every_module_imports_without_fcntl_resource_and_other_functions_of_unix():
    program = PROGRAM.replace("{libraries}", LIBRARIES)
    done = subprocess.run([sys.executable, "-c", program], cwd=PROJECT, capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith("imported"), done.stderr[-3000:]
