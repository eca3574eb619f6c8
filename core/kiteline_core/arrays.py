"""Arrays by the type of their elements, for annotations; shapes are told in docstrings."""

from typing import Any

import numpy as np

# Not NDArray: what it is differs between versions of numpy, and the store reads annotations to read its values back.
F64 = np.ndarray[tuple[Any, ...], np.dtype[np.float64]]
F32 = np.ndarray[tuple[Any, ...], np.dtype[np.float32]]
I64 = np.ndarray[tuple[Any, ...], np.dtype[np.int64]]
I32 = np.ndarray[tuple[Any, ...], np.dtype[np.int32]]
I16 = np.ndarray[tuple[Any, ...], np.dtype[np.int16]]
I8 = np.ndarray[tuple[Any, ...], np.dtype[np.int8]]
U64 = np.ndarray[tuple[Any, ...], np.dtype[np.uint64]]
U16 = np.ndarray[tuple[Any, ...], np.dtype[np.uint16]]
U8 = np.ndarray[tuple[Any, ...], np.dtype[np.uint8]]
Bool = np.ndarray[tuple[Any, ...], np.dtype[np.bool_]]
