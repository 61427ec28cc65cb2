"""Open, check and run a network of a model folder."""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from hilsplat.base.errors import ModelError, first_line
from hilsplat.models.layouts import Axes, NetworkSpec
from hilsplat.models.onnx_graph import Graph, has_external_weights, refuse_pointer

try:
    import onnxruntime
    from onnxruntime import InferenceSession, SessionOptions
except ImportError as error:
    raise ModelError(
        f"onnxruntime cannot be imported, or is incomplete: {first_line(error)}",
        fix="pip uninstall onnxruntime-gpu, then pip install --force-reinstall onnxruntime",
    ) from error

logger = logging.getLogger(__name__)

Fast = TypeVar("Fast")

Array = Any  # a NumPy array, or on a card a torch tensor, which only code for cards imports
EXPORT_AGAIN = "export the model in the layout of the Hugging Face ONNX exports"
DTYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
    "tensor(int32)": np.int32,
}
CPU = "CPUExecutionProvider"


def one_thread_session(network: Graph | Path) -> InferenceSession:
    """Open a network that runs on the CPU, in one thread; a `Graph`'s weights must outlive the session.

    Stages are faster if they process several views at once; results don't depend on the number of threads.
    """
    options = SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    if isinstance(network, Path):
        return InferenceSession(str(network), options, providers=[CPU])
    values = [onnxruntime.OrtValue.ortvalue_from_numpy(value) for value in network.weights.values()]
    options.add_external_initializers(list(network.weights), values)
    return InferenceSession(network.serialized(), options, providers=[CPU])


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


@dataclass(frozen=True)
class Declared:
    """Type and axes of an input or output, as onnxruntime names them; a free axis is a text or None."""

    type: str
    shape: Sequence[Any]


class Network:
    """An ONNX network with checked names; inputs are cast to its types, and outputs are float32.

    It runs in onnxruntime on the CPU. Each call runs in one thread (`one_thread_session`), and several
    threads may call a network.

    Args:
        changed: a changed network, or its file, to use instead of `path`.

    Attributes:
        runs_on: library and device, part of cache keys.
        version: version of the library.

    Raises:
        ModelError: the network cannot be read, or its inputs or outputs have unexpected names or axes.
    """

    runs_on: Sequence[str] = (CPU,)
    version = onnxruntime.__version__
    inputs: Mapping[str, Any]  # with the attributes of `Declared`
    outputs: Mapping[str, Any]

    def __init__(self, path: Path, spec: NetworkSpec, changed: Graph | Path | None = None) -> None:
        self.path = path
        refuse_pointer(path)
        try:
            source = changed or path
            if isinstance(source, Path) and has_external_weights(source):
                source = Graph.read(source)  # onnxruntime alone refuses some links to weights
            self._open(source)
        except ModelError:
            raise
        except Exception as error:  # onnxruntime's errors share no public base class
            raise ModelError(
                f"network {path} cannot be opened: {error}",
                found=f"a file of {path.stat().st_size} bytes",
                fix="export it again, or fetch a complete copy (with its weights file, if it has one)",
            ) from error
        renamed = {
            old: new for old, new in spec.synonyms.items() if {old, new} & self.outputs.keys() == {new}
        }
        outputs = {renamed.get(name, name): axes for name, axes in spec.outputs.items()}
        self.spec = spec = replace(spec, outputs=outputs)
        self._check("inputs", spec.inputs, self.inputs, spec.optional)
        self._check("outputs", spec.outputs, self.outputs, tuple(self.outputs))

    def _open(self, source: Graph | Path) -> None:
        """Open the network, and set `inputs` and `outputs`."""
        self._weights = source.weights if isinstance(source, Graph) else {}  # the session reads them
        self.session = one_thread_session(source)
        self.inputs = {item.name: item for item in self.session.get_inputs()}
        self.outputs = {item.name: item for item in self.session.get_outputs()}

    def _check(
        self, what: str, expected: Mapping[str, Axes], found: Mapping[str, Any], optional: tuple[str, ...]
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
            raise self._failed(error, cast) from error
        return [output.astype(np.float32, copy=False) for output in self._with_right_axes(outputs)]

    def run(self, **feeds: Any) -> list[Any]:
        """Run the network as `__call__` does, but leave the outputs where the network runs."""
        return self(**feeds)

    def in_half(self) -> "Network":
        """Return this network with products in float16; only for networks on a card (`TorchNetwork`)."""
        raise NotImplementedError

    def _failed(self, error: Exception, feeds: Mapping[str, Any]) -> ModelError:
        return ModelError(
            f"network {self.path} failed: {error}",
            found=", ".join(f"{name} {tuple(value.shape)}" for name, value in feeds.items()),
            fix="check that preprocessor_config.json belongs to this network; on a GPU, also try device: cpu",
        )

    def _with_right_axes(self, outputs: list[Any]) -> list[Any]:
        """Return the outputs; raise a ModelError if their axes are not those of the spec."""
        for (name, axes), output in zip(self.spec.outputs.items(), outputs, strict=True):
            if not _fits(output.shape, axes):
                problem = f"network {self.path} returned {name} of shape {tuple(output.shape)}"
                raise ModelError(problem, expected=_described(name, axes), fix=EXPORT_AGAIN)
        return outputs


def on_host(values: Array) -> np.ndarray:
    """Return the values as a NumPy array."""
    return values if isinstance(values, np.ndarray) else np.asarray(values.cpu())


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
