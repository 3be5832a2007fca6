"""Makes the launchers known to Hydra. `register` is called before Hydra starts."""

from __future__ import annotations

from dataclasses import dataclass

PLUGINS = ("hydra_plugins.", "hydra._internal.core_plugins.", "dadiff.launching.")


@dataclass
class ProcessesSchema:
    """The typed schema under `conf/hydra/launcher/processes.yaml`; the fields are explained there."""

    _target_: str = "dadiff.launching.processes.ProcessesLauncher"
    workers: int | None = None
    threads: int = 1
    time_limit: float | None = None
    sweep: str | None = None


def register() -> None:
    """Register launchers and their schemas.

    Hydra takes plugins from its namespace package `hydra_plugins` only. A class that is registered by hand passes
    every other check, so the list of accepted names is widened by this package instead.
    """
    from hydra.core.config_store import ConfigStore
    from hydra.core.plugins import Plugins

    from dadiff.launching.processes import ProcessesLauncher

    Plugins.is_in_toplevel_plugins_module = staticmethod(_is_plugin)  # type: ignore[assignment]
    Plugins.instance().register(ProcessesLauncher)
    ConfigStore.instance().store(group="hydra/launcher", name="processes_schema", node=ProcessesSchema)


def _is_plugin(name: str) -> bool:
    return name.startswith(PLUGINS)
