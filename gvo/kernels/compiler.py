"""Compile all kernels of this package into one file of machine code, by Numba and LLVM.

Started by `gvo.kernels.jit` as a process of its own: python -m gvo.kernels.compiler FILE
"""

from __future__ import annotations

import ctypes
import importlib
import os
import pkgutil
import sys
from collections.abc import Callable
from functools import partial, reduce
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

# LLVM optimizes once, all kernels together; and as IEEE has it, without the library of Intel.
os.environ |= {"NUMBA_OPT": "0", "NUMBA_DISABLE_INTEL_SVML": "1", "NUMBA_DISABLE_JIT": "0"}

import llvmlite.binding as llvm
import numba
import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from numba.np import arrayobj

from gvo import kernels
from gvo.kernels import jit

os.environ[jit.SWITCH] = "python"  # what is imported from here on is not compiled yet
_EVERY = 10
_OWN = {f"{kernels.__name__}.{name}" for name in ("__main__", "compiler", "jit")}
_TYPES: dict[str | None, Any] = {
    "f4": types.float32,
    "f8": types.float64,
    "i8": types.int64,
    "i2": types.int16,
    "u1": types.uint8,
    "u2": types.uint16,
    "b1": types.boolean,
    None: types.void,
}
_WORDS = types.CPointer(types.int64)
# An array of NumPy in words: what each object of Python has; data; number of axes; shape.
_DATA = object.__basicsize__ // 8
_SHAPE = _DATA + 2
# What machine code may call.
_LIBRARY = {
    "sqrt",
    "sin",
    "cos",
    "tan",
    "acos",
    "asin",
    "atan",
    "atan2",
    "exp",
    "log",
    "pow",
    "hypot",
}
# Numba counts who holds an array; kernels hold none of their own.
_COUNTS = "\n".join(
    f"define void @NRT_{each}(ptr %p) {{ ret void }}" for each in ("incref", "decref")
)
# Numba's stubs know neither its own decorators nor all options.
_njit: Any = partial(
    numba.njit, error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True
)
_cfunc: Any = numba.cfunc
_intrinsic: Any = intrinsic


def _build_array(context, builder, kind, data, lengths):
    """Return an array of a type within a function: C-contiguous, of memory that is not counted."""
    array = arrayobj.make_array(kind)(context, builder)
    size = context.get_constant(types.intp, context.get_abi_sizeof(array.data.type.pointee))
    strides = [size]
    for length in reversed(lengths[1:]):
        strides.insert(0, builder.mul(strides[0], length))
    pointer = builder.bitcast(data, array.data.type)
    arrayobj.populate_array(array, pointer, lengths, strides, size, None)
    return array._getvalue()


def _view_of(argument: jit.Array) -> Any:
    """Return a function of a kernel's entry: it makes Numba's array of an object of NumPy."""
    kind = types.Array(_TYPES[argument.dtype.str[1:]], argument.ndim, "C", not argument.is_written)

    def build(context, builder, _signature, arguments):
        def word(words, place):
            return builder.load(builder.gep(words, [ir.Constant(ir.IntType(64), place)]))

        pointer_type = ir.IntType(64).as_pointer()
        shape = builder.inttoptr(word(arguments[0], _SHAPE), pointer_type)
        data = builder.inttoptr(word(arguments[0], _DATA), pointer_type)
        lengths = [word(shape, axis) for axis in range(kind.ndim)]
        return _build_array(context, builder, kind, data, lengths)

    return _intrinsic(lambda _context, _words: (kind(_WORDS), build))


def _on_stack(kind, *lengths):
    """Return the type and the code of a small array that lasts as long as the function it is in."""

    def build(context, builder, _signature, arguments):
        size = reduce(builder.mul, arguments)
        data = builder.alloca(ir.DoubleType(), size=size)
        return _build_array(context, builder, kind, data, arguments)

    return kind(*[types.int64] * len(lengths)), build


@_intrinsic
def _vector(_context, n):
    return _on_stack(types.float64[::1], n)


@_intrinsic
def _matrix(_context, n_rows, n_columns):
    return _on_stack(types.float64[:, ::1], n_rows, n_columns)


def compile_all() -> bytes:
    """Return the machine code of all kernels, and say now and then how far it is."""
    _check_layout()
    names = [each.name for each in pkgutil.iter_modules(kernels.__path__, f"{kernels.__name__}.")]
    modules = [importlib.import_module(name) for name in names if name not in _OWN]
    functions = [
        value
        for module in modules
        for value in vars(module).values()
        if hasattr(value, "signature") and value.__module__ == module.__name__
    ]
    _prepare_helpers(modules)
    together = llvm.parse_assembly(_COUNTS)
    for k, function in enumerate(functions):
        if k % _EVERY == 0:
            print(f"{k + 1} of {len(functions)}", flush=True)  # noqa: T201 - to who waits
        together.link_in(_module_of(function))
    return _machine_code(together, {jit.symbol_of(each) for each in functions})


def _check_layout() -> None:
    """Refuse a NumPy whose arrays are laid out in another way."""
    array, words = np.empty((2, 3)), ctypes.POINTER(ctypes.c_int64)
    told = ctypes.cast(id(array), words)
    if told[_DATA] != array.ctypes.data or ctypes.cast(told[_SHAPE], words)[:2] != [2, 3]:
        raise SystemExit(f"arrays of NumPy {np.__version__} are of an unknown layout")


def _prepare_helpers(modules: list[ModuleType]) -> None:
    """Give Numba's form to each helper, in each module that names it."""
    prepared: dict[Any, Any] = {jit.vector: _vector, jit.matrix: _matrix}
    for module in modules:
        for name, value in list(vars(module).items()):
            if hasattr(value, "is_helper"):
                prepared.setdefault(value, _njit(value))
            if isinstance(value, FunctionType) and value in prepared:
                setattr(module, name, prepared[value])


def _module_of(function: Any) -> llvm.ModuleRef:
    """Return LLVM's form of a kernel: a function of C whose arguments are objects and numbers."""
    arguments, returns = function.signature
    given = [_TYPES[each] if isinstance(each, str) else _WORDS for each in arguments]
    entry = _cfunc(_TYPES[returns](*given), error_model="numpy")(_entry_of(function, arguments))
    module = llvm.parse_assembly(entry.inspect_llvm())
    module.get_function(entry.native_name).name = jit.symbol_of(function)
    return module


def _entry_of(function: Any, arguments: tuple[jit.Array | str, ...]) -> Callable[..., Any]:
    """Return a function that calls a kernel with numbers, and with arrays for objects."""
    names = [f"a{k}" for k in range(len(arguments))]
    views = {
        f"v{k}": _view_of(each) for k, each in enumerate(arguments) if not isinstance(each, str)
    }
    given = [f"v{k}({name})" if f"v{k}" in views else name for k, name in enumerate(names)]
    scope = views | {"kernel": _njit(function)}
    text = f"def entry({', '.join(names)}): return kernel({', '.join(given)})"
    exec(text, scope)  # noqa: S102 - of this package's own signatures
    return scope["entry"]  # type: ignore[no-any-return]


def _machine_code(module: llvm.ModuleRef, entries: set[str]) -> bytes:
    """Optimize, and return code for the processor of this machine.

    Only entries are seen from outside. What cannot happen within falls away with it, as errors.
    """
    for each in (*module.functions, *module.global_variables):
        if not each.is_declaration and each.name not in entries:
            each.linkage = "internal"
    machine = llvm.Target.from_default_triple().create_target_machine(
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        opt=3,
        jit=True,
    )
    passes = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=3))
    passes.getModulePassManager().run(module, passes)
    # Now that functions are simple, it is found which cannot fail.
    last = llvm.create_new_module_pass_manager()
    last.add_ipsccp_pass()
    last.add_simplify_cfg_pass()
    last.add_global_dead_code_eliminate_pass()
    last.add_strip_dead_prototype_pass()
    last.run(module, passes)
    called = {each.name for each in module.functions if each.is_declaration}
    foreign = {name for name in called - _LIBRARY if not name.startswith("llvm.")}
    if foreign:
        raise SystemExit(f"kernels must neither raise nor make arrays, but call {sorted(foreign)}")
    return bytes(machine.emit_object(module))


if __name__ == "__main__":
    jit.write(Path(sys.argv[1]), compile_all())
