"""Compile gsplat's kernels for a machine with a card, on a machine that has nvcc and needs no card.

    make gpu-build                                     # for Python 3.12, torch 2.11.0 and H100 or H200 cards
    make gpu-build TARGET="--torch 2.13.0 --arch 8.6"  # for others; python -m benchmarks.gpu_build --help
    PYTHONPATH=build/gpu python3 -m benchmarks.gpu     # there, in a copy of the project

The folder also has the small packages that `benchmarks.gpu` imports. It expects on the other machine what
images with PyTorch hold: torch, numba, scipy, OpenCV, onnx, onnxruntime, pytest, pandas.
"""

import argparse
import os
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

CARRIED = (
    *("annotated-doc", "annotated-types", "beartype", "hypothesis", "jaxtyping", "platformdirs", "plyfile"),
    *("pydantic", "pydantic-core", "shellingham", "sortedcontainers", "typer", "typing-inspection"),
    "wadler-lindig",
)
"""Packages that are installed beside gsplat, in the versions of this environment."""

MAX_MB = 60

COMPILE = """
import glob, sys, sysconfig
from torch.utils.cpp_extension import load
cuda, out = sys.argv[1:]
sources = [*glob.glob(cuda + "/csrc/*.cu"), *glob.glob(cuda + "/csrc/*.cpp"), cuda + "/ext.cpp"]
# a toolkit may lack the headers of cuBLAS and others, which torch's packages have
headers = glob.glob(sysconfig.get_path("platlib") + "/nvidia/*/include")
load(
    "csrc", sources, ["-O3", "-Wno-attributes"], ["-O3", "-use_fast_math"], build_directory=out, verbose=True,
    extra_include_paths=[cuda + "/include/", cuda + "/csrc/third_party/glm", *headers],
)
"""  # flags as in gsplat/cuda/_backend.py, which imports gsplat.csrc if it is there

CHECK = "from gsplat import csrc, rasterization; print(len(dir(csrc)), 'names in', csrc.__file__)"


def built(out: Path, python: str, torch: str, arch: str) -> None:
    """Write the folder `out`, and check that its kernels load and that it is small."""
    work = out.with_name(out.name + "-work")
    environment, objects = work / "venv", work / "objects"
    pip = [str(environment / "bin/python"), "-m", "pip", "install", "--quiet"]
    if not (environment / "bin/python").exists():
        subprocess.run([python, "-m", "venv", str(environment)], check=True)
    subprocess.run([*pip, f"torch=={torch}", "numpy", "ninja", "setuptools", "rich", "packaging"], check=True)
    objects.mkdir(exist_ok=True)
    shutil.rmtree(out, ignore_errors=True)
    packages = [f"{name}=={version(name)}" for name in ("gsplat", *CARRIED)]
    subprocess.run([*pip, "--no-deps", "--no-compile", "--target", str(out), *packages], check=True)
    cuda = out / "gsplat/cuda"
    settings = {"TORCH_CUDA_ARCH_LIST": arch, "MAX_JOBS": str(os.cpu_count() or 1)}
    path = f"{environment / 'bin'}{os.pathsep}{os.environ['PATH']}"  # ninja is there
    command = [str(environment / "bin/python"), "-c", COMPILE, str(cuda), str(objects)]
    subprocess.run(command, check=True, env={**os.environ, **settings, "PATH": path})
    shutil.copy(objects / "csrc.so", out / "gsplat/csrc.so")
    for sources in (cuda / "csrc", cuda / "include"):
        shutil.rmtree(sources)
    checked = {**os.environ, "PYTHONPATH": str(out)}
    subprocess.run([str(environment / "bin/python"), "-c", CHECK], check=True, env=checked)
    size_mb = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / 1e6
    print(f"{out}: {size_mb:.0f} MB, for {python}, torch {torch} and compute capability {arch}")
    if size_mb > MAX_MB:
        sys.exit(f"{out} has more than {MAX_MB} MB")


def main() -> None:
    """Build the folder for the machine that the arguments describe."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "build/gpu")
    parser.add_argument("--python", default="python3.12", help="Python of the other machine's version")
    parser.add_argument("--torch", default="2.11.0", help="the other machine's torch, a build with CUDA")
    parser.add_argument("--arch", default="9.0", help="compute capabilities of its cards, such as 8.0;9.0")
    given = parser.parse_args()
    os.environ.setdefault("CUDA_HOME", "/usr/local/cuda")
    if not (Path(os.environ["CUDA_HOME"]) / "bin/nvcc").exists():
        sys.exit("nvcc is missing: install the toolkit of torch's CUDA version, and set CUDA_HOME")
    if not shutil.which(given.python):
        sys.exit(f"{given.python} is missing: install that version of Python, with its headers")
    built(given.out, given.python, given.torch, given.arch)


if __name__ == "__main__":
    main()
