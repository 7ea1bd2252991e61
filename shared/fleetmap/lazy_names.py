"""Public names of a package that are imported at their first use, so that importing the package stays light (PEP 562)."""

from collections.abc import Callable, Mapping
from importlib import import_module

from fleetmap.errors import FleetmapError


def lazy_names(
    package: str, names: Mapping[str, str], extra: str = ""
) -> tuple[list[str], Callable[[str], object], Callable[[], list[str]]]:
    """Return `__all__`, `__getattr__` and `__dir__` of a package. names: by module, its public names, separated by spaces.

    extra: without its libraries `__getattr__` raises a FleetmapError that names the install command.
    """
    modules = {name: module for module, listed in names.items() for name in listed.split()}

    def imported(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        try:
            return getattr(import_module(modules[name]), name)
        except ModuleNotFoundError as error:
            if not extra or (error.name or "").split(".")[0] in ("fleetmap", package):
                raise
            install = f"pip install '.[{extra}]' in fleetmap's source folder"
            raise FleetmapError(f"{package}.{name} needs {error.name}, which is not installed; {install}") from error

    return list(modules), imported, lambda: sorted(modules)
