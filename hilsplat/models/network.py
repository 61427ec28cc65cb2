"""Open, check and run a network of a model folder."""

import contextlib
import ctypes
import io
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import onnxruntime

from hilsplat.base.errors import ModelError, first_line
from hilsplat.models.layouts import Axes, NetworkSpec
from hilsplat.models.onnx_graph import Graph, has_external_weights, refuse_pointer

logger = logging.getLogger(__name__)

Fast = TypeVar("Fast")

EXPORT_AGAIN = "export the model in the layout of the Hugging Face ONNX exports"
DTYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
}
CPU, CUDA = "CPUExecutionProvider", "CUDAExecutionProvider"
SILENT, WARNINGS = 4, 2  # severities of onnxruntime's log
OVERWRITTEN = (
    "onnxruntime-gpu was overwritten by onnxruntime; run pip uninstall onnxruntime onnxruntime-gpu, then "
    "pip install onnxruntime-gpu"
)

if not hasattr(onnxruntime, "InferenceSession"):
    raise ModelError(
        "onnxruntime is incomplete; uninstalling onnxruntime-gpu removes its files, and the reverse",
        fix="pip install --force-reinstall onnxruntime (or onnxruntime-gpu)",
    )


def execution_providers() -> tuple[str, ...]:
    """Return the onnxruntime execution providers that work, in order of preference: CUDA, then CPU."""
    return (CPU,) if cuda_provider_problem() else (CUDA, CPU)


@cache
def cuda_provider_problem() -> str | None:
    """Return why onnxruntime cannot use CUDA here, or None if a session runs on it.

    The list of available providers contains what onnxruntime was built with. Without a driver, CUDA or cuDNN,
    sessions run on the CPU. If onnxruntime was built with CUDA, the problem is logged as a warning.
    """
    if CUDA not in onnxruntime.get_available_providers():
        if any(metadata.distributions(name="onnxruntime-gpu")):
            logger.warning("onnxruntime runs on the CPU: %s", OVERWRITTEN)
            return OVERWRITTEN
        return "onnxruntime is built without CUDA"
    text = (
        """<ir_version: 8, opset_import: ["" : 17]> same (float[1] x) => (float[1] y) { y = Identity (x) }"""
    )
    try:
        from onnx.parser import parse_model

        onnxruntime.set_default_logger_severity(SILENT)  # the problem is reported below
        with contextlib.redirect_stdout(io.StringIO()):
            onnxruntime.preload_dlls()  # CUDA and cuDNN as installed with torch
        session = one_thread_session(Graph(parse_model(text), {}), (CUDA, CPU))
        session.run(None, {"x": np.zeros(1, np.float32)})
        problem = None if session.get_providers()[0] == CUDA else _missing_library()
    except Exception as error:  # onnxruntime's errors share no public base class
        problem = first_line(error)
    finally:
        onnxruntime.set_default_logger_severity(WARNINGS)
    if problem:
        logger.warning("onnxruntime runs on the CPU, because CUDA cannot be used: %s", problem)
    return problem


def _missing_library() -> str:
    """Return why the library of onnxruntime's CUDA provider cannot be loaded."""
    library = Path(onnxruntime.__file__).parent / "capi/libonnxruntime_providers_cuda.so"
    try:
        ctypes.CDLL(str(library))
    except OSError as error:
        return first_line(error)
    return "its session fell back to the CPU"


def one_thread_session(network: Graph | Path, providers: Sequence[str]) -> onnxruntime.InferenceSession:
    """Open a network that runs in one thread per call; the weights of a `Graph` must outlive the session.

    Stages are faster if they process several views at once; results don't depend on the number of threads.
    """
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    if isinstance(network, Path):
        return onnxruntime.InferenceSession(str(network), options, providers=list(providers))
    values = [onnxruntime.OrtValue.ortvalue_from_numpy(value) for value in network.weights.values()]
    options.add_external_initializers(list(network.weights), values)
    return onnxruntime.InferenceSession(network.serialized(), options, providers=list(providers))


def or_as_exported(network: Path, cost: str, prepare: Callable[[], Fast]) -> Fast | None:
    """Return a faster form of a network, or log a warning and return None if `prepare` raises any exception.

    Args:
        network: file of the network.
        cost: what running the network as exported costs, such as "each image takes twice as long".
    """
    try:
        return prepare()
    except Exception as error:  # exporters write many forms of graphs, and each of them can run as exported
        logger.warning("%s runs as exported, and %s: %s", network, cost, first_line(error))
        return None


class Network:
    """An ONNX network with checked names; inputs are cast to its types, and outputs are float32.

    Each call runs in one thread (`one_thread_session`), and several threads may call a network.

    Args:
        changed: a changed network, or its file, to use instead of `path`.
        provider: the only execution provider to use, or None for the first that works.

    Raises:
        ModelError: the network cannot be read, or its inputs or outputs have unexpected names or axes.
    """

    def __init__(
        self,
        path: Path,
        spec: NetworkSpec,
        changed: Graph | Path | None = None,
        provider: str | None = None,
    ) -> None:
        self.path = path
        refuse_pointer(path)
        try:
            source = changed or path
            if isinstance(source, Path) and has_external_weights(source):
                source = Graph.read(source)  # onnxruntime alone refuses some links to weights
            self._weights = source.weights if isinstance(source, Graph) else {}  # the session reads them
            self.session = one_thread_session(source, [provider] if provider else execution_providers())
        except ModelError:
            raise
        except Exception as error:  # onnxruntime's errors share no public base class
            raise ModelError(
                f"network {path} cannot be opened: {error}",
                found=f"a file of {path.stat().st_size} bytes",
                fix="export it again, or fetch a complete copy (with its weights file, if it has one)",
            ) from error
        self.inputs = {item.name: item for item in self.session.get_inputs()}
        self.outputs = {item.name: item for item in self.session.get_outputs()}
        renamed = {
            old: new for old, new in spec.synonyms.items() if {old, new} & self.outputs.keys() == {new}
        }
        outputs = {renamed.get(name, name): axes for name, axes in spec.outputs.items()}
        self.spec = spec = replace(spec, outputs=outputs)
        self._check("inputs", spec.inputs, self.inputs, spec.optional)
        self._check("outputs", spec.outputs, self.outputs, tuple(self.outputs))
        self.providers = self.session.get_providers()
        logger.debug("network %s runs on %s", path.name, self.providers[0])

    def _check(
        self, what: str, expected: Mapping[str, Axes], found: dict[str, Any], optional: tuple[str, ...]
    ) -> None:
        refused = [name for name in expected if name not in found]
        refused += [name for name in found if name not in expected and name not in optional]
        for name, item in found.items():
            is_typed = item.type in DTYPES
            if name in expected and not (is_typed and (not item.shape or _fits(item.shape, expected[name]))):
                refused.append(name)
        if refused:
            raise ModelError(
                f"network {self.path} has unexpected or missing {what}: {', '.join(refused)}",
                expected=", ".join(_described(name, axes) for name, axes in expected.items()),
                found=", ".join(f"{name} {list(item.shape)} {item.type}" for name, item in found.items()),
                fix=EXPORT_AGAIN,
            )

    def fixed_axis(self, name: str, axis: int) -> int | None:
        """Return the length of an axis of an input or output, or None if the network does not fix it."""
        shape = {**self.outputs, **self.inputs}[name].shape
        return shape[axis] if shape and isinstance(shape[axis], int) else None

    def __call__(self, **feeds: np.ndarray) -> list[np.ndarray]:
        """Run the network once, and return the outputs in the order of the spec.

        A ModelError is raised if the network rejects the inputs, or an output has an unexpected shape.
        """
        cast = {
            name: np.asarray(value, DTYPES[self.inputs[name].type])
            for name, value in feeds.items()
            if name in self.inputs
        }
        try:
            outputs = self.session.run(list(self.spec.outputs), cast)
        except Exception as error:  # onnxruntime's errors share no public base class
            raise ModelError(
                f"network {self.path} failed: {error}",
                found=", ".join(f"{name} {value.shape}" for name, value in cast.items()),
                fix="check that preprocessor_config.json belongs to this network",
            ) from error
        for (name, axes), output in zip(self.spec.outputs.items(), outputs, strict=True):
            if not _fits(output.shape, axes):
                problem = f"network {self.path} returned {name} of shape {output.shape}"
                raise ModelError(problem, expected=_described(name, axes), fix=EXPORT_AGAIN)
        return [output.astype(np.float32, copy=False) for output in outputs]


def _fits(shape: Sequence[Any], axes: Axes) -> bool:
    """Return whether a shape, which may contain names, is compatible with these axes."""
    return len(shape) == len(axes) and all(
        axis is None or not isinstance(length, int) or axis == length
        for length, axis in zip(shape, axes, strict=True)
    )


def _described(name: str, axes: Axes) -> str:
    return f"{name} ({', '.join(str(axis or 'any') for axis in axes)})"


def require_one_space(folder: Path, image_numbers: int | None, text_numbers: int | None) -> None:
    """Raise a ModelError if the two networks of a CLIP model return vectors of known, different widths."""
    if None not in (image_numbers, text_numbers) and image_numbers != text_numbers:
        raise ModelError(
            f"the two networks of {folder} do not belong together",
            expected=f"text vectors with {image_numbers} dimensions, like the image vectors",
            found=f"{text_numbers} dimensions",
            fix="export both networks, with their projections, from one model",
        )
