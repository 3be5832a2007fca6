"""What Hydra may do on its own when it reads files of strangers: compose a configuration, and nothing else.

Hydra can run callbacks, build any class by `_target_`, set up logging handlers, change variables and folders; each of
these may stand in a preset or a sweep. `install` puts a loader in its place that refuses them, and that counts the
cells of a sweep before any is made. What Hydra finds wrong itself becomes a `ConfigError` of one line.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import wraps
from pathlib import Path
from typing import Any

import hydra._internal.hydra
import hydra._internal.utils
import yaml
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import ChoiceSweep, Override, RangeSweep
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dadiff.config.composed import output_folder
from dadiff.config.settings import GROUPS
from dadiff.errors import ConfigError
from dadiff.outside import check_aliases, text_of

MOST_CELLS = 10_000
"""Of a sweep: composing and naming each takes about 10 ms, before the first one runs."""

PLUGINS = ("launcher._target_", "sweeper._target_")
"""Where Hydra's node may name a class: Hydra builds registered plugins only there."""

HANDLERS = ("logging.StreamHandler", "logging.NullHandler", "rich.logging.RichHandler")
HANDLER_KEYS = ("class", "formatter", "level", "stream")
STREAMS = ("ext://sys.stdout", "ext://sys.stderr")
FIXED: Mapping[str, Any] = {
    "callbacks": {},
    "output_subdir": None,
    "run.dir": ".",
    "job.chdir": False,
    "job.env_set": {},
}
"""Settings of Hydra's that would run code, or write beside the output folder."""


MALFORMED = (
    *(HydraException, OmegaConfBaseException, yaml.YAMLError, OSError, RecursionError),
    *(AttributeError, KeyError, TypeError, ValueError),
)
"""What Hydra raises when it composes from files and overrides that are none."""


PARAMETER = re.compile(rf"({'|'.join(GROUPS)})\.[\w.]+=")
"""A component's parameter, which its preset may leave to its default; which ones there are, its signature says."""


AMBIGUOUS = re.compile(r"Ambiguous value for argument '\+*([^=']+)=([^']*)'")


class GuardedLoader(ConfigLoaderImpl):
    """Hydra's loader, which refuses what must not come from a file."""

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        """As `ConfigLoader.load_configuration`.

        Raises:
            ConfigError: if the configuration asks Hydra to act, or is a sweep of too many cells.
        """
        arguments = (run_mode, from_shell, validate_sweep_overrides)
        given = [f"++{text}" if PARAMETER.match(text) else text for text in overrides]
        try:
            config = super().load_configuration(config_name, given, *arguments)
        except MALFORMED as error:
            raise ConfigError(self._told(self._cause(error, config_name, given), config_name)) from error
        if "output_dir" in config:
            check(config)
            if run_mode == RunMode.MULTIRUN and validate_sweep_overrides:  # else Hydra only asks for its mode
                check_sweep(config, overrides)
        return config

    def _cause(self, error: Exception, config_name: str | None, overrides: list[str]) -> Exception:
        """What is wrong where Hydra, having found no mode in a file that is wrong, complains of a sweep's commas."""
        if "Ambiguous value" not in str(error):
            return error
        try:
            super().load_configuration(config_name, overrides, RunMode.MULTIRUN, validate_sweep_overrides=False)
        except MALFORMED as cause:
            return cause
        return error

    def _told(self, error: Exception, config_name: str | None) -> str:
        """Hydra's complaint in one line, with what was probably meant."""
        if isinstance(error, OverrideParseException):
            return _unreadable(error)
        text = one_line(error)
        if several := AMBIGUOUS.match(text):
            key, values = several.groups()
            return f"{key}={values} may be a sweep or a list; write -m to sweep over it, or '{key}=[{values}]'"
        if isinstance(error, MissingConfigException) and error.options:
            return f"{text.partition('Available options')[0].strip()}; {_meant(_last(error), error.options)}"
        if (found := text.partition("Could not override '")[2]) and config_name:
            key = found.partition("'")[0]
            usual = super().load_configuration(config_name, [], RunMode.RUN)
            if key in usual:
                return (
                    f"{key} does not take this value; choose a preset, {key}=name, or set parameters, {key}.name=value"
                )
            return f"key {key!r} is not known; {_meant(key, [*_keys(usual)])}"
        return text


def install() -> None:
    """Put the guarded loader in the place of Hydra's, and our way of reporting errors in that of its own."""
    hydra._internal.hydra.ConfigLoaderImpl = GuardedLoader  # type: ignore[misc]
    hydra._internal.utils.run_and_report = _reporting  # type: ignore[assignment]
    source = SourcesRegistry.instance().resolve("file")
    if not hasattr(source.load_config, "__wrapped__"):
        source.load_config = _judging(source.load_config)  # type: ignore[assignment]


def _judging(load: Callable[[ConfigSource, str], ConfigResult]) -> Callable[[ConfigSource, str], ConfigResult]:
    """Hydra's reading of a preset, once its size and its aliases are judged."""

    @wraps(load)
    def judged(source: ConfigSource, config_path: str) -> ConfigResult:
        path = Path(source.path, source._normalize_file_name(config_path))
        if path.exists() and "&" in (text := text_of(path)):
            check_aliases(yaml.compose(text, Loader=yaml.SafeLoader), str(path))
        return load(source, config_path)

    return judged


def one_line(error: BaseException) -> str:
    """A message of Hydra's or omegaconf's without its line breaks, and without the node that it was found in."""
    if isinstance(error, RecursionError):
        return "the configuration nests without end; does a preset name itself?"
    texts = [str(part) for part in (error, error.__cause__) if part is not None and str(part)]
    lines = [line.strip() for text in texts for line in text.splitlines()]
    return " ".join(line for line in lines if line and not line.startswith(("full_key:", "object_type=", "See https")))


def _reporting(function: Callable[[], Any]) -> Any:
    try:
        return function()
    except (HydraException, OmegaConfBaseException) as error:
        raise ConfigError(one_line(error)) from error


def _unreadable(error: OverrideParseException) -> str:
    key, sign, value = error.override.partition("=")
    if not sign:
        return f"{error.override!r} is no override; write group=choice or group.key=value"
    return f"{error.override!r} cannot be read as key=value; quote what is special in it: '{key}=\"{value}\"'"


def _meant(word: str, known: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, known, 1)
    shown = ", ".join(known if len(known) < 40 else [name for name in known if "." not in name])
    return f"did you mean {close[0]}?" if close else f"known: {shown}"


def _last(error: MissingConfigException) -> str:
    return (error.missing_cfg_file or "").rpartition("/")[2]


def _keys(config: DictConfig) -> Iterator[str]:
    """Dotted names of everything that may be overridden, Hydra's own left out."""

    def below(node: Any, prefix: str) -> Iterator[str]:
        for name, value in node.items() if isinstance(node, dict) else ():
            yield f"{prefix}{name}"
            yield from below(value, f"{prefix}{name}.")

    content = OmegaConf.to_container(config, resolve=False)
    return (name for name in below(content, "") if not name.startswith("hydra.run"))


def check(config: DictConfig) -> None:
    """Refuse what of Hydra's node would act.

    Raises:
        ConfigError: naming the key.
    """
    folder = output_folder(config.output_dir)
    for key, wanted in {**FIXED, "sweep.dir": folder}.items():
        found = OmegaConf.select(config.hydra, key)
        if (found or None) != (wanted or None):
            raise ConfigError(
                f"hydra.{key} is {found!r}; it stays {wanted!r}: configurations run no code, and what "
                "is written lies below output_dir"
            )
    for key, value in _leaves(OmegaConf.to_container(config.hydra, resolve=False), ""):
        if key.rpartition(".")[2] in ("_target_", "()") and key not in PLUGINS:
            raise ConfigError(f"hydra.{key} is {value!r}; nothing is built there")
    for part in ("job_logging", "hydra_logging"):
        try:
            _check_logging(part, OmegaConf.to_container(config.hydra[part], resolve=True))
        except OmegaConfBaseException as error:
            raise ConfigError(f"hydra.{part}: {one_line(error)}; messages go to the terminal") from error


def _check_logging(part: str, logging: Any) -> None:
    for key, value in _leaves(logging, ""):
        name = key.rpartition(".")[2]
        if key.startswith("handlers.") and name not in HANDLER_KEYS:
            raise ConfigError(f"hydra.{part}.{key} is {value!r}; of handlers there are {', '.join(HANDLER_KEYS)}")
        if name == "class" and not (key.startswith("handlers.") and value in HANDLERS):
            raise ConfigError(f"hydra.{part}.{key} is {value!r}; messages go to the terminal: {', '.join(HANDLERS)}")
        if isinstance(value, str) and value.startswith("ext:") and value not in STREAMS:
            raise ConfigError(f"hydra.{part}.{key} is {value!r}; expected {' or '.join(STREAMS)}")


def _leaves(node: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    if isinstance(node, Mapping):
        for name, value in node.items():
            yield from _leaves(value, f"{prefix}.{name}".lstrip("."))
    elif isinstance(node, (list, tuple)):
        for position, value in enumerate(node):
            yield from _leaves(value, f"{prefix}.{position}")
    else:
        yield prefix, node


def _sweep_of(config: DictConfig, overrides: Sequence[str]) -> list[Override]:
    """What a multirun ranges over: its file's parameters, and the command's on top."""
    params = OmegaConf.select(config.hydra, "sweeper.params") or {}
    lines = [*(f"{name}={value}" for name, value in params.items()), *overrides]
    try:
        parsed = OverridesParser.create().parse_overrides(lines)
    except OverrideParseException as error:
        raise ConfigError(_unreadable(error)) from error
    return list({override.key_or_group: override for override in parsed}.values())


def check_sweep(config: DictConfig, overrides: Sequence[str]) -> None:
    """Count the cells of a multirun without making any.

    Raises:
        ConfigError: if they are too many, or do not share their output folder.
    """
    parsed = _sweep_of(config, overrides)
    counts = {override.key_or_group: _count(override) for override in parsed if override.is_sweep_override()}
    if "output_dir" in counts:
        raise ConfigError("output_dir: the runs of a sweep share one output folder; give one")
    if empty := [name for name, count in counts.items() if not count]:
        raise ConfigError(f"{empty[0]}: ranges over nothing, so that the sweep has no runs")
    if (cells := math.prod(counts.values())) > MOST_CELLS:
        over = " x ".join(f"{count:,} {name}" for name, count in counts.items())
        raise ConfigError(
            f"a sweep of {cells:,} runs ({over}); at most {MOST_CELLS:,} are taken: split it, or ask for fewer"
        )


def _count(override: Override) -> int:
    """How many values a sweep over one key has, without making them."""
    sweep = override.value()
    if isinstance(sweep, RangeSweep):
        start, stop, step = (float(value or 0) for value in (sweep.start, sweep.stop, sweep.step))
        return max(0, math.ceil((stop - start) / step)) if step else 0
    return len(sweep.list) if isinstance(sweep, ChoiceSweep) else 1
