"""What another processor does, on this one: every product, sum, exponential and logarithm differs in its last bits.

    pytest --jitter tests/analyze           # VLA_JITTER=2 gives other last bits

A library picks its kernels by processor, length and memory, so the last bits of what it adds up are promised to nobody.
Here they change by a factor that a seed and the place in an array of this shape and kind decide. The same work twice
gives the same bits; the same numbers in a batch of another size do not. A test that then fails held bits that nobody
promised.

numpy: as a module of `vla_attention.analyze` or `vla_attention.schemas` is loaded, each expression that adds up is put
into `jittered(...)`. torch: its matrix products on processors are numpy's, jittered. The finder reaches the processes
that tests start, too: `sitecustomize.py` beside this file installs it there.
"""

from __future__ import annotations

import ast
import marshal
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import lru_cache
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any
from zlib import crc32

#: The seed; processes that tests start inherit it.
SEED = "VLA_JITTER"
CHANGED, DRAWS = ("vla_attention.analyze", "vla_attention.schemas"), "vla_attention.analyze.render"
#: What was compiled, by its text.
_COMPILED = Path(tempfile.gettempdir()) / f"jittered-{sys.implementation.cache_tag}"
#: Methods and functions whose last bits hang on the kernel. Square roots and quotients are exact everywhere.
ADD_UP = {"sum", "mean", "std", "var", "dot", "matmul", "einsum", "tensordot", "average", "reduceat", "norm", "nanmean"}
CURVES = {"exp", "expm1", "log", "log1p", "log2", "log10", "power", "tanh", "sin", "cos", "arctan2", "arccos"}


def switch_on() -> None:
    """Before anything of the package that computes is loaded."""
    loaded = {name: module.__file__ for name, module in sys.modules.items() if _is_changed(name)}
    early = [name for name, file in loaded.items() if file and "_jittered" in ast.unparse(_changed_tree(file))]
    assert not early, f"loaded too early to be changed: {early}"
    assert "torch" not in sys.modules
    here = Path(__file__).parent
    os.environ.setdefault(SEED, "1")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(here), *filter(None, [os.environ.get("PYTHONPATH")])])
    install()


def install() -> None:
    """Change what is imported from now on, where the variable is set."""
    if SEED in os.environ and not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())


def _is_changed(name: str) -> bool:
    return name.startswith(CHANGED) and not name.startswith(DRAWS)


def jittered(value: Any) -> Any:
    """An array of floating numbers or one of them with other last bits; anything else as it is.

    Whole numbers stay: sums of counts are exact on every processor.
    """
    import numpy as np

    if not isinstance(value, np.ndarray | np.floating) or value.dtype.kind != "f" or not value.size:
        return value
    factors = _factors(value.shape, value.dtype.char)
    with np.errstate(all="ignore"):
        return np.where(value == np.rint(value), value, value * factors)[()].astype(value.dtype, copy=False)


@lru_cache(maxsize=4096)
def _factors(shape: tuple[int, ...], kind: str) -> Any:
    """1 and at most a rounding more or less, by place."""
    import numpy as np

    size = np.finfo(kind).eps
    random = np.random.default_rng([int(os.environ[SEED]), crc32(repr((shape, kind)).encode())])
    return (1.0 + random.uniform(-size, size, shape)).astype(kind)


class _Wrap(ast.NodeTransformer):
    """Puts `_jittered(...)` around products, and around calls of what adds up."""

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        self.generic_visit(node)
        return self._wrapped(node) if isinstance(node.op, ast.MatMult) else node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        called = node.func.attr if isinstance(node.func, ast.Attribute) else ""
        return self._wrapped(node) if called in ADD_UP | CURVES else node

    @staticmethod
    def _wrapped(node: ast.expr) -> ast.AST:
        call = ast.Call(ast.Name("_jittered", ast.Load()), [node], [])
        return ast.fix_missing_locations(ast.copy_location(call, node))


def _changed_tree(file: str) -> ast.Module:
    tree: ast.Module = _Wrap().visit(ast.parse(Path(file).read_bytes(), file))
    return tree


class _Changed(SourceFileLoader):
    """Compiles a module with its sums wrapped, once for all processes; Python's own compiled file is not read."""

    def get_code(self, fullname: str) -> CodeType:
        file = self.get_filename(fullname)
        text = Path(file).read_bytes() + Path(__file__).read_bytes() + file.encode()
        kept = _COMPILED / f"{crc32(text):08x}-{fullname}"
        if not kept.exists():
            code = compile(_changed_tree(file), file, "exec", dont_inherit=True)
            _COMPILED.mkdir(exist_ok=True)
            own = kept.with_name(f"{kept.name}-{os.getpid()}")
            own.write_bytes(marshal.dumps(code))
            own.replace(kept)
        code = marshal.loads(kept.read_bytes())
        assert isinstance(code, CodeType)
        return code

    def exec_module(self, module: ModuleType) -> None:
        vars(module)["_jittered"] = jittered
        super().exec_module(module)


class _Torch(Loader):
    """Torch's own loader, and its products on processors replaced afterwards."""

    def __init__(self, own: Loader) -> None:
        self.own = own

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self.own.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        self.own.exec_module(module)
        _replace_products(module)


class _Finder(MetaPathFinder):
    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> Any:
        if fullname != "torch" and not _is_changed(fullname):
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is None or spec.loader is None or spec.origin is None:
            return None
        if fullname == "torch":
            spec.loader = _Torch(spec.loader)
        elif isinstance(spec.loader, SourceFileLoader):
            spec.loader = _Changed(fullname, spec.origin)
        return spec


def _replace_products(torch: Any) -> None:
    """Register other kernels for `mm`, `bmm`, `addmm` and `baddbmm` of the processor, below autograd and every mode."""
    import warnings

    import numpy as np

    def product(first: Any, second: Any) -> Any:
        small = first.dtype in (torch.bfloat16, torch.float16)  # numpy has no bfloat16
        values = [(each.detach().float() if small else each.detach()).numpy() for each in (first, second)]
        return torch.from_numpy(np.ascontiguousarray(jittered(np.matmul(*values)))).to(first.dtype)

    def with_sum(added: Any, first: Any, second: Any, *, beta: float = 1, alpha: float = 1) -> Any:
        found = product(first, second) * alpha
        return (found + added * beta if beta else found).to(first.dtype)

    library = torch.library.Library("aten", "IMPL")
    kernels: dict[str, Callable[..., Any]] = {
        "mm": product, "bmm": product, "addmm": with_sum, "baddbmm": with_sum,
    }  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it says that they are replaced
        for name, kernel in kernels.items():
            library.impl(name, kernel, "CPU", allow_override=True)
    torch.vla_jitter = library  # it ends with the last reference to it
