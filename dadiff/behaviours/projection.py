"""`Projection`: the opaque map tau -> tau that a sampler repeats.

A set knows how to project in two metrics: the identity in the coordinates that it was bound in, and a covariance C.
Each gives a `Form`, made once for all plans; the pins' values, which differ from plan to plan, enter at the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, Protocol
from weakref import WeakKeyDictionary

import numpy as np

from dadiff.behaviours.pins import Pinned
from dadiff.errors import ShapeError
from dadiff.trajectory.arrays import Array, like
from dadiff.trajectory.covariance import Covariance

Kind = Literal["dense", "blocks", "manifold", "limited"]

KEPT = 64  # metrics that a projection holds converted, the oldest given up first


@dataclass(frozen=True)
class ProjectionInfo:
    """What can be said of a projection.

    Args:
        rank: degrees of freedom that are left.
        kind: `dense` matrices, a recursion over `blocks` in O(T), sweeps of it along a
            `manifold`, or Newton steps within bounds and clear of discs, `limited`.
        iterations: of the last call; 1 for a closed form.
        residual: how far the last call's result is from the set, 0 where that is rounding.
        unconverged: plans of the last call that did not reach the set.
        infeasible: those among them for which it is proven that the set holds none.
    """

    rank: int
    kind: Kind
    iterations: int = 1
    residual: float = 0.0
    unconverged: int = 0
    infeasible: int = 0


class Form(Protocol):
    """A projection in one metric, for all values of the pins."""

    def given(self, values: np.ndarray) -> np.ndarray:
        """What follows from the pins' values (*robots, plans, k), computed once."""
        ...

    def __call__(self, z: Array, given: Array, noise: Array | None = None) -> Array:
        """Project z (*robots, plans, d); `noise` of that shape stands for the spread of a residual that has one."""
        ...


@dataclass(frozen=True)
class AffineMap:
    """z -> matrix z + centre + lift values + spread eps, or basis basis' z + ... where the matrix is orthogonal.

    Args:
        matrix: (*robots, d, d), or a basis (*robots, d, r).
        centre: (*robots, d).
        lift: (*robots, d, k).
        orthogonal: whether `matrix` is an orthonormal basis of what is projected onto.
        spread: (*robots, d, q), by which the residual's unit noise moves z; None where the residual has none.
    """

    matrix: np.ndarray = field(repr=False)
    centre: np.ndarray = field(repr=False)
    lift: np.ndarray = field(repr=False)
    orthogonal: bool = True
    spread: np.ndarray | None = field(default=None, repr=False)

    def given(self, values: np.ndarray) -> np.ndarray:
        """The offset of each plan, (*robots, plans, d)."""
        return self.centre[..., None, :] + values @ self.lift.swapaxes(-1, -2)

    def __call__(self, z: Array, given: Array, noise: Array | None = None) -> Array:
        """Project z (*robots, plans, d): all plans of a robot in one product."""
        coefficients = z @ self.matrix if self.orthogonal else z
        image = coefficients @ self.matrix.swapaxes(-1, -2) + given
        if self.spread is None or noise is None:
            return image
        return image + noise[..., : self.spread.shape[-1]] @ self.spread.swapaxes(-1, -2)


class Geometry:
    """A set in its coordinates, with the places of its pins: a form for each metric, made when it is first asked for.

    Args:
        rank, kind: see `ProjectionInfo`.
        plain: makes the form in the identity metric.
        weighted: makes the form in the metric C.
    """

    def __init__(
        self, rank: int, kind: Kind, plain: Callable[[], Form], weighted: Callable[[Covariance], Form]
    ) -> None:
        self.rank, self.kind = rank, kind
        self._plain, self._weighted = plain, weighted
        self._identity: Form | None = None
        self._forms: WeakKeyDictionary[Covariance, Form] = WeakKeyDictionary()
        self._converted: dict[object, tuple[Form, Form]] = {}

    def form(self, metric: Covariance | None = None) -> Form:
        """The form in a metric; None stands for the identity."""
        if metric is None:
            if self._identity is None:
                self._identity = self._plain()
            return self._identity
        if metric not in self._forms:
            self._forms[metric] = self._weighted(metric)
        return self._forms[metric]

    def converted(self, form: Form, tau: Array) -> Form:
        """A form of this set as arrays of tau's kind, converted once for each kind and not for each binding."""
        if isinstance(tau, np.ndarray):
            return form
        kind = (id(form), tau.dtype, tau.device)
        if kind not in self._converted:
            if len(self._converted) == KEPT:
                del self._converted[next(iter(self._converted))]
            self._converted[kind] = (like(form, tau), form)  # beside its copy, so that its id is not another's
        return self._converted[kind][0]


def check_shape(tau: Array, shape: tuple[int, ...]) -> None:
    """Raise `ShapeError` unless tau is (*robots, ..., d) for a shape (*robots, d)."""
    *robots, d = shape
    if (*tau.shape[: len(robots)], tau.shape[-1]) != shape or tau.ndim <= len(robots):
        raise ShapeError(
            f"projection: made for trajectories of shape {(*robots, '...', d)} (robots first), found "
            f"{tuple(tau.shape)}; build the projector from these robots' systems or recordings"
        )


class Projection:
    """A set bound to coordinates and to the pins of its plans. Numpy arrays give numpy arrays, tensors give tensors.

    Args:
        geometry: what does not depend on the pins' values.
        shape: (*robots, d).
        pinned: places and values.
    """

    def __init__(self, geometry: Geometry, shape: tuple[int, ...], pinned: Pinned) -> None:
        self._geometry, self._shape, self._pinned = geometry, shape, pinned
        self._given: dict[object, tuple[Array, Form]] = {}
        self.info = ProjectionInfo(geometry.rank, geometry.kind)

    def __call__(
        self,
        tau: Array,
        metric: Covariance | None = None,
        start: Array | None = None,
        noise: Array | None = None,
    ) -> Array:
        """The projection of tau.

        Args:
            tau: (*robots, plans..., d), in the coordinates that the set was bound in.
            metric: C in those coordinates, one for all plans or (*robots, plans..., d) with one for each; the
                correction is then C G' (G C G' + R)^-1 (G tau - g). None is the identity. What follows from a C that
                plans share is computed once for the object.
            start: where to begin; a closed form needs none.
            noise: unit noise of the shape of tau, from which an uncertain set draws its residual r ~ N(0, R): with tau
                drawn from N(tau0_hat, C) the projection is then a draw of the conditional law (Matheron's rule).

        Raises:
            ShapeError: if tau does not fit the robots.
        """
        check_shape(tau, self._shape)
        *robots, d = self._shape
        if self._geometry.kind == "blocks" and not isinstance(tau, np.ndarray) and tau.device.type == "cpu":
            # Many small products, which numpy starts faster.
            drawn = None if noise is None else noise.numpy()
            return tau.new_tensor(self(tau.numpy(), metric, start, drawn))
        if metric is not None and metric.diagonal.ndim > len(robots) + 1:
            return self._plan_by_plan(tau, metric)
        form, given = self._bound(self._geometry.form(metric), tau)
        drawn = None if noise is None else noise.reshape(*robots, -1, d)
        return form(tau.reshape(*robots, -1, d), given, drawn).reshape(tau.shape)

    def _plan_by_plan(self, tau: Array, metric: Covariance) -> Array:
        """The projection with a metric (*robots, plans..., d) for each plan, which is used once."""
        *robots, d = self._shape
        diagonal = metric.diagonal.reshape(*robots, -1, d)
        each = Covariance(diagonal, metric.factor.reshape(*diagonal.shape, metric.factor.shape[-1]))
        made = self._geometry.form(each)
        form, given = like(made, tau), like(made.given(self._pinned.values[..., None, :]), tau)
        return form(tau.reshape(*robots, -1, 1, d), given).reshape(tau.shape)

    def on(self, device: str) -> Projection:
        """Itself, with what projects float64 tensors in the identity metric on a device."""
        import torch

        self._bound(self._geometry.form(), torch.zeros(0, dtype=torch.float64, device=device))
        return self

    @property
    def affine(self) -> bool:
        """False where 0 lies in the set, for every plan."""
        plans = max(1, self._pinned.values.shape[-2])
        zero = np.zeros((*self._shape[:-1], plans, self._shape[-1]))
        return bool(np.any(self(zero)))

    def _bound(self, form: Form, tau: Array) -> tuple[Form, Array]:
        """The form with what follows from the pins, as arrays of tau's kind; converted once for each kind."""
        converted = self._geometry.converted(form, tau)
        if id(converted) not in self._given:
            if len(self._given) == KEPT:
                del self._given[next(iter(self._given))]
            self._given[id(converted)] = (like(form.given(self._pinned.values), tau), converted)
        return converted, self._given[id(converted)][0]
