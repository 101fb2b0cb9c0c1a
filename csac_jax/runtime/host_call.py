"""Functions of the host, called from compiled programs by a key, the same in every process.

JAX caches no program on disk that has a `jax.pure_callback`: only this process knows the function.
Here a program holds a key, and one handler of XLA's foreign function interface looks it up. So the
next process can use the cached program. CPU only.

The structs are those of XLA's `xla/ffi/api/c_api.h`, version 0.1 or later, whose fields are only
ever added at the end.
"""

import ctypes
import functools
from collections.abc import Callable
from ctypes import POINTER, c_char_p, c_int, c_int64, c_size_t, c_uint32, c_void_p
from typing import Any

import jax
import numpy as np

TARGET = "csac_jax_host_call"
_METADATA, _INTERNAL = 1, 13  # XLA_FFI_Extension_Metadata, XLA_FFI_Error_Code_INTERNAL
_TYPES = {1: np.bool_, 4: np.int32, 6: np.uint8, 8: np.uint32, 11: np.float32}  # XLA_FFI_DataType


_functions: dict[str, tuple[Callable[..., Any], Any]] = {}  # and the structure of its arguments


def call(function: Callable[..., Any], key: str, result: Any, *arguments: Any) -> Any:
    """Calls as `jax.pure_callback` with vmap_method broadcast_all a function that `key` identifies.

    Args: key, equal in two processes only if the functions are; result, a pytree of arrays like the
    result's. The function gets NumPy arrays that are its own only until it returns.
    """
    _register()
    leaves, tree = jax.tree.flatten(arguments)
    _functions[key] = function, tree
    shapes = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype), result)
    called = jax.ffi.ffi_call(TARGET, jax.tree.leaves(shapes), vmap_method="broadcast_all")
    return jax.tree.unflatten(jax.tree.structure(shapes), called(*leaves, key=key))


@functools.cache
def _register() -> None:
    jax.ffi.register_ffi_target(TARGET, jax.ffi.pycapsule(_handler), platform="cpu")


def _struct(name: str, **fields: Any) -> Any:
    """Makes a ctypes struct; those of the interface begin with their size and extensions."""
    return type(name, (ctypes.Structure,), {"_fields_": list(fields.items())})


_HEAD: dict[str, Any] = {"struct_size": c_size_t, "extension": c_void_p}
_Extension = _struct("Extension", struct_size=c_size_t, type=c_int, next=c_void_p, value=c_void_p)
_Version = _struct("Version", **_HEAD, major=c_int, minor=c_int)
_Metadata = _struct("Metadata", struct_size=c_size_t, version=_Version, traits=c_uint32)
_Buffer = _struct("Buffer", **_HEAD, type=c_int, data=c_void_p, rank=c_int64, dims=POINTER(c_int64))
_Text = _struct("Text", start=c_void_p, length=c_size_t)
_LIST: dict[str, Any] = {"size": c_int64, "types": POINTER(c_int)}
_TEXTS = POINTER(POINTER(_Text))
_Buffers = _struct("Buffers", **_HEAD, **_LIST, values=POINTER(POINTER(_Buffer)))
_Attributes = _struct("Attributes", **_HEAD, **_LIST, names=_TEXTS, values=_TEXTS)
_Error = _struct("Error", **_HEAD, message=c_char_p, code=c_int)
_MakeError = ctypes.CFUNCTYPE(c_void_p, POINTER(_Error))
_Api = _struct("Api", **_HEAD, version=_Version, internal=c_void_p, make_error=_MakeError)
_PARTS = {"arguments": _Buffers, "results": _Buffers, "attributes": _Attributes}
_Frame = _struct("Frame", **_HEAD, api=POINTER(_Api), context=c_void_p, stage=c_int, **_PARTS)


@ctypes.CFUNCTYPE(c_void_p, POINTER(_Frame))
def _handler(pointer: Any) -> int | None:
    """Handles a call of XLA, at first for the version. Returns an error, or None."""
    frame = pointer.contents
    if frame.extension:
        _tell_version(frame)
        return None
    try:
        _run(frame)
    except BaseException as error:  # nothing may pass through XLA
        message = f"{type(error).__name__}: {error}".encode()
        fault = _Error(ctypes.sizeof(_Error), None, message, _INTERNAL)
        return frame.api.contents.make_error(ctypes.byref(fault))
    return None


def _tell_version(frame: Any) -> None:
    """Reports XLA's version of the interface as the handler's."""
    extension = ctypes.cast(frame.extension, POINTER(_Extension)).contents
    if extension.type == _METADATA:
        version = ctypes.cast(extension.value, POINTER(_Metadata)).contents.version
        known = frame.api.contents.version
        version.major, version.minor = known.major, known.minor


def _run(frame: Any) -> None:
    text = frame.attributes.values[0].contents
    function, tree = _functions[ctypes.string_at(text.start, text.length).decode()]
    result = function(*jax.tree.unflatten(tree, _arrays(frame.arguments)))
    for array, value in zip(_arrays(frame.results), jax.tree.leaves(result), strict=True):
        if array.shape != np.shape(value):
            raise ValueError(f"a result has the shape {np.shape(value)}, not {array.shape}")
        array[...] = value


def _arrays(buffers: Any) -> list[np.ndarray]:
    return [_array(buffers.values[i].contents) for i in range(buffers.size)]


def _array(buffer: Any) -> np.ndarray:
    shape, dtype = tuple(buffer.dims[: buffer.rank]), np.dtype(_TYPES[buffer.type])
    size = int(np.prod(shape)) * dtype.itemsize
    memory: Any = (ctypes.c_byte * size).from_address(buffer.data or 0)
    return np.ndarray(shape, dtype, memory)
