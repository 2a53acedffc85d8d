"""Tests compile a source of exported folders again where the preprocessor makes another text of it, and only there."""

import shutil

import pytest
from exported import PLAIN, folder
from object_files import objects_of, silent

from kpirl_ocp import Riccati

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="there is no gcc")
NAMES = [f"kpirl_mpc_{name}.c" for name in ("evaluation", "kernels", "line_search", "setup", "start", "view")]
BUILDS = {"numbers": ("integrator", "swing-up", ""), "a macro": ("integrator", "integrator", "-DKPIRL_MPC_NO_HEAP")}


@pytest.mark.parametrize("name", BUILDS)
def test_two_sources_share_an_object_where_their_preprocessed_texts_are_the_same(name):
    *problems, macro = BUILDS[name]
    objects, texts = [], []
    for problem, flags in zip(problems, ((), (macro,) * bool(macro)), strict=True):
        out, _ = folder(problem, Riccati())
        objects.append(objects_of(("gcc", *PLAIN, *flags), out, NAMES))
        texts.append([silent("gcc", "-std=c99", *flags, "-E", "-P", str(out / source)) for source in NAMES])
    shared = [one == other for one, other in zip(*objects, strict=True)]
    assert shared == [one == other for one, other in zip(*texts, strict=True)]
    assert {True, False} == set(shared)
