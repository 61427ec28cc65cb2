"""Whether the arrays of an artifact are what its dataclass declares.

Compiled loops check no bounds: an offset out of range crashes the process. So arrays are checked once, when
an artifact is opened, against the annotations of its dataclass (dtype and shape, with sizes of one name
equal), for finite values, and against limits.
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np
from jaxtyping import AbstractArray, jaxtyped

from hilsplat.base.artifacts import read_npz, remake
from hilsplat.base.errors import ArtifactError

Made = TypeVar("Made")
Limits = Mapping[str, tuple[int | float, int | float]]
"""Least and largest value by the name of an array."""


def require_types(maker: type, arrays: Mapping[str, Any], path: Path, limits: Limits) -> None:
    """Check arrays against the fields of a dataclass.

    Args:
        maker: the dataclass, whose arrays are annotated by jaxtyping.
        arrays: by the name of the field.
        path: their file, for the error.
        limits: of the values.

    Raises:
        ArtifactError: an array is of another type or shape, or has a value that is not finite or is out of
            range.
    """
    hints = get_type_hints(maker)
    with jaxtyped("context"):
        for name, array in arrays.items():
            declared: Any = hints.get(name)
            if not (isinstance(declared, type) and issubclass(declared, AbstractArray)):
                continue
            fits: bool = isinstance(array, declared)
            if not fits:
                expected = declared.__name__.replace("ndarray, ", "")
                raise ArtifactError(
                    f"{path}: array {name} cannot be used",
                    expected=expected,
                    found=f"{array.dtype} of shape {array.shape}",
                    fix=remake(path),
                )
            low, high = limits.get(name, (-np.inf, np.inf))
            if array.dtype.kind not in "biuf" or not array.size:
                continue
            least, most = array.min(), array.max()  # NaN if any value is
            if not (low <= least and most <= high and np.isfinite(least) and np.isfinite(most)):
                raise ArtifactError(
                    f"{path}: a value of array {name} cannot be right",
                    expected="finite numbers" if np.isinf(low) and np.isinf(high) else f"{low:g} to {high:g}",
                    found=f"{least} to {most}",
                    fix=remake(path),
                )


def read_into(maker: type[Made], path: Path, limits: Limits | None = None, **more: Any) -> Made:
    """Make a dataclass from the arrays of an .npz.

    Args:
        maker: the dataclass; its fields are the names of the arrays and of `more`.
        path: the file.
        limits: of the values.
        more: fields that are not in the file.

    Raises:
        ArtifactError: the file is missing or damaged, another version of the program wrote it, or an array
            is not what the dataclass declares.
    """
    arrays = read_npz(path)
    expected = _arguments(maker) - set(more)
    if set(arrays) != expected:
        raise ArtifactError(
            f"{path} is of another version",
            expected=", ".join(sorted(expected)),
            found=", ".join(sorted(arrays)) or "no array",
            fix=remake(path),
        )
    require_types(maker, arrays, path, limits or {})
    return maker(**arrays, **more)


def _arguments(maker: type) -> set[str]:
    assert is_dataclass(maker), maker
    return {field.name for field in fields(maker) if field.init}
