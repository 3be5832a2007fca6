"""Pictures of robots in MuJoCo: rendered without a screen where EGL or OSMesa is there, and as lines for matplotlib."""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from dadiff.systems import mjcf

if TYPE_CHECKING:
    from mujoco import MjData, MjModel

SIZE = 320
"""Pixels, width and height."""

MISSING = (ImportError, AttributeError, OSError, RuntimeError)
"""What PyOpenGL and MuJoCo raise where a library, a driver or a device is not there."""

WORLD = "xyz"


def plane_of(model: MjModel) -> tuple[int, int]:
    """The two axes of the world that a planar robot moves in: across its first hinge, x and z without one."""
    hinges = np.flatnonzero(model.jnt_type == mjcf.HINGE)
    if not len(hinges):
        return 0, 2
    across = int(np.abs(model.jnt_axis[hinges[0]]).argmax())
    first, second = (k for k in range(3) if k != across)
    return first, second


def outline(model: MjModel, states: np.ndarray) -> np.ndarray:
    """A line through the ends of all that moves, (N, k, 2) in metres, of states (N, n)."""
    data, plane = mjcf.mujoco().MjData(model), list(plane_of(model))
    return np.array([_line(model, _placed(model, data, x)) for x in states])[..., plane]


def _placed(model: MjModel, data: MjData, x: np.ndarray) -> MjData:
    data.qpos[:] = x[: model.nq]
    mjcf.mujoco().mj_kinematics(model, data)
    return data


def _line(model: MjModel, data: MjData) -> np.ndarray:
    """(k, 3): both ends of what is long, those nearer to their body's origin first, and the middle of what is round."""
    points = []
    for geom in np.flatnonzero(model.body_weldid[model.geom_bodyid] != 0).tolist():
        half = data.geom_xmat[geom].reshape(3, 3)[:, 2] * model.geom_size[geom, 1]
        outward = np.sign(_axis(model, geom) @ model.geom_pos[geom]) or 1.0
        ends = (-outward * half, outward * half) if model.geom_type[geom] in mjcf.LONG else (0.0,)
        points += [data.geom_xpos[geom] + end for end in ends]
    return np.array(points)


def _axis(model: MjModel, geom: int) -> np.ndarray:
    """Along a geom, as seen from its body, (3,)."""
    turned = np.empty(9)
    mjcf.mujoco().mju_quat2Mat(turned, model.geom_quat[geom])
    return turned.reshape(3, 3)[:, 2]


def frames(model: MjModel, states: np.ndarray) -> np.ndarray | None:
    """Pictures (N, SIZE, SIZE, 3) of states (N, n), uint8; None where there is nothing to render with."""
    with _context() as context:
        return None if context is None else _rendered(model, states)


@contextmanager
def _context() -> Iterator[Any]:
    """A place to draw in that needs no screen, or None."""
    kind = "osmesa" if os.environ.get("MUJOCO_GL") == "osmesa" else "egl"
    try:
        context = importlib.import_module(f"mujoco.{kind}").GLContext(SIZE, SIZE)
        context.make_current()
    except MISSING:
        yield None
        return
    try:
        yield context
    finally:
        context.free()


def _rendered(model: MjModel, states: np.ndarray) -> np.ndarray:
    package = mjcf.mujoco()
    scene, options, camera = package.MjvScene(model, 1000), package.MjvOption(), package.MjvCamera()
    package.mjv_defaultFreeCamera(model, camera)
    camera.azimuth, camera.elevation = (90, -10) if plane_of(model) == (0, 2) else (90, -80)
    drawing = package.MjrContext(model, package.mjtFontScale.mjFONTSCALE_100)
    package.mjr_setBuffer(package.mjtFramebuffer.mjFB_OFFSCREEN, drawing)
    view, data = package.MjrRect(0, 0, SIZE, SIZE), package.MjData(model)
    pictures = np.empty((len(states), SIZE, SIZE, 3), np.uint8)
    for picture, x in zip(pictures, states, strict=True):
        data.qpos[:] = x[: model.nq]
        package.mj_forward(model, data)
        every = package.mjtCatBit.mjCAT_ALL
        package.mjv_updateScene(model, data, options, None, camera, every, scene)
        package.mjr_render(view, scene, drawing)
        package.mjr_readPixels(picture, None, view, drawing)
    drawing.free()
    return pictures[:, ::-1]
