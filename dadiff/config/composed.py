"""From Hydra's composed configuration to plain data."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import MissingMandatoryValue, OmegaConfBaseException

from dadiff.config.settings import GROUPS
from dadiff.errors import ConfigError


def output_folder(value: Any) -> str:
    """The setting `output_dir`, which is one folder.

    Raises:
        ConfigError: if it is nothing, a list or a number.
    """
    if not isinstance(value, str) or not value.strip() or "\0" in value:
        raise ConfigError(f"output_dir is {value!r}; expected the path of one folder, such as output_dir=outputs")
    return value


def plain(config: DictConfig, choices: Mapping[str, str]) -> dict[str, Any]:
    """The resolved configuration without Hydra's own node, with the chosen preset of each group under `choices`.

    The output folder is made absolute, so that what is stored does not depend on where it is read.

    Raises:
        ConfigError: if a mandatory value is missing or an interpolation leads nowhere.
    """
    try:
        own = [str(key) for key in config if key != "hydra"]
        content = OmegaConf.masked_copy(config, own) if "hydra" in config else config
        result: Any = OmegaConf.to_container(content, resolve=True, throw_on_missing=True)
    except MissingMandatoryValue as error:
        raise ConfigError(f"{error.full_key} is missing; give {error.full_key}=...") from error
    except OmegaConfBaseException as error:
        raise ConfigError(str(error).splitlines()[0]) from error
    result["output_dir"] = str(Path(output_folder(result["output_dir"])).absolute())
    return {**result, "choices": {group: choices[group] for group in GROUPS if group in choices}}
