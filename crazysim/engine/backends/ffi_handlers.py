"""Handlers of XLA's foreign function interface in Python, and a handler that launches kernels on a GPU.

XLA calls a handler with a frame of C structures (``xla/ffi/api/c_api.h``, which JAX has in ``jax.ffi.include_dir()``).
Handlers read only members that all releases of the interface have so far.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Sequence
from ctypes import POINTER, c_char, c_char_p, c_int, c_int32, c_int64, c_size_t, c_uint32, c_void_p, cast
from typing import Any

from crazysim.engine import jaxcompat
from crazysim.engine.errors import KernelError

API_VERSION = (0, 1)
"""Version of the interface, major and minor, that has all members that are read here."""

_METADATA_EXTENSION, _EXECUTE_STAGE, _SCALAR, _STRING, _INTERNAL_ERROR = 1, 3, 3, 4, 13
"""Values of XLA_FFI_Extension_Type, XLA_FFI_ExecutionStage, XLA_FFI_AttrType (two) and XLA_FFI_Error_Code."""

_BASE = [("struct_size", c_size_t), ("extension_start", c_void_p)]
"""Members at the beginning of most structures."""


def _structure(name: str, *fields: tuple[str, Any], base: Sequence[Any] = _BASE) -> Any:
    return type(name, (ctypes.Structure,), {"_fields_": [*base, *fields]})


_Version = _structure("XLA_FFI_Api_Version", ("major", c_int), ("minor", c_int))
_Api = _structure(
    "XLA_FFI_Api",
    ("version", _Version),
    ("internal_api", c_void_p),
    *((name, c_void_p) for name in ("create_error", "get_message", "destroy_error", "register", "get_stream")),
)
_Values = _structure("XLA_FFI_Args", ("size", c_int64), ("types", c_void_p), ("values", POINTER(c_void_p)))
_Attributes = _structure(
    "XLA_FFI_Attrs",
    *(("size", c_int64), ("types", POINTER(c_int)), ("names", POINTER(c_void_p)), ("values", POINTER(c_void_p))),
)
_Frame = _structure(
    "XLA_FFI_CallFrame",
    *(("api", POINTER(_Api)), ("context", c_void_p), ("stage", c_int)),
    *(("operands", _Values), ("results", _Values), ("attributes", _Attributes), ("future", c_void_p)),
)
_Buffer = _structure("XLA_FFI_Buffer", ("dtype", c_int), ("data", c_void_p))
_Bytes = _structure("XLA_FFI_ByteSpan", ("data", POINTER(c_char)), ("length", c_size_t), base=())
_Scalar = _structure("XLA_FFI_Scalar", ("dtype", c_int), ("value", c_void_p), base=())
_Metadata = _structure("XLA_FFI_Metadata", ("version", _Version), ("traits", c_uint32), base=_BASE[:1])
_Extension = _structure(
    "XLA_FFI_Metadata_Extension",
    *(("struct_size", c_size_t), ("type", c_int), ("next", c_void_p), ("metadata", POINTER(_Metadata))),
    base=(),
)
_StreamRequest = _structure("XLA_FFI_Stream_Get_Args", ("context", c_void_p), ("stream", c_void_p))
_ErrorRequest = _structure("XLA_FFI_Error_Create_Args", ("message", c_char_p), ("code", c_int))
_HANDLER = ctypes.CFUNCTYPE(c_void_p, POINTER(_Frame))
_API_FUNCTION = ctypes.CFUNCTYPE(c_void_p, c_void_p)


class Call:
    """Call of a handler: the addresses of its operands and results, and its attributes."""

    def __init__(self, frame: Any):
        self._frame = frame
        self.operands = self._addresses(frame.operands)
        """Addresses of the operands."""
        self.results = self._addresses(frame.results)
        """Addresses of the results."""

    @staticmethod
    def _addresses(values: Any) -> list[int]:
        return [cast(values.values[i], POINTER(_Buffer)).contents.data or 0 for i in range(values.size)]

    def attribute(self, name: str) -> Any:
        """Return an attribute, an int32 or bytes."""
        attributes = self._frame.attributes
        for i in range(attributes.size):
            if _bytes(attributes.names[i]) == name.encode():
                kind, value = attributes.types[i], attributes.values[i]
                if kind == _STRING:
                    return _bytes(value)
                if kind == _SCALAR:
                    return c_int32.from_address(cast(value, POINTER(_Scalar)).contents.value).value
        raise KernelError(f"the call has no attribute {name!r}")

    def stream(self) -> int:
        """Return the address of the CUDA stream that the call belongs to."""
        request = _StreamRequest(ctypes.sizeof(_StreamRequest), None, self._frame.context, None)
        if _API_FUNCTION(self._frame.api.contents.get_stream)(ctypes.addressof(request)):
            raise KernelError("XLA did not name the stream of the call")
        return request.stream or 0


def _bytes(address: int) -> bytes:
    span = cast(address, POINTER(_Bytes)).contents
    return ctypes.string_at(span.data, span.length)


def register(name: str, platform: str, run: Callable[[Call], None]) -> None:
    """Register a function as the target of ``jax.ffi.ffi_call``, for the lifetime of the process.

    An exception of the function becomes an error of the program that calls it.

    Args:
        platform: Platform in the spelling of ``jax.ffi``, ``"cpu"`` or ``"CUDA"``.
        run: Function that is called with the ``Call`` of each execution.
    """

    def handle(frame: Any) -> int | None:
        try:
            return _handle(frame.contents, run)
        except Exception as error:  # an exception cannot propagate out of a callback
            message = f"{type(error).__name__}: {error}".encode()
            request = _ErrorRequest(ctypes.sizeof(_ErrorRequest), None, message, _INTERNAL_ERROR)
            return _API_FUNCTION(frame.contents.api.contents.create_error)(ctypes.addressof(request))

    callback = _HANDLER(handle)
    _CALLBACKS.append(callback)
    jaxcompat.register_target(name, callback, platform)


_CALLBACKS: list[Any] = []
"""All handlers, which XLA calls until the process ends."""


def _handle(frame: Any, run: Callable[[Call], None]) -> None:
    if frame.extension_start:
        extension = cast(frame.extension_start, POINTER(_Extension)).contents
        if extension.type == _METADATA_EXTENSION:  # XLA asks for the version, and for nothing else
            extension.metadata.contents.version.major, extension.metadata.contents.version.minor = API_VERSION
            return
    if frame.stage == _EXECUTE_STAGE:
        run(Call(frame))


# Kernels on a GPU -----------------------------------------------------------------------------------------------

_FUNCTIONS: dict[tuple[int, bytes], Any] = {}
"""Loaded kernels by CUDA context and digest."""
_LOADING_LOCK = threading.Lock()


def launch_kernel(call: Call) -> None:
    """Launch the kernel of a call.

    The attributes of the call are ``kernel_data``, the PTX; ``digest``, which differs between kernels; ``name``, the
    name of the kernel's function; ``grid_x``, the number of blocks; and ``block_x``, the threads of a block. The
    arguments of the kernel are the addresses of operands and results, in this order.
    """
    driver, stream, context = ctypes.CDLL("libcuda.so.1"), c_void_p(call.stream()), c_void_p()
    check_driver(driver.cuStreamGetCtx(stream, ctypes.byref(context)))
    check_driver(driver.cuCtxPushCurrent_v2(context))
    try:
        key = context.value or 0, call.attribute("digest")
        with _LOADING_LOCK:
            if key not in _FUNCTIONS:
                module, function = c_void_p(), c_void_p()
                check_driver(driver.cuModuleLoadData(ctypes.byref(module), call.attribute("kernel_data") + b"\0"))
                check_driver(driver.cuModuleGetFunction(ctypes.byref(function), module, call.attribute("name")))
                _FUNCTIONS[key] = function
        addresses = [c_void_p(x) for x in (*call.operands, *call.results)]
        pointers = (c_void_p * len(addresses))(*(ctypes.addressof(x) for x in addresses))
        grid, block = call.attribute("grid_x"), call.attribute("block_x")
        check_driver(driver.cuLaunchKernel(_FUNCTIONS[key], grid, 1, 1, block, 1, 1, 0, stream, pointers, None))
    finally:
        driver.cuCtxPopCurrent_v2(ctypes.byref(context))


def check_driver(result: int) -> None:
    if result:
        raise KernelError(f"the CUDA driver answered error {result}")
