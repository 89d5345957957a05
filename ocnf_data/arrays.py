"""Names for numpy arrays in annotations: the element type; shapes and units stand in the docstrings."""

import numpy as np
import numpy.typing as npt

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
