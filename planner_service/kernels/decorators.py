"""Compilation of this folder: each kernel once, for one signature, with a disk cache that watches all sources.

numba's own cache (`numba.njit(cache=True)`) compares a function's file with what it was when compiled. It does
not see that a helper or a constant of another file has changed, although both are compiled into the function. The
stamp here is a hash of every source of this package, so that kernels can share helpers and constants. It is part
of the files' names: numba writes its index before the code that this names, so that under one name a process could
find code of older sources meanwhile. Several processes may compile one kernel at the same time: it has one
signature, so that they write the same.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from llvmlite import ir
from numba import types
from numba.core import caching, codegen, config, sigutils
from numba.extending import intrinsic


def _stamp() -> tuple[str, bool]:
    """Returns the dependencies of compiled code beyond those of numba's index: sources, and whether indices are
    checked."""
    digest = hashlib.sha256()
    for source in sorted(resources.files(__package__).iterdir(), key=lambda entry: entry.name):
        if source.name.endswith(".py"):
            text = source.read_bytes()
            digest.update(f"{source.name} {len(text)} ".encode() + text)
    return digest.hexdigest(), bool(config.BOUNDSCHECK)


_STAMP = _stamp()
_DIGEST_BYTES = hashlib.sha256().digest_size

KERNELS: dict[str, Any] = {}
"""Name -> kernel, of all that Python calls, in the order in which modules were imported."""

BEFORE_LOAD: list[Callable[[str], None]] = []
"""Called with what is loaded or compiled next, on the thread that waits for it."""


class _ReadOnlyLocator(caching.UserProvidedCacheLocator):
    """The folder NUMBA_CACHE_DIR where it is there and cannot be written to, as in an image of a container."""

    def ensure_cache_path(self):
        os.scandir(self.get_cache_path()).close()  # an OSError sends numba on to the next place


class _FolderCacheImpl(caching.CompileResultCacheImpl):
    """numba's, which knows only folders that it can write to."""

    _locator_classes = (
        caching.UserProvidedCacheLocator,
        _ReadOnlyLocator,
        *caching.CompileResultCacheImpl._locator_classes[1:],
    )

    linked = True
    """True if other compiled functions call this one, so that compiling them takes its bitcode."""

    def rebuild(self, target_context, payload):
        """Like numba's. If no other function links to it, only the machine code is read: parsing the bitcode beside
        it, and listing its definitions, takes more than half of loading a kernel."""
        if self.linked:
            return super().rebuild(target_context, payload)
        (name, kind, (code, _)), fndesc, *rest = payload
        defined = (fndesc.llvm_func_name, fndesc.llvm_cpython_wrapper_name)
        target_context.codegen()._engine._defined_symbols.update(defined)
        return super().rebuild(target_context, ((name, kind, (code, _no_bitcode())), fndesc, *rest))


@cache
def _no_bitcode() -> Any:
    return codegen.ll.parse_assembly("").as_bitcode()


class _WholeFiles(caching.IndexDataCacheFile):
    """numba's, for which a file that is not as it was written is one that is not there, so that the kernel is
    compiled and written once more. A failing disk or a power loss leaves such files. Numba raises the exceptions of
    `pickle` on one at every start, and calls machine code with a wrong byte."""

    def _load_index(self):
        try:
            return super()._load_index()
        except Exception:  # of bytes that are no index, or that may not be read
            return {}

    def _load_data(self, name):
        data = Path(self._data_path(name)).read_bytes()
        digest, code = data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]
        if hashlib.sha256(code).digest() != digest:
            raise OSError(f"{name} is not as it was written")  # which numba takes for a missing file
        return pickle.loads(code)

    def _save_data(self, name, data):
        code = self._dump(data)
        with self._open_for_write(self._data_path(name)) as file:
            file.write(hashlib.sha256(code).digest() + code)


class _FolderCache(caching.FunctionCache):
    """A function's cache on disk, found where numba would put it (NUMBA_CACHE_DIR, __pycache__ or the user's)."""

    _impl_class = _FolderCacheImpl

    def __init__(self, function):
        super().__init__(function)
        base = f"{self._impl.filename_base}.{_STAMP[0][:12]}"
        self._cache_file = _WholeFiles(self.cache_path, base, _STAMP)

    def load_overload(self, sig, target_context):
        """Like numba's, but without its registries, which only a compilation needs and which take 0.5 s to load."""
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)

    @property
    def read_only(self):
        return isinstance(self._impl.locator, _ReadOnlyLocator)

    def save_overload(self, sig, data):
        """Like numba's, if there is a folder for it."""
        if not self.read_only:
            super().save_overload(sig, data)


def _compiled(function: Any, **options: bool) -> Any:
    compiled = numba.njit(nogil=True, no_cfunc_wrapper=True, _nrt=False, **options)(function)
    if config.DISABLE_JIT:
        return compiled
    with contextlib.suppress(RuntimeError):  # which numba raises where it finds no place for a cache
        compiled._cache = _FolderCache(function)
    return compiled


def helper(function: Any) -> Any:
    """Decorates a function that only kernels call: compiled for the types that they call it with. Python cannot."""
    return _compiled(function, no_cpython_wrapper=True)


_ARRAYS = {
    "Bytes": "u1[::1]",
    "ByteRows": "u1[:, ::1]",
    "Shorts": "i2[::1]",
    "Ints": "i4[::1]",
    "IntRows": "i4[:, ::1]",
    "Longs": "i8[::1]",
    "LongRows": "i8[:, ::1]",
    "Floats": "f4[::1]",
    "Doubles": "f8[::1]",
    "DoubleRows": "f8[:, ::1]",
    "int": "i8",
}
"""Names of arrays in `layout` -> types in numba's notation."""


def type_of(named: Any) -> Any:
    """The numba type of a NamedTuple, each of whose fields is declared by a name of `layout`, or as int."""
    fields = (_ARRAYS[each.__forward_arg__] for each in named.__annotations__.values())
    return types.NamedTuple(_types(fields), named)


def _types(arguments: Iterable[Any]) -> tuple[Any, ...]:
    return tuple(
        sigutils.normalize_signature(f"({each},)")[0][0] if isinstance(each, str) else each for each in arguments
    )


def kernel(*signature: Any) -> Callable[[Any], Any]:
    """Decorates a function that Python calls: compiled for these types alone, without the GIL, and kept on disk.

    signature  as numba reads one, of the arguments, or each on its own, where one is a `type_of`; any other type is
               a TypeError

    It is compiled, or loaded, by `load`, or else by its first call. If no folder can be written to, every process
    compiles kernels that NUMBA_CACHE_DIR lacks for itself. With NUMBA_DISABLE_JIT the function stays as it is.

    Kernels and helpers allocate nothing, so that no references need to be counted: arrays to write to are handed
    in. That halved the compile time of all.
    """

    def declare(function: Any) -> Any:
        compiled = _compiled(function)
        if not config.DISABLE_JIT:
            if isinstance(compiled._cache, _FolderCache):
                compiled._cache._impl.linked = False  # a kernel calls helpers only
            compiled.declared = signature[0] if len(signature) == 1 else _types(signature)
            compiled._compile_for_args = lambda *_: _load(compiled)  # numba's name for the first call
        KERNELS[function.__name__] = compiled
        return compiled

    return declare


@dataclass(frozen=True, slots=True)
class StepKernel:
    """One kernel over steps, compiled for either kind of map; called with `climbs` as its second argument.

    alike     where entering a cell costs the same from everywhere: `climbs` is None, and no code for it is left
    directed  where a step costs by what it climbs, too
    """

    alike: Any
    directed: Any

    def __call__(self, grid: Any, climbs: Any, *others: Any) -> Any:
        return (self.alike if climbs is None else self.directed)(grid, climbs, *others)


def step_kernel(signature: str, climbs: str) -> Callable[[Any], StepKernel]:
    """Like `kernel`, for both kinds of map: `CLIMBS` in the signature stands for `climbs`, or for nothing."""

    def declare(function: Any) -> StepKernel:
        # A function of another name, as a cache and a builder's claim are found by that.
        name = f"{function.__name__}_directed"
        directed = FunctionType(function.__code__, function.__globals__, name, function.__defaults__)
        directed.__qualname__, directed.__doc__ = name, function.__doc__
        directed.__module__ = function.__module__
        return StepKernel(
            kernel(signature.replace("CLIMBS", "none"))(function),
            kernel(signature.replace("CLIMBS", climbs))(directed),
        )

    return declare


def _load(compiled: Any) -> Any:
    """The kernel's code, from disk or compiled."""
    argument_types, _ = sigutils.normalize_signature(compiled.declared)
    if not is_loaded(compiled):
        for look in BEFORE_LOAD:
            look(f"kernel {compiled.__name__}")
        compiled.compile(argument_types)
        compiled.disable_compile()
    return compiled.overloads[argument_types].entry_point


def load(compiled: Any, compiling: bool = True) -> bool:
    """Makes a kernel ready to be called. Returns whether it is; without `compiling`, only if it is on disk."""
    if not is_loaded(compiled) and (compiling or is_on_disk(compiled)):
        _load(compiled)
    return is_loaded(compiled)


def is_loaded(compiled: Any) -> bool:
    return config.DISABLE_JIT or bool(compiled.overloads)


def is_on_disk(compiled: Any) -> bool:
    """Returns True if a process has compiled the kernel for this machine."""
    # Planners ask many times a second until it is: the rest takes a hundred times as long as this.
    if not isinstance(compiled._cache, _FolderCache) or not Path(compiled._cache._cache_file._index_path).exists():
        return False
    argument_types, _ = sigutils.normalize_signature(compiled.declared)
    kept = compiled._cache
    name = kept._cache_file._load_index().get(kept._index_key(argument_types, compiled.targetctx.codegen()))
    return name is not None and Path(kept._cache_file._data_path(name)).is_file()


def cache_folder() -> Path | None:
    """Returns the folder of compiled code; None if no folder can be written to."""
    return next((Path(each.cache_path) for each in _caches() if not each.read_only), None)


def code_folder() -> Path | None:
    """Returns the folder that is searched for compiled code: `cache_folder`, or NUMBA_CACHE_DIR if that is
    read-only."""
    return next((Path(each.cache_path) for each in _caches()), None)


def _caches() -> list[_FolderCache]:
    caches = [each._cache for each in KERNELS.values() if not config.DISABLE_JIT]
    return [each for each in caches if isinstance(each, _FolderCache)]


_READ, _KEEP, _DATA = 0, 3, 1
"""Constants of llvm.prefetch: for reading; to stay in all caches; data, not instructions."""


def _nothing(array, index):
    pass


@intrinsic
def _llvm_prefetch(typing, array, index):
    def generate(context, builder, signature, arguments):
        number = ir.IntType(32)
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        address = builder.bitcast(builder.gep(data, [arguments[1]]), ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [address.type, number, number, number])
        function = builder.module.declare_intrinsic("llvm.prefetch", [address.type], kind)
        builder.call(function, [address, number(_READ), number(_KEEP), number(_DATA)])
        return context.get_dummy_value()

    return types.void(array, index), generate


prefetch = _nothing if config.DISABLE_JIT else _llvm_prefetch
"""prefetch(array, index) asks for a cell's memory before it is needed. `index` is not read, and may lie anywhere.

It changes no result; uncompiled it does nothing."""
