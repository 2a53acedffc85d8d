"""The tree of exceptions: every one survives pickling, as it must to cross a process boundary."""

import copy
import inspect
import pickle

import pytest

from kpirl_ocp import errors
from kpirl_ocp.errors import CertificateError, EpisodeError, FileError, KpirlError, ModelError
from kpirl_ocp.irl.hypergradients.certificate import Certificate
from kpirl_ocp.types import KKTResiduals, Multipliers, Solution, Status, Trajectory

ALL = [kind for _, kind in inspect.getmembers(errors, inspect.isclass) if kind.__module__ == errors.__name__]
PLAIN = [kind for kind in ALL if kind is not CertificateError]


def certificate():
    empty = [[0.0]]
    residuals = KKTResiduals(1.0, 0.0, 0.0, 0.0, 1.0)
    multipliers = Multipliers(empty, empty, empty, empty)
    parts = (Trajectory(empty, empty), multipliers, 1.0, residuals, Status.STALLED, 3, [], [])
    return Certificate(solution=Solution(*parts), failures=("The KKT residual is 1.",))


def test_every_exception_has_one_base():
    assert all(issubclass(kind, KpirlError) for kind in ALL)


def test_episodes_and_models_are_files():
    assert issubclass(EpisodeError, FileError)
    assert issubclass(ModelError, FileError)


@pytest.mark.parametrize("kind", PLAIN)
@pytest.mark.parametrize("copied", [lambda e: pickle.loads(pickle.dumps(e)), copy.copy])
def test_an_exception_survives_pickling(kind, copied):
    error = copied(kind("the bottle is out of reach."))
    assert type(error) is kind
    assert str(error) == "the bottle is out of reach."


@pytest.mark.parametrize("copied", [lambda e: pickle.loads(pickle.dumps(e)), copy.copy])
def test_a_certificate_error_survives_pickling_with_its_certificate(copied):
    original = certificate()
    error = copied(CertificateError(f"the gradient is {original}", original))
    assert str(error) == "the gradient is NOT certified: The KKT residual is 1."
    assert error.certificate.failures == original.failures
    assert error.certificate.solution.status is original.solution.status
