"""Names for numpy arrays in annotations: the element type; shapes and units stand in the docstrings.

And what becomes of an argument that should be one.
"""

from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from ocnf_data.errors import OcnfError

Bool = npt.NDArray[np.bool_]
F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
I16 = npt.NDArray[np.int16]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]
U32 = npt.NDArray[np.uint32]
U64 = npt.NDArray[np.uint64]

TreeArray = U64
"""Trees, (..., 2): bits 0 to 63 and 64 to 72 of each (see `ocnf_data.octree.bits`)."""
Prefix = I64
"""(T + 1,): the number of leaves before each of T trees, and of all."""


def as_numbers(value: npt.ArrayLike, where: object, field: str,
               dtype: type[np.generic] | None = None) -> npt.NDArray[Any]:
    """What an argument holds as one array, of `dtype` where one is given.

    Raises:
        OcnfError: it holds no real numbers, or not one array of them, such as a list of maps of several
            sizes.
    """
    array = None
    with suppress(TypeError, ValueError, RuntimeError):  # torch: on a GPU, or with gradients
        array = np.asarray(value)
    if array is None or array.dtype.kind not in "fuib":
        found = type(value).__name__ if array is None else f"{array.dtype} {array.shape}"
        if isinstance(value, list | tuple):
            with suppress(TypeError, ValueError):
                found = f"a {found} of shapes " + ", ".join(map(str, dict.fromkeys(map(np.shape, value))))
        raise OcnfError("not one array of numbers", where=where, field=field, found=found,
                        expected="real numbers, all of one shape")
    return array if dtype is None else array.astype(dtype, copy=False)
