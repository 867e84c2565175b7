"""XLA's foreign function interface, as far as kernels use it: frames of calls, with the arrays that they point to."""

import ctypes
import functools
import math
import re
from pathlib import Path

import numpy as np

from crazysim import jaxcompat

DTYPES = {1: "bool", 4: "int32", 8: "uint32", 11: "float32", 12: "float64"}
"""Types of numbers that kernels have: values of ``XLA_FFI_DataType``."""


@functools.cache
def version():
    """Return the version of the interface, major and minor."""
    text = (Path(jaxcompat.ffi_include_folder()) / "xla/ffi/api/c_api.h").read_text()
    return [int(re.search(rf"#define XLA_FFI_API_{part} (\d+)", text)[1]) for part in ("MAJOR", "MINOR")]


class Struct(ctypes.Structure):
    """What structures begin with."""

    _fields_ = (("struct_size", ctypes.c_size_t), ("extension_start", ctypes.c_void_p))


class Buffer(Struct):
    """``XLA_FFI_Buffer``."""

    _fields_ = (
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    )

    def array(self):
        """Return the array, in its place."""
        dtype, shape = np.dtype(DTYPES[self.dtype]), self.dims[: self.rank]
        size = math.prod(shape) * dtype.itemsize
        if not size:
            return np.empty(shape, dtype)
        return np.frombuffer((ctypes.c_char * size).from_address(self.data), dtype).reshape(shape)


class Buffers(Struct):
    """``XLA_FFI_Args`` and ``XLA_FFI_Rets``."""

    _fields_ = (
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("buffers", ctypes.POINTER(ctypes.POINTER(Buffer))),
    )

    def arrays(self):
        """Return the arrays."""
        return [self.buffers[k].contents.array() for k in range(self.size)]


class Frame(Struct):
    """``XLA_FFI_CallFrame`` up to the results."""

    _fields_ = (
        ("api", ctypes.c_void_p),
        ("ctx", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("args", Buffers),
        ("rets", Buffers),
    )


def frame(given, out):
    """Return the frame of a call with arrays; of them, a kernel reads addresses alone."""

    def buffers(arrays):
        one = [ctypes.pointer(Buffer(data=x.ctypes.data)) for x in arrays]
        return Buffers(size=len(one), buffers=(ctypes.POINTER(Buffer) * len(one))(*one))

    return Frame(args=buffers(given), rets=buffers(out))


class Version(Struct):
    """``XLA_FFI_Api_Version``."""

    _fields_ = (("major", ctypes.c_int), ("minor", ctypes.c_int))


class Metadata(ctypes.Structure):
    """``XLA_FFI_Metadata`` up to the version."""

    _fields_ = (("struct_size", ctypes.c_size_t), ("version", Version))


class Question(ctypes.Structure):
    """``XLA_FFI_Metadata_Extension``, by which XLA asks a handler for its version."""

    _fields_ = (
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(Metadata)),
    )


METADATA = 1
"""Type of the extension."""


def answer(frame):
    """Fill in the version if a call asks for that, and return whether it did."""
    place = frame.extension_start
    while place:
        question = Question.from_address(place)
        if question.type == METADATA:
            asked = question.metadata.contents.version
            asked.major, asked.minor = version()
            return True
        place = question.next
    return False
