"""Compilation of inner loops by numba, with a cache that is keyed by content.

The key of a compiled function is a hash of its byte code, that of all compiled functions that it calls, the
constants and record types that they use, and the argument types; no paths, times or docstrings. The reasons
are in docs/decisions/0001-numba.md.
"""

from __future__ import annotations

import atexit
import enum
import hashlib
import inspect
import os
import pickle
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from functools import cache, partial
from importlib.util import find_spec
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any, TypeVar, cast

import numba
import numpy as np
from llvmlite import binding
from numba import core
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult
from numba.core.dispatcher import Dispatcher

from swarm_loc_estimator.common.files import FileError, is_private, replacing, temporary_folder

Function = TypeVar("Function", bound=Callable[..., object])

_NUMBERS = {"None", "bool", "int", "float", "tuple"}
_KEPT_S = 30 * 86400.0
_DAY_S = 86400.0
_DIGEST_SIZE = 32
_HOME = Path.home() / ".cache"
_ROOTS = ("_SWARM_LOC_PRIVATE_CACHE", "NUMBA_CACHE_DIR", "XDG_CACHE_HOME")
_FOREIGN = {*sys.stdlib_module_names, "numpy", "numba", "scipy", "llvmlite"}
_PLAIN = (int, float, complex, str, bytes, type(None), type(...), np.generic, np.dtype)
_core: Any = core  # most of it has no types
_core.config.DISABLE_JIT = 0  # NUMBA_DISABLE_JIT has no effect: only compiled code reads records
if "NUMBA_OPT" not in os.environ:
    # numba's 3 compiles for a quarter longer, and the code is no faster: loops are short or branch
    _core.config.OPT = type(_core.config.OPT)(1)
_CPUS = (
    ("x86-64-v3", "", {"avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"}),
    ("generic", "+v8.2a", {"neon", "crc", "lse"}),
)
"""Name and features of the CPUs that compiled code is for, and what the machine's CPU must have."""
if not {"NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES"} & set(os.environ):
    # equal code and poses on all machines, no slower than for this CPU alone; older CPUs have their own code
    for _name_of_cpu, _features, _needed in _CPUS:
        if all(binding.get_host_cpu_features().get(one) for one in _needed):
            _core.config.CPU_NAME, _core.config.CPU_FEATURES = _name_of_cpu, _features
_registry: Any = core.registry
_types = _core.types
_OPTIONS = f"numba {numba.__version__}, {sys.implementation.cache_tag}"


def cached_njit(function: Function) -> Function:
    """Compile a function on its first call; calls among compiled functions cost nothing."""
    return _compiled(function)


def norefcount_njit(function: Function) -> Function:
    """Compile a function of large tuples of arrays without counting references to the arrays.

    Reference counting for every array would cost more than the arithmetic. Such a function borrows the
    arrays of its caller. It cannot allocate arrays (this does not compile), and it and all functions that it
    calls return numbers, since no one would release an array.

    Raises:
        TypeError: It is declared to return something else.
    """
    return _without_references(function, forceinline=False)


def inlined_njit(function: Function) -> Function:
    """Compile like `norefcount_njit` and inline the function, where even a call would be too slow."""
    return _without_references(function, forceinline=True)


def reassociated_njit(function: Function) -> Function:
    """Compile a function whose sums may be evaluated in any order: several times faster for long sums."""
    return _compiled(function, fastmath={"reassoc", "contract"})


def is_precompiled(precompile: Callable[[], None]) -> bool:
    """Whether there is compiled code of a function (or partial call) and of all that it calls."""
    mark = _mark(precompile)
    return mark.exists() or any((folder / mark.name).exists() for folder in _shipped())


def note_precompiled(precompile: Callable[[], None]) -> None:
    """Record that a function and all that it calls are compiled; delete code unused for a month."""
    mark = _mark(precompile)
    with suppress(OSError):  # where nothing can be kept, the next start compiles again
        mark.touch()
        for file in mark.parent.iterdir():
            if file.stat().st_mtime < time.time() - _KEPT_S:
                file.unlink()


def _without_references(function: Function, *, forceinline: bool) -> Function:
    returned = inspect.formatannotation(function.__annotations__["return"])
    if not _NUMBERS.issuperset(re.findall(r"\w+", returned)):
        raise TypeError(
            f"{function.__qualname__} returns {returned}: functions that borrow return numbers only"
        )
    return _compiled(function, forceinline=forceinline, nrt=False)


def _compiled(
    function: Function, *, fastmath: bool | set[str] = False, forceinline: bool = False, nrt: bool = True
) -> Function:
    # without _nrt a function would count references, or not, as the one that happens to call it first
    options = {
        "error_model": "numpy",
        "fastmath": fastmath,
        "forceinline": forceinline,
        "no_cfunc_wrapper": True,
        "nopython": True,
        "_nrt": nrt,
    }
    return cast("Function", _Function(function, targetoptions=options))


class _Function(_registry.CPUDispatcher):
    """A compiled function, for each signature first compiled for its first caller: compiled code or Python.

    Compiled callers need no wrapper that unpacks Python's arguments. Most functions have no other callers,
    and the wrapper takes as long to compile as a small function.
    """

    def __init__(self, function: Callable[..., object], targetoptions: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=targetoptions)
        self._cache = _ContentCache(self)
        self._for_compiled_caller = False
        self._without_wrapper: set[tuple[Any, ...]] = set()
        self._compiler._customize_flags = self._customize_flags  # noqa: SLF001 - numba has no other way in

    def _customize_flags(self, flags: Any) -> Any:
        flags.no_cpython_wrapper = self._for_compiled_caller
        return flags

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """What a compiled caller needs to know of this function; compiles it for such callers."""
        self._for_compiled_caller = True
        try:
            return super().get_call_template(args, kws)
        finally:
            self._for_compiled_caller = False

    def compile(self, sig: Any) -> Any:
        """Compile one signature; again for a call from Python if only compiled code has called it so far."""
        arguments, _ = _core.sigutils.normalize_signature(sig)
        if not self._for_compiled_caller and tuple(arguments) in self._without_wrapper:
            self._without_wrapper.remove(tuple(arguments))
            del self.overloads[tuple(arguments)]
        return super().compile(sig)

    def add_overload(self, cres: Any) -> None:
        """Keep compiled code, and let Python find it unless it has no wrapper."""
        if self._for_compiled_caller:
            self.overloads[tuple(cres.signature.args)] = cres
            self._without_wrapper.add(tuple(cres.signature.args))
        else:
            super().add_overload(cres)

    @property
    def caller(self) -> str:
        """For whom a function is being compiled."""
        return "compiled" if self._for_compiled_caller else "Python"


class _ContentCache(NullCache):
    """Numba's cache of one function: one file for each key, written whole or not at all."""

    def __init__(self, dispatcher: Any) -> None:
        self._dispatcher = dispatcher

    @property
    def cache_path(self) -> str:
        """The folder of all compiled code."""
        return str(_folder())

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled code for a signature; None if missing or unreadable."""
        # not refresh(): that also imports all that only compiling needs, which takes half a second
        _core.runtime.rtsys.initialize(target_context)
        file = self._file(sig, target_context.codegen())
        if not file.exists():
            file = next((found for folder in _shipped() if (found := folder / file.name).exists()), file)
        try:
            with file.open("rb") as opened:
                data = opened.read()
                if not is_private(os.fstat(opened.fileno())):
                    _say_unsafe(file.parent)
                    return None
            if hashlib.sha256(data[_DIGEST_SIZE:]).digest() != data[:_DIGEST_SIZE]:
                return None  # damaged: it is compiled again
            rebuild: Any = CompileResult._rebuild  # noqa: SLF001
            found = rebuild(target_context, *pickle.loads(data[_DIGEST_SIZE:]))  # noqa: S301
        except (OSError, ImportError, AttributeError):
            return None  # never written, or of types that have moved: it is compiled again
        with suppress(OSError):  # another user's cache may be used, but not touched
            if time.time() - file.stat().st_mtime > _DAY_S:
                os.utime(file)
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep compiled code for the next process."""
        if data.library.has_dynamic_globals:
            raise TypeError(f"{self._dispatcher.py_func.__qualname__} uses a global that cannot be cached")
        file = self._file(sig, data.codegen)
        code = _core.serialize.dumps(data._reduce())  # noqa: SLF001
        with suppress(FileError), replacing(file) as part:  # else the next start compiles again
            part.write_bytes(hashlib.sha256(code).digest() + code)
            part.chmod(0o644)  # whatever the umask, see `is_private`

    def _file(self, sig: Any, codegen: Any) -> Path:
        arguments, _ = _core.sigutils.normalize_signature(sig)
        parts = [
            self._dispatcher.caller,
            _name(self._dispatcher),
            *map(_described_type, arguments),
            *_contents([self._dispatcher]),
        ]
        name = re.sub(r"\W", "", self._dispatcher.py_func.__name__)
        return _folder() / f"{name}-{_digest(parts, codegen)}.nbc"


def _contents(functions: Iterable[Any]) -> list[str]:
    """What code depends on: a line for each function, compiled or not, and for each one that it reaches."""
    found: dict[FunctionType, str] = {}
    left = list(functions)
    while left:
        one = left.pop()
        function = getattr(one, "py_func", one)
        if function not in found:
            options = getattr(one, "targetoptions", {})
            described = [f"{option}={_described(options[option], (), left)}" for option in sorted(options)]
            given = (function.__defaults__, *sorted((function.__kwdefaults__ or {}).items()))
            described += [_described(given, (), left)]
            described += _described_code(function.__code__, _globals_of(function), left)
            found[function] = " ".join([_name(one), *described])
    return sorted(found.values())


def _name(function: Any) -> str:
    own = getattr(function, "py_func", function)
    return f"{own.__module__}.{own.__qualname__}"


def _globals_of(function: FunctionType) -> Mapping[str, Any]:
    """All global and free names that a function may use."""
    cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
    return {**function.__globals__, **{name: cell.cell_contents for name, cell in cells}}


def _described_code(code: CodeType, names: Mapping[str, Any], reached: list[Any]) -> Iterator[str]:
    """A code object without its docstring and lines; functions that it names are added to `reached`."""
    yield f"{code.co_code.hex()} {code.co_varnames} {code.co_names} {code.co_argcount} {code.co_flags}"
    for place, constant in enumerate(code.co_consts):
        if isinstance(constant, CodeType):
            yield from _described_code(constant, names, reached)
        elif place or not isinstance(constant, str):  # the first one is the docstring
            yield _described(constant, (), reached)
    for name in (*code.co_names, *code.co_freevars):
        if name in names:
            yield f"{name}={_described(names[name], code.co_names, reached)}"


def _described(value: Any, attributes: tuple[str, ...], reached: list[Any]) -> str:
    """Text of a value that compiled code uses as a constant; of a module, the attributes it may use."""
    if isinstance(value, Dispatcher | FunctionType):
        if _name(value).partition(".")[0] not in _FOREIGN:
            reached.append(value)
        return _name(value)
    if isinstance(value, enum.Enum):
        return f"{type(value).__qualname__}.{value.name}={_described(value.value, (), reached)}"
    if isinstance(value, _PLAIN):
        return f"{type(value).__name__} {value!r}"
    if isinstance(value, tuple | list):
        fields = f"{type(value).__qualname__}{getattr(value, '_fields', '')}"
        return f"{fields}({', '.join(_described(one, attributes, reached) for one in value)})"
    if isinstance(value, set | frozenset):
        return f"{{{', '.join(sorted(_described(one, (), reached) for one in value))}}}"
    if isinstance(value, np.ndarray):
        return f"{value.dtype!r} {value.shape} {value.tobytes().hex()}"
    if isinstance(value, ModuleType):
        if value.__name__.partition(".")[0] in _FOREIGN:
            return value.__name__
        meant = sorted({name for name in attributes if name in vars(value)})
        rest = tuple(name for name in attributes if name not in meant)  # ends where modules hold each other
        inside = [f"{name}={_described(vars(value)[name], rest, reached)}" for name in meant]
        return f"{value.__name__}({', '.join(inside)})"
    if isinstance(value, enum.EnumMeta):
        return f"({', '.join(_described(member, (), reached) for member in cast('Any', value))})"
    if isinstance(value, type):
        defaults = [_described(one, (), reached) for one in getattr(value, "_field_defaults", {}).values()]
        return f"{value.__module__}.{value.__qualname__}{getattr(value, '_fields', '')}{defaults}"
    if isinstance(value, _types.ExternalFunction):
        return f"{value.symbol} {value.sig}"
    return f"{type(value).__module__}.{type(value).__qualname__} {getattr(value, '__name__', '')}"


def _described_type(argument: Any) -> str:
    """A numba type with the names of the fields of its records, which numba's own name leaves out."""
    parts = [str(argument)]
    if isinstance(argument, _types.BaseNamedTuple):
        record = argument.instance_class
        parts.append(f"{record.__module__}.{record.__qualname__}{argument.fields}")
    if isinstance(argument, _types.BaseTuple):
        parts += [_described_type(one) for one in argument]
    return " ".join(parts)


def _mark(precompile: Callable[[], None]) -> Path:
    """Path of the file that marks a function as precompiled; its name is the hash of the code."""
    modules: dict[str, ModuleType] = {}
    called = precompile.func if isinstance(precompile, partial) else precompile
    kind = precompile.args if isinstance(precompile, partial) else ()
    left = [called.__module__]
    while left:
        name = left.pop()
        if name not in modules:
            modules[name] = sys.modules[name]
            used = [getattr(value, "__module__", None) for value in vars(modules[name]).values()]
            used += [one.__name__ for one in vars(modules[name]).values() if isinstance(one, ModuleType)]
            left += [one for one in used if str(one).startswith("swarm_loc_") and one in sys.modules]
    functions = [function for module in modules.values() for function in _functions_of(module)]
    codegen = _core.registry.cpu_target.target_context.codegen()
    return _folder() / f"precompiled-{_digest([_name(called), repr(kind), *_contents(functions)], codegen)}"


def _functions_of(module: ModuleType) -> Iterator[Any]:
    for value in vars(module).values():
        if getattr(value, "__module__", None) == module.__name__:
            for member in vars(value).values() if isinstance(value, type) else [value]:
                function = getattr(member, "__func__", getattr(member, "fget", member))
                if isinstance(function, Dispatcher | FunctionType):
                    yield function


def _digest(parts: list[str], codegen: Any) -> str:
    checked = _core.config.BOUNDSCHECK
    level = int(_core.config.OPT)
    text = "\n".join([_OPTIONS, f"boundscheck {checked} opt {level}", repr(codegen.magic_tuple()), *parts])
    return hashlib.sha256(text.encode()).hexdigest()[:32]


@cache
def _shipped() -> tuple[Path, ...]:
    """The folder of the package `swarm_loc_compiled`, where it is installed."""
    found = find_spec("swarm_loc_compiled")
    folders = map(Path, (found and found.submodule_search_locations) or ())
    return tuple(folder for folder in folders if is_private(folder.lstat(), folder.stat()))


def _folder() -> Path:
    root = next(filter(None, map(os.environ.get, _ROOTS)), _HOME)
    return _private_folder(Path(root) / "swarm_loc_estimator")


@cache
def _private_folder(folder: Path) -> Path:
    """The folder, or that in the home or a temporary one, for child processes too: code in it is executed."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if is_private(folder.lstat(), folder.stat()):
            return folder
    except OSError:
        return folder  # nothing is read from there, or kept
    _say_unsafe(folder)
    root = _HOME
    if folder.parent == root:
        until_end = ExitStack()
        root = until_end.enter_context(temporary_folder("swarm_loc_estimator_"))
        atexit.register(until_end.close)
    os.environ[_ROOTS[0]] = str(root)  # numba reads its settings again when its own variables change
    return _folder()


@cache
def _say_unsafe(folder: Path) -> None:
    what = f"Compiled code in {folder} that others than this user and root own or can write"
    print(f"{what} is not used: it is compiled again into a folder of this user.", file=sys.stderr)
