"""Makes the launchers known to Hydra. `register` is called before Hydra starts."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

PLUGINS = ("hydra_plugins.", "hydra._internal.core_plugins.", "dadiff.launching.")


@dataclass
class ProcessesSchema:
    """The typed schema under `conf/hydra/launcher/processes.yaml`; the fields are explained there."""

    _target_: str = "dadiff.launching.processes.ProcessesLauncher"
    workers: int | None = None
    threads: int = 1
    time_limit: float | None = None
    sweep: str | None = None


@dataclass
class SlurmSchema:
    """The typed schema under `conf/hydra/launcher/slurm.yaml`."""

    _target_: str = "dadiff.launching.slurm.SlurmLauncher"
    cluster: str = "slurm"
    workers: int = 16
    threads: int = 1
    time_limit: float = 14400.0
    memory: float | None = None
    gpus: int | None = None
    partition: str | None = None
    account: str | None = None
    options: dict[str, Any] = field(default_factory=dict)
    sweep: str | None = None


@dataclass
class RaySchema:
    """The typed schema under `conf/hydra/launcher/ray.yaml`."""

    _target_: str = "dadiff.launching.ray.RayLauncher"
    address: str | None = None
    workers: int | None = None
    threads: int = 1
    time_limit: float | None = None
    sweep: str | None = None


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
    launchers: dict[str, tuple[type[Plugin], type]] = {
        "processes": (ProcessesLauncher, ProcessesSchema),
        "slurm": (SlurmLauncher, SlurmSchema),
        "ray": (RayLauncher, RaySchema),
    }
    for name, (launcher, schema) in launchers.items():
        plugins.register(launcher)
        ConfigStore.instance().store(group="hydra/launcher", name=f"{name}_schema", node=schema)
    plugins.register(RunSweeper)
    ConfigStore.instance().store(group="hydra/sweeper", name="cells", node=CellsSchema)
    install()


def _is_plugin(name: str) -> bool:
    return name.startswith(PLUGINS)
