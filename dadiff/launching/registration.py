"""Makes the launchers known to Hydra. `register` is called before Hydra starts."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, make_dataclass
from typing import get_type_hints

PLUGINS = ("hydra_plugins.", "hydra._internal.core_plugins.", "dadiff.launching.")


@dataclass
class CellsSchema:
    """The sweeper `cells`, as Hydra's `basic`."""

    _target_: str = "dadiff.launching.sweeper.RunSweeper"
    max_batch_size: int | None = None
    params: dict[str, str] | None = None


def register() -> None:
    """Register launchers and their schemas, and guard what Hydra does on its own.

    Hydra takes plugins from its namespace package `hydra_plugins` only. A class that is registered by hand passes
    every other check, so the list of accepted names is widened by this package instead.
    """
    from hydra.core.config_store import ConfigStore
    from hydra.core.plugins import Plugins
    from hydra.plugins.plugin import Plugin

    plugins = Plugins.instance()  # which loads Hydra's own anew, so that ours may extend them only from here on
    from dadiff.launching.guard import install
    from dadiff.launching.processes import ProcessesLauncher
    from dadiff.launching.ray import RayLauncher
    from dadiff.launching.slurm import SlurmLauncher
    from dadiff.launching.sweeper import RunSweeper

    Plugins.is_in_toplevel_plugins_module = staticmethod(_is_plugin)  # type: ignore[assignment]
    launchers: dict[str, type[Plugin]] = {"processes": ProcessesLauncher, "slurm": SlurmLauncher, "ray": RayLauncher}
    for name, launcher in launchers.items():
        plugins.register(launcher)
        ConfigStore.instance().store(group="hydra/launcher", name=f"{name}_schema", node=_schema(launcher))
    plugins.register(RunSweeper)
    ConfigStore.instance().store(group="hydra/sweeper", name="cells", node=CellsSchema)
    install()


def _schema(launcher: type) -> type:
    """The typed schema under the yaml of a launcher: its fields, which are explained there, and which class it is."""
    types, target = get_type_hints(launcher), f"{launcher.__module__}.{launcher.__qualname__}"
    parts = [
        (part.name, types[part.name], field(default=part.default, default_factory=part.default_factory))
        for part in fields(launcher)
    ]
    return make_dataclass(launcher.__name__, [("_target_", str, target), *parts])


def _is_plugin(name: str) -> bool:
    return name.startswith(PLUGINS)
