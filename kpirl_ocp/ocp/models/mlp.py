"""A multilayer perceptron in the CasADi graph, with derivatives arranged by hand.

    h_0 = x,   a_l = W_l h_{l-1} + b_l,   h_l = sigma_l(a_l),   y = h_L

Everything stays MX: expanded to scalars, a network of this kind is hundreds of thousands of instructions. AD would
transpose constant weights at every call; here W and W^T are both constants and a Jacobian is one chain of matrix
products. Hessians are in `kpirl_ocp.ocp.models.mlp_hessian`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from kpirl_ocp.errors import ProblemError
from kpirl_ocp.ocp.models.activations import ACTIVATIONS, SCALES, SECOND_OF_VALUE, Slopes
from kpirl_ocp.ocp.problem.columns import smallest_by_column
from kpirl_ocp.types import Array

_TINY = np.finfo(float).tiny
# A change of a Jacobian, relative to the terms that bound it, that is negligible: certificates flag no smaller one.
_GENTLE = 1e-3


def stacked(inputs: Sequence[ca.MX], sizes: Sequence[int]) -> ca.MX:
    """x = (x_1, ..., x_k) (n, B) of a network whose k inputs have these lengths.

    inputs: x_1, ..., x_k; or x itself; or, if k is 1, any parts of it.

    Raises ProblemError for what are no CasADi columns, and for other lengths.
    """
    for x in inputs:
        if not isinstance(x, ca.MX | ca.SX | ca.DM):
            raise ProblemError(f"a network takes columns of CasADi, got {type(x).__name__}; casadi.DM(x) makes one.")
    lengths = tuple(x.size1() for x in inputs)
    if sum(lengths) != sum(sizes) or (len(lengths) > 1 and len(sizes) > 1 and lengths != tuple(sizes)):
        expected = f"an input of length {sizes[0]}" if len(sizes) == 1 else f"inputs of lengths {tuple(sizes)}"
        raise ProblemError(f"the network takes {expected}, got lengths {lengths}.")
    return ca.vertcat(*inputs)


@dataclass(frozen=True, eq=False, repr=False)
class MLP:
    """Weights and activations, as plain data.

    weights: one (n_l, n_{l-1}) per layer. biases: one (n_l,) per layer.
    activations: one name per layer, of `ACTIVATIONS`; the last is usually "identity".

    Raises ProblemError when shapes do not chain, numbers are not finite, or a name is unknown.
    """

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    activations: tuple[str, ...]

    def __post_init__(self) -> None:
        for name in ("weights", "biases"):
            arrays = tuple(np.array(array, float) for array in getattr(self, name))
            for array in arrays:
                array.flags.writeable = False
            object.__setattr__(self, name, arrays)
        object.__setattr__(self, "activations", tuple(self.activations))
        self._check()

    def __repr__(self) -> str:
        widths = (self.n_in, *map(len, self.biases))
        return f"<MLP {' -> '.join(map(str, widths))}, {', '.join(self.activations)}>"

    @classmethod
    def from_layers(
        cls,
        weights: Sequence[ArrayLike],
        biases: Sequence[ArrayLike],
        activation: str = "relu",
        output_activation: str = "identity",
    ) -> MLP:
        """One activation for all hidden layers; arrays of any kind that numpy reads (n_out, n_in), as in torch."""
        names = (activation,) * (len(weights) - 1) + (output_activation,)
        return cls(tuple(map(np.asarray, weights)), tuple(map(np.asarray, biases)), names)

    @property
    def n_in(self) -> int:
        """Length of x."""
        return self.weights[0].shape[1]

    @property
    def n_out(self) -> int:
        """Length of y."""
        return self.weights[-1].shape[0]

    def normalised(self, mean_in: ArrayLike, scale_in: ArrayLike, mean_out: ArrayLike, scale_out: ArrayLike) -> MLP:
        """The network mean_out + scale_out * MLP((x - mean_in) / scale_in), folded into its first and last layer.

        Args:
            mean_in, scale_in: (n_in,).
            mean_out, scale_out: (n_out,).

        Raises:
            ProblemError: an output activation, after which nothing can be folded; scales that are not positive; or
                another shape.
        """
        if self.activations[-1] != "identity":
            raise ProblemError(f"a normalised network needs a linear last layer, not {self.activations[-1]!r}.")
        centre, width = _vector("mean_in", mean_in, self.n_in), _vector("scale_in", scale_in, self.n_in)
        shift, gain = _vector("mean_out", mean_out, self.n_out), _vector("scale_out", scale_out, self.n_out)
        if not (width > 0).all() or not (gain > 0).all():
            raise ProblemError("scale_in and scale_out must be positive.")
        weights, biases = list(self.weights), list(self.biases)
        weights[0] = weights[0] / width
        biases[0] = biases[0] - weights[0] @ centre
        weights[-1] = gain[:, None] * weights[-1]
        biases[-1] = gain * biases[-1] + shift
        return replace(self, weights=tuple(weights), biases=tuple(biases))

    def __call__(self, *inputs: ca.MX) -> ca.MX:
        """y (n_out, B) of x (n_in, B), one column per point; several inputs are the parts of x, below one another.

        Raises ProblemError for what are no CasADi columns, and when their lengths do not add up to n_in.
        """
        return self.linearise(stacked(inputs, (self.n_in,)))[0]

    def linearise(self, x: ca.MX, drive: ca.MX | None = None) -> tuple[ca.MX, list[Slopes]]:
        """y (n_out, B) of x (n_in, B), and the slopes on the way.

        drive: (n_1, B) takes the place of b_1; inputs whose share of a_1 is known beforehand go in there.
        """
        slopes: list[Slopes] = []
        for weight, bias, name in zip(self.weights, self.biases, self.activations, strict=True):
            shift = ca.repmat(ca.DM(bias), 1, x.size2()) if drive is None or slopes else drive
            x, slope = ACTIVATIONS[name](ca.mac(ca.DM(weight), x, shift))
            slopes.append(slope)
        return x, slopes

    def _check(self) -> None:
        if not len(self.weights) == len(self.biases) == len(self.activations) >= 1:
            raise ProblemError(
                "a network needs one weight, bias and activation per layer, and a layer; got "
                f"{len(self.weights)}, {len(self.biases)} and {len(self.activations)}."
            )
        width = self.weights[0].shape[-1] if self.weights[0].ndim else 0
        for index, (weight, bias, name) in enumerate(zip(self.weights, self.biases, self.activations, strict=True)):
            if weight.ndim != 2 or weight.shape[1] != width or bias.shape != weight.shape[:1] or not weight.size:
                raise ProblemError(
                    f"layer {index} must have a weight (n, {width}) and a bias (n,), "
                    f"got {weight.shape} and {bias.shape}."
                )
            if not np.isfinite(weight).all() or not np.isfinite(bias).all():
                raise ProblemError(f"layer {index} holds NaN or infinity.")
            if name not in ACTIVATIONS:
                raise ProblemError(f"layer {index}: activation must be one of {', '.join(ACTIVATIONS)}; got {name!r}.")
            width = weight.shape[0]


def jvp(mlp: MLP, slopes: Sequence[Slopes], dx: ca.MX, drive: ca.MX | None = None) -> tuple[ca.MX, list[ca.MX]]:
    """J dx (n_out, B) for dx (n_in, B), and the tangents da_l on the way; `drive` (n_1, B) is added to da_1."""
    tangents: list[ca.MX] = []
    for weight, slope in zip(mlp.weights, slopes, strict=True):
        tangents.append(ca.DM(weight) @ dx if drive is None or tangents else ca.mac(ca.DM(weight), dx, drive))
        dx = times(slope.first, tangents[-1])
    return dx, tangents


def vjp(mlp: MLP, slopes: Sequence[Slopes], adjoint: ca.MX) -> tuple[ca.MX, ca.MX, list[Slopes]]:
    """J^T adjoint (n_in, B) for adjoint (n_out, B), and the adjoint (n_1, B) of a_1 on the way.

    The third is what `vjp_tangent` takes: the slopes, sigma'' times the adjoint of h_l in the place of sigma''.
    """
    inner, bent = adjoint, []
    for weight, slope in zip(reversed(mlp.weights), reversed(slopes), strict=True):
        bent.append(Slopes(slope.first, None if slope.second is None else slope.second * adjoint))
        inner = times(slope.first, adjoint)
        adjoint = ca.DM(weight.T) @ inner
    return adjoint, inner, bent[::-1]


def vjp_tangent(mlp: MLP, bent: Sequence[Slopes], tangents: Sequence[ca.MX], dadjoint: ca.MX) -> tuple[ca.MX, ca.MX]:
    """The changes of the first two results of `vjp` along dx and dadjoint.

    The first is J^T dadjoint + (adjoint . f)'' dx. Without curvature, J^T dadjoint is left.

    Args:
        bent: from `vjp`.
        tangents: da_l from `jvp` along dx.
        dadjoint: (n_out, B).
    """
    inner = dadjoint
    for weight, slope, tangent in zip(reversed(mlp.weights), reversed(bent), reversed(tangents), strict=True):
        inner = times(slope.first, dadjoint)
        if slope.second is not None:
            inner = inner + slope.second * tangent
        dadjoint = ca.DM(weight.T) @ inner
    return dadjoint, inner


def jacobian(mlp: MLP, slopes: Sequence[Slopes]) -> ca.MX:
    """dy/dx (n_out, n_in) at one x, from the output's side: J^T = W_1^T diag(s_1) W_2^T ... W_L^T diag(s_L)."""
    columns = ca.DM.eye(mlp.n_out)
    for weight, slope in zip(reversed(mlp.weights), reversed(slopes), strict=True):
        columns = ca.DM(weight.T) @ scale_rows(slope.first, columns)
    return columns.T


def kinked(slopes: Sequence[Slopes]) -> list[ca.MX]:
    """The arguments (n_l, B) of the activations with a kink at zero, layer by layer."""
    return [slope.kink for slope in slopes if slope.kink is not None]


def clearance(mlp: MLP, moves: ca.MX, nearest: ca.MX) -> ca.MX:
    """The largest share (1, B) of moves (n_in, B) of the inputs that changes the Jacobian by no more than a thousandth.

    A change dx of the input moves no argument by more than

        |da_1| <= |W_1| |dx|,    |da_l| <= |W_l| L_{l-1} |da_{l-1}|,

    which has to leave each on its side of a kink, and sum_l c_l max |da_l| <= 1e-3: the Jacobian changes by at most
    that, relative to the product of |W_l| and L_l that bounds it, one layer's share of a second derivative by twice.

    Args:
        mlp: with scales L and c of its activations, `SCALES`.
        moves: absolute values.
        nearest: (n, B) the smallest absolute values that `kinked` takes, below one another.
    """
    kinked_moves, bend = [ca.MX(0, moves.size2())], ca.MX.zeros(1, moves.size2())
    for weight, name in zip(mlp.weights, mlp.activations, strict=True):
        largest_slope, scale = SCALES[name]
        moves = ca.DM(np.abs(weight)) @ moves
        kinked_moves += [moves] if has_kink(name) else []
        bend += scale * -smallest_by_column(-moves)
        moves = largest_slope * moves
    bounds = ca.vertcat(_GENTLE / (bend + _TINY), nearest / (ca.vertcat(*kinked_moves) + _TINY))
    return smallest_by_column(bounds)


def has_kink(name: str) -> bool:
    """True if sigma' or sigma'' jumps anywhere."""
    return ACTIVATIONS[name](ca.MX.sym("a"))[1].kink is not None


def has_curvature(slopes: Sequence[Slopes]) -> bool:
    """True if any layer has a second derivative."""
    return any(slope.second is not None for slope in slopes)


def flatten_slopes(slopes: Sequence[Slopes]) -> list[ca.MX]:
    """The slopes as a plain list, to be kept for later, first derivatives first; `unflatten_slopes` is its inverse."""
    parts = [*(slope.first for slope in slopes), *(slope.second for slope in slopes)]
    return [part for part in parts if part is not None]


def unflatten_slopes(mlp: MLP, kept: Sequence[ca.MX]) -> list[Slopes]:
    """The slopes that `flatten_slopes` listed, without second derivatives where only the first are given."""
    parts, patterns = iter(kept), [ACTIVATIONS[name](ca.MX.sym("a"))[1] for name in mlp.activations]
    first = [None if pattern.first is None else next(parts) for pattern in patterns]
    second = [None if pattern.second is None else next(parts, None) for pattern in patterns]
    return list(map(Slopes, first, second))


def condensed(slopes: Sequence[Slopes]) -> list[Slopes]:
    """The slopes with values in the place of second derivatives that follow from them; undone by `expanded`."""
    return [slope if slope.value is None else replace(slope, second=slope.value) for slope in slopes]


def expanded(mlp: MLP, slopes: Sequence[Slopes]) -> list[Slopes]:
    """The slopes of what `condensed` gave."""
    return [
        replace(slope, second=SECOND_OF_VALUE[name](slope.second, slope.first)) if name in SECOND_OF_VALUE else slope
        for slope, name in zip(slopes, mlp.activations, strict=True)
    ]


def times(factor: ca.MX | None, x: ca.MX) -> ca.MX:
    """The product element by element; None counts as ones."""
    return x if factor is None else factor * x


def scale_rows(factor: ca.MX | None, matrix: ca.MX) -> ca.MX:
    """diag(factor) matrix; None counts as ones."""
    return matrix if factor is None else ca.repmat(factor, 1, matrix.size2()) * matrix


def _vector(name: str, value: ArrayLike, length: int) -> Array:
    array = np.asarray(value, float)
    if array.shape != (length,) or not np.isfinite(array).all():
        raise ProblemError(f"{name} must be {length} finite numbers, got shape {array.shape}.")
    return array
