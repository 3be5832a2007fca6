"""MuJoCo models in MJCF: found by name or path, judged before they are read, and kept as one text that stands alone.

Nothing in a model is executed. What it includes and which meshes it names must lie in its own folder.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from dadiff.errors import ConfigError, DataError, MissingExtraError
from dadiff.outside import regular, text_of
from dadiff.systems.system import Bounds

if TYPE_CHECKING:
    from mujoco import MjModel, MjSpec

INSTALL = "install it with: pip install 'dadiff[mujoco]'"
MOST_FILE = 256 * 2**20
"""Bytes of a mesh or texture."""

SUFFIX = ".xml"
FOLDERS = ("meshdir", "texturedir", "assetdir")
SLIDE, HINGE = 2, 3  # of mjtJoint
KINDS = {SLIDE: ("m", "m/s"), HINGE: ("rad", "rad/s")}  # units of position and velocity
LONG = (3, 5)  # of mjtGeom: capsules and cylinders


@dataclass(frozen=True)
class Mjcf:
    """A model as text, and all that it refers to.

    Args:
        text: MJCF.
        files: name in the text -> bytes of what is included, and of meshes, as uint8 arrays.
        joints: those that move, by name; the others become rigid where they stand. None stands for all.
    """

    text: str = field(repr=False)
    files: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)
    joints: Sequence[str] = ()

    def compiled(self) -> MjModel:
        """The model.

        Raises:
            ConfigError: if it has no such joints.
            DataError: if it names files that are not stored with it, or MuJoCo refuses it.
            MissingExtraError: if mujoco is not installed.
        """
        package, files = mujoco(), {name: content.tobytes() for name, content in self.files.items()}
        self._check_complete(files)
        spec = _told(package.MjSpec.from_string, self.text, include=files, assets=files)
        self._hold(spec)
        model = _told(spec.compile)
        model.opt.disableflags |= int(package.mjtDisableBit.mjDSBL_AUTORESET)  # what diverges shall be seen
        return model

    def _check_complete(self, files: Mapping[str, bytes]) -> None:
        """Nothing may be looked for on the disk."""
        texts = [self.text, *(content.decode("utf-8", "replace") for name, content in files.items() if _is_text(name))]
        roots = [_parsed(text, "system: the model") for text in texts]
        named = {name for root in roots for name in (*_named_files(root), *_named_includes(root))}
        if missing := sorted(n for n in named if not any(file == n or file.endswith(f"/{n}") for file in files)):
            raise DataError(f"system: the model names {', '.join(missing)[:200]}, which is not stored with it")

    def _hold(self, spec: MjSpec) -> None:
        """Delete all joints but those that move."""
        there = [joint.name for joint in spec.joints]
        if unknown := [name for name in self.joints if name not in there]:
            raise ConfigError(f"system: there is no joint {', '.join(unknown)}; the model has {', '.join(there)}")
        for name in there if self.joints else []:
            if name not in self.joints:
                spec.delete(spec.joint(name))


def _is_text(name: str) -> bool:
    return name.endswith(SUFFIX)


def mujoco() -> ModuleType:
    """The package, which writes no log file into the current folder.

    Raises:
        MissingExtraError: if it is not installed.
    """
    try:
        import mujoco as package
    except ImportError as error:
        raise MissingExtraError(f"system mujoco: mujoco is not installed; {INSTALL}") from error
    package.set_mju_user_warning(_unheard)
    return package


def _unheard(message: str) -> None:
    """Warnings are of diverging states, which give nan, or of words that will change."""


def located(path: str) -> Path:
    """The MJCF file of a model of gymnasium's wheel, such as "reacher", or the file at a path ending in .xml.

    Raises:
        ConfigError: if there is no model of that name.
        DataError: if the file is missing or no plain file.
        MissingExtraError: if gymnasium is not installed.
    """
    if path.endswith(SUFFIX):
        return regular(Path(path))
    found = importlib.util.find_spec("gymnasium")
    if found is None or not found.submodule_search_locations:
        raise MissingExtraError(f"system mujoco: gymnasium, which holds the model {path}, is not installed; {INSTALL}")
    folder = Path(found.submodule_search_locations[0]) / "envs" / "mujoco" / "assets"
    models = {file.stem: file for file in sorted(folder.glob(f"*{SUFFIX}"))}
    if path not in models:
        raise ConfigError(
            f"system: there is no model {path!r}; expected a path ending in {SUFFIX}, or one of {', '.join(models)}"
        )
    return models[path]


def files_of(path: str) -> list[Path]:
    """The model's file and all that it refers to.

    Raises:
        DataError: if one is missing, too large, no plain file, or lies outside of the model's folder.
    """
    file = located(path)
    return [file, *_included(file).values(), *_assets(file).values()]


def read(path: str, joints: Sequence[str] = ()) -> Mjcf:
    """A model by name or path, see `located`, and `Mjcf` for its joints.

    Raises:
        DataError: if it cannot be read, see `files_of`.
    """
    file = located(path)
    places = {**_included(file), **_assets(file)}
    files = {name: np.frombuffer(place.read_bytes(), np.uint8) for name, place in places.items()}
    return Mjcf(text_of(file), files, tuple(joints))


def _told(make: Any, *arguments: Any, **options: Any) -> Any:
    """What MuJoCo makes, or its complaint in a line."""
    try:
        return make(*arguments, **options)
    except ValueError as error:
        raise DataError(f"system: MuJoCo cannot read the model ({' '.join(str(error).split())[:300]})") from error


def _parsed(text: str, where: str) -> ElementTree.Element:
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise DataError(f"{where}: declares entities, which a model has no need of; write them out")
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise DataError(f"{where}: is no MJCF ({error})") from error


def _included(file: Path) -> dict[str, Path]:
    """Name -> place of all that is included, also by what is included."""
    found: dict[str, Path] = {}
    waiting = [file]
    while waiting:
        root = _parsed(text_of(waiting[-1]), str(waiting.pop()))
        for name in _named_includes(root):
            if name not in found:
                found[name] = _inside(file.parent, name, file)
                waiting.append(found[name])
    return found


def _assets(file: Path) -> dict[str, Path]:
    """Name -> place of meshes, textures and heights."""
    roots = [_parsed(text_of(part), str(part)) for part in (file, *_included(file).values())]
    folders = [tag.get(name) for root in roots for tag in root.iter("compiler") for name in FOLDERS]
    tried = ["", *(f"{folder.rstrip('/')}/" for folder in folders if folder)]
    found = {}
    for name in (name for root in roots for name in _named_files(root)):
        prefix = next((prefix for prefix in tried if (file.parent / prefix / name).exists()), "")
        found[prefix + name] = _inside(file.parent, prefix + name, file)
    return found


def _named_includes(root: ElementTree.Element) -> Iterator[str]:
    for tag in root.iter("include"):
        yield tag.get("file", "")


def _named_files(root: ElementTree.Element) -> Iterator[str]:
    """Of everything but includes."""
    for tag in root.iter():
        if tag.tag != "include":
            yield from (value for name, value in tag.attrib.items() if name.startswith("file"))


def _inside(folder: Path, name: str, file: Path) -> Path:
    """The place of a plain file in the model's folder, links resolved."""
    place = (folder / name).resolve()
    if not place.is_relative_to(folder.resolve()):
        raise DataError(f"{file}: names {name}, which lies outside of the model's folder; put it there")
    if (size := regular(place).stat().st_size) > MOST_FILE:
        raise DataError(f"{place}: has {size:,} bytes; at most {MOST_FILE:,} are read")
    return place


def described(model: MjModel) -> dict[str, tuple[str, ...]]:
    """Names and units of x = [positions; velocities; activations] and u, as a `System` takes them.

    Raises:
        ConfigError: if a joint is neither hinge nor slide, the model has no inputs, or keeps a state of other kinds.
    """
    names = [_name(model, "joint", k) for k in range(model.njnt)]
    for name, kind in zip(names, model.jnt_type.tolist(), strict=True):
        if kind not in KINDS:
            raise ConfigError(
                f"system: joint {name} of the model is free or a ball, whose position is no vector; only hinges and "
                "slides are taken, name those that shall move in system.joints"
            )
    kept = mujoco().mj_stateSize(model, mujoco().mjtState.mjSTATE_FULLPHYSICS)
    if kept != 1 + model.nq + model.nv + model.na or not model.nu or not model.nq:
        raise ConfigError(
            "system: a model needs joints and actuators, and plugins with a state of their own are not taken"
        )
    units = [KINDS[kind] for kind in model.jnt_type.tolist()]
    acting = [_name(model, "actuator", k) for k in range(model.nu)]
    return {
        "state_names": (*names, *(f"{name} velocity" for name in names), *(f"activation {k}" for k in range(model.na))),
        "state_units": (*(x for x, _ in units), *(v for _, v in units), *("" for _ in range(model.na))),
        "input_names": tuple(acting),
    }


def _name(model: MjModel, kind: str, k: int) -> str:
    """Of a joint or an actuator; an actuator without one is called after what it moves."""
    given = getattr(model, kind)(k).name
    if given or kind == "joint":
        return given or f"joint {k}"
    moved = int(model.actuator_trnid[k, 0])
    return f"motor of {_name(model, 'joint', moved)}" if 0 <= moved < model.njnt else f"actuator {k}"


def bounds_of(model: MjModel) -> Bounds:
    """Ranges of joints and controls, where the model limits them."""
    infinite = np.full((model.nv + model.na, 2), [-np.inf, np.inf])
    joints = np.where(model.jnt_limited[:, None].astype(bool), model.jnt_range, [-np.inf, np.inf])
    states = np.concatenate([joints, infinite])
    inputs = np.where(model.actuator_ctrllimited[:, None].astype(bool), model.actuator_ctrlrange, [-np.inf, np.inf])
    return Bounds(inputs[:, 0], inputs[:, 1], states[:, 0], states[:, 1])
