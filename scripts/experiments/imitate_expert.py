"""The weights of a cart-pole's expert, learned from its forces through `OCPLayer` by L-BFGS of torch."""

import time
from argparse import Namespace
from dataclasses import dataclass

import casadi as ca
import numpy as np
import torch

from kpirl_ocp import OCP, Riccati
from kpirl_ocp.bridges import OCPLayer
from kpirl_ocp.bridges.torch_layer import Plan, guesses_of
from kpirl_ocp.reporting import kept_if_interrupted, write_metrics

HORIZON, DEMONSTRATIONS = 100, 32
TRUE = (1.0, 2.0, 1.5, 1.0)
LOWER, UPPER = 0.25, 4.0  # what the weights are known to lie between
# Starting guesses of the weights, from the repository ToyotaResearchInstitute/diffmpc.
STARTS = (
    (2.31993711, 2.10973335, 1.27643918, 2.40638906),
    (2.16305628, 0.92978235, 0.8425473, 2.05522213),
    (0.54511473, 2.38979126, 1.82534442, 1.79607804),
    (1.52602309, 0.70958412, 2.28500543, 1.79144837),
    (1.47695067, 2.37700071, 1.10622824, 1.66791643),
    (1.77999985, 2.43335516, 2.13276163, 2.25013024),
    (1.08672352, 1.89562108, 2.44455541, 0.61613992),
    (0.91772376, 0.69279309, 1.3126017, 1.75713809),
    (2.35407733, 2.33764708, 0.71646967, 0.86020509),
    (1.98209716, 1.58648594, 1.59129719, 1.04037999),
    (1.6906858, 1.59305244, 2.1575869, 1.14175977),
    (2.25656044, 1.08790578, 1.8911752, 2.28738797),
    (1.71570255, 1.32924091, 0.6220067, 1.7408397),
    (0.95953363, 1.53826163, 1.24846342, 1.79400116),
    (1.12411295, 0.93086439, 2.40280909, 2.35137107),
    (1.99076212, 1.63976281, 1.6997142, 1.12886317),
    (2.20034932, 0.60009316, 0.79487412, 2.17139842),
    (2.07377772, 1.74829048, 1.48310797, 1.67964389),
    (0.82834224, 1.09670807, 1.86061252, 0.90516967),
    (0.75138763, 1.01916688, 0.80239714, 2.49789644),
)


def cart_pole() -> OCP:
    """State: position [m], its rate, angle from upright [rad], its rate; action: force [N]; psi: state weights."""
    s, u, w = ca.SX.sym("s", 4), ca.SX.sym("u"), ca.SX.sym("w", 4)
    cart, pole, half_length, gravity, step = 1.0, 0.1, 0.5, 9.81, 0.05
    sin, cos = ca.sin(s[2]), ca.cos(s[2])
    push = (u + pole * half_length * s[3] ** 2 * sin) / (cart + pole)
    turn = (gravity * sin - cos * push) / (half_length * (4 / 3 - pole * cos**2 / (cart + pole)))
    slide = push - pole * half_length * turn * cos / (cart + pole)
    return OCP.from_expressions(
        state=s,
        action=u,
        parameters=w,
        horizon=HORIZON,
        dynamics=s + step * ca.vertcat(s[1], slide, s[3], turn),
        stage_cost=ca.dot(w, s**2) + 0.05 * u**2,
        terminal_cost=ca.dot(w, s**2),
    )


def starting_states() -> torch.Tensor:
    """(32, 4), drawn like the published ones."""
    rng = np.random.RandomState(123)
    return torch.tensor(rng.uniform([-0.5, -0.5, -3.14, -1.0], [0.5, 0.5, 3.14, 1.0], (DEMONSTRATIONS, 4)))


def demonstrate(layer: OCPLayer, states: torch.Tensor) -> Plan:
    """The expert's plans, begun at straight lines from the states (32, 4) to the goal, without force.

    Raises SolveError where the layer's policy is to raise it: an expert that is not optimal teaches other weights.
    """
    lines = torch.linspace(1, 0, HORIZON + 1).double()[:, None] * states[:, None]
    with torch.no_grad():
        guesses = guesses_of(torch.zeros(DEMONSTRATIONS, HORIZON, 1), lines)
        return layer(torch.tensor(TRUE).double(), states, guess=guesses)


def weights(free: torch.Tensor) -> torch.Tensor:
    """Between `LOWER` and `UPPER`, so that no line search goes where plans make no sense."""
    return LOWER + (UPPER - LOWER) * torch.sigmoid(free)


@dataclass
class Imitation:
    """Learning of the weights from the expert's plans, begun at `states` (32, 4).

    gradients: how many were taken.
    left_out: how many plans in all of them were not solved, or have a gradient that is not certified.
    """

    layer: OCPLayer
    states: torch.Tensor
    expert: Plan
    gradients: int = 0
    left_out: int = 0

    def loss(self, weights: torch.Tensor) -> torch.Tensor:
        """Mean squared distance from the expert's forces, halved; its gradient is added to the weights'."""
        plan = self.layer(weights, self.states, guess=self.expert)
        loss = 0.5 * (plan.actions - self.expert.actions)[plan.solved].square().mean()
        loss.backward()
        self.gradients += 1
        self.left_out += sum(not certificate.certified for certificate in plan.certificates[-1])
        return loss

    def learn(self, start: tuple[float, ...]) -> torch.Tensor:
        """Learned weights (4,)."""
        free = torch.logit((torch.tensor(start).double() - LOWER) / (UPPER - LOWER)).requires_grad_()
        optimiser = torch.optim.LBFGS(
            [free],
            max_iter=100,
            max_eval=400,  # more than by default, for line searches across jumps of the loss
            line_search_fn="strong_wolfe",
            tolerance_grad=1e-10,
            tolerance_change=1e-12,
        )

        def closure() -> torch.Tensor:
            optimiser.zero_grad()
            return self.loss(weights(free))

        optimiser.step(closure)
        return weights(free).detach()


def main(args: Namespace) -> None:
    problem, solver, states = cart_pole(), Riccati(max_iterations=2000), starting_states()
    expert, layer = demonstrate(OCPLayer(problem, solver), states), OCPLayer(problem, solver, policy="mask")
    results: dict[str, list[float]] = {"errors": [], "gradients": [], "left_out": []}
    errors = results["errors"]
    with kept_if_interrupted(args.out, vars(args), results, lambda: f"{len(errors)} of {args.starts} starts"):
        for number, start in enumerate(STARTS[: args.starts], 1):
            began, imitation = time.perf_counter(), Imitation(layer, states, expert)
            errors.append(float((imitation.learn(start) - torch.tensor(TRUE)).abs().max()))
            results["gradients"].append(imitation.gradients)
            results["left_out"].append(imitation.left_out)
            print(
                f"start {number:2d}: error of the weights {errors[-1]:.1e}, {imitation.gradients} gradients of "
                f"{DEMONSTRATIONS} plans ({imitation.left_out} plans left out), {time.perf_counter() - began:.1f} s",
                flush=True,
            )
    print(f"largest error: {max(errors):.1e}; found from every start: {max(errors) < 1e-3}")
    print(f"numbers: {write_metrics(args.out, vars(args), results)}")
