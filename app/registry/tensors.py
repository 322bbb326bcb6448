"""Reading and writing tensors: a safetensors file with float32 or float16 weights, and tables."""

from collections.abc import Mapping
from typing import Any, Final, Literal, TypeVar, get_type_hints

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError, deserialize
from safetensors.numpy import save

from app.model.fields import TensorGroup
from app.model.statistics import ROOM
from app.registry.errors import ArtifactError
from app.registry.manifest import WEIGHTS, TensorEntry

GroupT = TypeVar("GroupT", bound=TensorGroup)

StorageDtype = Literal["float16", "float32"]

MAX_HEADER_BYTES: Final = 2**20
"""Maximum size in bytes of the header of the weights file. It can list about 10,000 tensors."""

_DTYPES: Final = {
    "F16": "float16", "F32": "float32", "I32": "int32", "I64": "int64", "BOOL": "bool"
}  # fmt: skip


def pack(
    state: Mapping[str, ArrayLike], storage_dtype: StorageDtype
) -> tuple[bytes, dict[str, TensorEntry]]:
    """Return the contents of a safetensors file, and the manifest entries of its tensors.

    Floating-point arrays with two or more axes get the ``storage_dtype``, others float32. Integers
    and booleans keep their dtype. float16 has a relative error of at most 2^-11 per weight.

    Raises:
        ArtifactError: `not_finite` for NaN, infinity or a weight above the float16 maximum of
            65,504; `invalid_tensor` for a dtype that artifacts do not support.
    """
    arrays = {name: _stored(name, value, storage_dtype) for name, value in sorted(state.items())}
    entries = {
        name: TensorEntry.model_validate({"dtype": array.dtype.name, "shape": array.shape})
        for name, array in arrays.items()
    }
    return save(arrays), entries


def unpack(data: bytes, entries: Mapping[str, TensorEntry]) -> dict[str, NDArray[Any]]:
    """Return writable copies of the tensors of a safetensors file, with floats as float32.

    Raises:
        ArtifactError: `not_safetensors` for another file format; `too_large` for a header with more
            than `MAX_HEADER_BYTES`; `wrong_shape` if names, dtypes or shapes differ from the
            manifest; `not_finite` for NaN or infinity.
    """
    # The file begins with the length of its header: 64 bits, little-endian.
    if MAX_HEADER_BYTES < int.from_bytes(data[:8], "little") <= len(data):
        reason = f"the header of {WEIGHTS} has more than the maximum of {MAX_HEADER_BYTES} bytes"
        raise ArtifactError("too_large", reason)
    try:
        stored = dict(deserialize(data))  # type: ignore[no-untyped-call]
    except SafetensorError:
        raise ArtifactError("not_safetensors", f"{WEIGHTS} is not a safetensors file") from None
    actual = {name: (_DTYPES.get(e["dtype"]), tuple(e["shape"])) for name, e in stored.items()}
    expected = {name: (entry.dtype, entry.shape) for name, entry in entries.items()}
    require_equal(actual, expected, f"{WEIGHTS} has", "but the manifest has")
    return {
        name: _loaded(name, entry["data"], entries[name]) for name, entry in sorted(stored.items())
    }


def require_equal(
    actual: Mapping[str, object], expected: Mapping[str, object], has: str, needs: str
) -> None:
    """Raise ArtifactError `wrong_shape` unless both maps to dtype and shape are equal."""
    for name in sorted(actual.keys() | expected.keys()):
        entry, needed = actual.get(name, "none"), expected.get(name, "none")
        if entry != needed:
            raise ArtifactError("wrong_shape", f"tensor '{name}': {has} {entry}, {needs} {needed}")


def read_group(
    group: type[GroupT], tensors: Mapping[str, NDArray[Any]], A: int, V: int, C: int
) -> GroupT | None:
    """Return the tables of a model with A relations, V classes and C room types, or None.

    Raises:
        ArtifactError: `wrong_shape` if a tensor is missing, unexpected or of a wrong shape;
            `invalid_tensor` if a tensor has a wrong dtype or an impossible value.
    """
    if not tensors:
        return None
    # The first field with another size defines this size.
    sizes, shapes = {"A": A, "V": V, "features": ROOM + C + V}, {}
    for name, hint in get_type_hints(group, include_extras=True).items():
        if axes := getattr(hint, "__metadata__", ()):
            actual = np.shape(tensors.get(group.tensor(name), ()))
            sizes = dict(zip(axes, actual, strict=False)) | sizes
            shapes[name] = tuple(
                sizes.get(axis, 0) if isinstance(axis, str) else axis for axis in axes
            )
    required = {group.tensor(name): shape for name, shape in shapes.items()}
    for name in sorted(tensors.keys() | required):
        shape, expected = tensors[name].shape if name in tensors else None, required.get(name)
        if shape != expected:
            reason = f"tensor '{name}' has the shape {shape}, not {expected} (None: no tensor)"
            raise ArtifactError("wrong_shape", reason)
    tables = group(**{name: tensors[group.tensor(name)] for name in shapes})
    try:
        for name in shapes:
            kind = np.integer if name in group.integers else np.floating
            is_right = np.issubdtype(getattr(tables, name).dtype, kind)
            tables.require(is_right, f"{name} must have a dtype of {kind.__name__}")
        tables.check(A, V, C)
    except ValueError as error:
        raise ArtifactError("invalid_tensor", str(error)) from None
    return tables


def _stored(name: str, value: ArrayLike, storage_dtype: StorageDtype) -> NDArray[Any]:
    """Return an array for the file. Floats get the storage dtype, but vectors get float32."""
    # ascontiguousarray() turns shape () into (1,). reshape() restores it.
    array = np.ascontiguousarray(value).reshape(np.shape(value))
    if np.issubdtype(array.dtype, np.floating):
        with np.errstate(over="ignore"):
            array = array.astype(storage_dtype if array.ndim > 1 else np.float32)
        _require_finite(name, array, f" in {array.dtype.name}")
    elif array.dtype.name not in _DTYPES.values():
        reason = f"tensor '{name}' has the unsupported dtype {array.dtype.name}"
        raise ArtifactError("invalid_tensor", reason)
    return array


def _loaded(name: str, data: bytes, entry: TensorEntry) -> NDArray[Any]:
    """Return a tensor of the file as a writable array. Floats become float32."""
    array = np.frombuffer(data, dtype=entry.dtype).reshape(entry.shape)
    if not entry.dtype.startswith("float"):
        return array.copy()
    array = array.astype(np.float32)
    _require_finite(name, array, "")
    return array


def _require_finite(name: str, array: NDArray[Any], where: str) -> None:
    if not np.isfinite(array).all():
        raise ArtifactError("not_finite", f"tensor '{name}' contains NaN or infinity{where}")
