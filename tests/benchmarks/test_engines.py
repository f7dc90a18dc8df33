"""The engines of the benchmark give the same results."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pytest

# The benchmark is a script with modules beside it, not a package.
sys.path.insert(0, str(Path(__file__).parent))
engines = importlib.import_module("engines")
loop_three_dof = importlib.import_module("loop_three_dof")
piezojax_engine = importlib.import_module("piezojax_engine")  # sets flags of XLA
peers = importlib.import_module("peers")

STEPS = 20_000  # one second
PEERS = {
    # A chunk of the benchmark would take a minute to compile.
    "torch": lambda loop=engines.DOB_PID_SMC: peers.TorchEngine(loop, chunk=4),
    "control": peers.ControlEngine,
    "jaxonomy": peers.JaxonomyEngine,
}


def rms_of(engine, *problem):
    try:
        return engine(*problem)
    except (engines.UnavailableError, NotImplementedError) as reason:
        pytest.skip(str(reason))


# one lane, a half-filled block, more than one block
@pytest.mark.parametrize("lanes", [1, 5, 20])
def test_c_and_numba_agree(lanes):
    problem = engines.problem(lanes, STEPS)
    c = rms_of(engines.c_engine, *problem)
    np.testing.assert_allclose(
        rms_of(engines.numba_engine, *problem), c, rtol=0, atol=1e-9
    )


def test_c_and_numpy_agree():
    problem = engines.problem(20, STEPS)
    c = rms_of(engines.c_engine, *problem)
    np.testing.assert_allclose(engines.numpy_engine(*problem), c, rtol=0, atol=1e-9)


# One lane; lanes that python-control runs one after the other; more than one block of
# jaxonomy. The steps do not fill the chunks of torch, and their number is odd.
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of torch within itself
@pytest.mark.parametrize("lanes", [1, 3, 70])
@pytest.mark.parametrize("name", PEERS)
def test_peers_agree_with_numpy(name, lanes):
    problem = engines.problem(lanes, 1001)
    rms = rms_of(PEERS[name](), *problem)
    assert rms.shape == (lanes,)
    np.testing.assert_allclose(rms, engines.numpy_engine(*problem), rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", PEERS)
def test_peers_run_the_first_loop_only(name):
    with pytest.raises(engines.UnavailableError, match=f"not written for {name}"):
        PEERS[name](loop_three_dof.THREE_DOF_PID_SMC)


def test_a_peer_that_is_not_installed_is_unavailable(monkeypatch):
    monkeypatch.setitem(sys.modules, "jaxonomy", None)
    with pytest.raises(engines.UnavailableError, match="jaxonomy cannot be imported"):
        peers.JaxonomyEngine()(*engines.problem(1, 10))


# one lane, and several blocks with the last one half filled
@pytest.mark.parametrize("lanes", [1, 20])
def test_c_and_numpy_agree_on_three_axes(lanes):
    loop = loop_three_dof.THREE_DOF_PID_SMC
    problem = loop.problem(lanes, 2000)
    c = rms_of(engines.CEngine(loop), *problem)
    assert c.shape == (lanes, 3)
    np.testing.assert_allclose(
        engines.NumpyEngine(loop)(*problem), c, rtol=0, atol=1e-12
    )


def test_numba_runs_the_first_loop_only():
    with pytest.raises(engines.UnavailableError, match="not written for numba"):
        engines.NumbaEngine(loop_three_dof.THREE_DOF_PID_SMC)


@pytest.mark.parametrize("lanes", [1, 20])
def test_piezojax_agrees_with_c(lanes):
    problem = engines.problem(lanes, STEPS)
    c = rms_of(engines.c_engine, *problem)
    rms = rms_of(piezojax_engine.PiezojaxEngine("forward"), *problem)
    np.testing.assert_allclose(rms, c, rtol=0, atol=1e-9)


def test_gradient_agrees_with_central_differences():
    lanes = 4
    _, reference, noise = engines.problem(lanes, STEPS)
    nominal = engines.NOMINAL_GAINS
    loss, gradient = rms_of(
        piezojax_engine.PiezojaxEngine("gradient"), nominal, reference, noise
    )

    def mean_square(gains):
        rows = np.tile(gains, (lanes, 1))
        return np.mean(rms_of(engines.c_engine, rows, reference, noise) ** 2)

    step = 1e-5 * nominal
    differences = [
        (mean_square(nominal + d) - mean_square(nominal - d)) / (2 * d.sum())
        for d in np.diag(step)
    ]
    np.testing.assert_allclose(loss, mean_square(nominal), rtol=1e-9)
    # Gradients by relative changes, so that each gain has equal weight.
    np.testing.assert_allclose(
        gradient * nominal,
        np.array(differences) * nominal,
        rtol=1e-4,
        atol=1e-7 * loss,
    )
