"""Public names of a package that are imported at their first use, so that importing the package stays light (PEP 562)."""

from collections.abc import Callable, Mapping
from importlib import import_module


def lazy_names(package: str, names: Mapping[str, str]) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package. names: by module, its public names, separated by spaces."""
    modules = {name: module for module, listed in names.items() for name in listed.split()}

    def imported(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(modules[name]), name)

    return imported, lambda: sorted(modules)
